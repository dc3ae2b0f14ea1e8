"""One line on stderr that says how far a long loop is, how fast, and how long it still takes.

>>> with Progress("simulate", total=1200, unit="contacts") as progress:
...     for batch in batches:
...         progress.advance(len(batch))
"""

import sys
import time
from collections.abc import Callable
from typing import Self, TextIO

TERMINAL_SECONDS = 0.2
LOG_SECONDS = 10.0


class Progress:
    """Counts `done` of `total` units. The rate is that of this process: `done` at the start (resumed work) is left out.

    On a terminal one line is drawn over and over; in a log a full line is written about every ten seconds.
    """

    def __init__(
        self,
        label: str,
        total: float,
        unit: str = "images",
        done: float = 0,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.label, self.total, self.unit, self.done = label, total, unit, done
        self._stream = sys.stderr if stream is None else stream
        self._terminal = self._stream.isatty()
        self._clock = clock
        self._from, self._width = done, 0
        self._start = self._shown = clock()

    def __enter__(self) -> Self:
        self._start = self._shown = self._clock()
        return self

    def advance(self, n: float = 1) -> None:
        """Counts `n` more; draws if the last drawing is long enough ago."""
        self.done += n
        now = self._clock()
        if now - self._shown >= (TERMINAL_SECONDS if self._terminal else LOG_SECONDS):
            self._shown = now
            self._draw(self.line(now), end="" if self._terminal else "\n")

    def line(self, now: float) -> str:
        """For example `train: 3200/9600 images, 41.3 images/s, 2 min 35 s left`."""
        seconds = now - self._start
        rate = (self.done - self._from) / seconds if seconds > 0 else 0.0
        text = f"{self.label}: {self.done:.10g}/{self.total:.10g} {self.unit}, {rate:.3g} {self.unit}/s"
        if self.done < self.total and rate > 0:
            text += f", {duration((self.total - self.done) / rate)} left"
        elif self.done >= self.total:
            text += f", done in {duration(seconds)}"
        return text

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._terminal or kind is None:  # an interrupted line must end before the error's
            self._draw(self.line(self._clock()), end="\n")

    def _draw(self, text: str, end: str) -> None:
        if self._terminal:
            text, self._width = "\r" + text.ljust(self._width), len(text)
        self._stream.write(text + end)
        self._stream.flush()


def duration(seconds: float) -> str:
    """`45 s`, `2 min 05 s`, `3 h 10 min`."""
    full = round(seconds)
    if full < 60:
        return f"{full} s"
    if full < 3600:
        return f"{full // 60} min {full % 60:02d} s"
    return f"{full // 3600} h {full % 3600 // 60:02d} min"
