"""Shows on stderr how far a long loop is, how fast, and how long it still takes.

>>> with Progress("simulate", total=1200, unit="contacts") as progress:
...     for batch in batches:
...         progress.advance(len(batch))
"""

import os
import sys
import time
from collections import deque
from collections.abc import Callable
from functools import cache
from typing import Protocol, Self, TextIO

from rich import progress
from rich.console import Console

from jaxunshear.text_table import format_plain

TERMINAL_SECONDS = 0.2
LOG_SECONDS = 10.0
STEPS_BEFORE = 4  # a time left is shown


class Counter(Protocol):
    """Counts what is done: all of a long work, or a stage of it."""

    def advance(self, n: float = 1) -> None:
        """Count `n` more."""


class Progress:
    """Counts `done` of `total` units.

    The rate is that of this process, without `done` at the start (resumed work). On a terminal a
    bar is drawn over and over; in a log a full line is written about every ten seconds.

    The first steps compile what all need. The rate and the time left are therefore those of the
    second half of the steps until now, and the first few have no time left.
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
        self._clock = clock
        self._from = done
        self._steps = 0
        self._recent: deque[tuple[float, float]] = deque()  # times, and what was done until then
        self._start = self._shown = clock()
        self._bar: progress.Progress | None = None
        if self._stream.isatty() and os.environ.get("TERM") not in ("dumb", "unknown"):
            self._bar = _make_bar(self._stream)
            self._bar.add_task(label, total=total, completed=int(done))

    def __enter__(self) -> Self:
        self._start = self._shown = self._clock()
        self._recent.append((self._start, self.done))
        if self._bar:
            self._bar.start()
        return self

    def advance(self, n: float = 1) -> None:
        """Count `n` more; draw if the last drawing is long enough ago."""
        self.done += n
        self._steps += 1
        now = self._clock()
        self._recent.append((now, self.done))
        while len(self._recent) > 2 and self._recent[1][1] <= (self._from + self.done) / 2:
            self._recent.popleft()
        is_left_to_exit = not self._bar and self.done >= self.total  # or a log has it twice
        seconds = TERMINAL_SECONDS if self._bar else LOG_SECONDS
        if now - self._shown >= seconds and not is_left_to_exit:
            self._shown = now
            self._draw(now)

    def format_line(self, now: float) -> str:
        """Format a line such as `train: 3200/9600 images, 41.3 images/s, 2 min 35 s left`."""
        ended = self.done >= self.total
        start, done = (self._start, self._from) if ended or not self._recent else self._recent[0]
        rate = (self.done - done) / (now - start) if now > start else 0.0
        counts = f"{self.done:.10g}/{self.total:.10g} {self.unit}"
        text = f"{self.label}: {counts}, {format_plain(rate)} {self.unit}/s"
        if ended:
            text += f", done in {format_duration(now - self._start)}"
        elif self._steps >= STEPS_BEFORE and rate > 0:
            text += f", {format_duration((self.total - self.done) / rate)} left"
        return text

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._bar or kind is None:
            self._draw(self._clock())
        if self._bar:
            self._bar.stop()  # an interrupted line must end before the error's

    def _draw(self, now: float) -> None:
        if not self._bar:
            print(self.format_line(now), file=self._stream, flush=True)
            return
        (task,) = self._bar.task_ids
        self._bar.update(task, description=self.format_line(now), completed=self.done, refresh=True)


class Stage:
    """Counts a stage of a longer work, each of whose units is `steps` of the work's."""

    def __init__(self, work: Counter, steps: float) -> None:
        self._work, self._steps = work, steps

    def advance(self, n: float = 1) -> None:
        self._work.advance(n * self._steps)


def _make_bar(stream: TextIO) -> progress.Progress:
    return progress.Progress(
        progress.TextColumn("{task.description}", markup=False),
        progress.BarColumn(bar_width=None),  # what the text leaves of the line
        console=_make_console(stream),
        auto_refresh=False,
        redirect_stdout=sys.stdout.isatty(),  # what goes into a file stays out of the terminal
        expand=True,
    )


@cache
def _make_console(stream: TextIO) -> Console:
    """Make one console for all bars on a stream, so that a bar may be drawn within a bar."""
    return Console(file=stream, force_terminal=True)


def format_duration(seconds: float) -> str:
    """Format seconds as `45 s`, `2 min 05 s` or `3 h 10 min`."""
    full = round(seconds)
    if full < 60:
        return f"{full} s"
    if full < 3600:
        return f"{full // 60} min {full % 60:02d} s"
    return f"{full // 3600} h {full % 3600 // 60:02d} min"
