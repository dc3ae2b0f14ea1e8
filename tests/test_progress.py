"""The rate, the time left, and not too many lines."""

import io
import re
import sys
from contextlib import redirect_stderr

import pytest

from jaxunshear.progress import Progress, Stage, format_duration


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture(autouse=True)
def able(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def work(stream: io.StringIO, steps: int, seconds: float, done: int = 0) -> str:
    clock = Clock()
    total = done + 10 * steps
    with Progress("train", total=total, done=done, stream=stream, clock=clock) as progress:
        for _ in range(steps):
            clock.now += seconds
            progress.advance(10)
    return stream.getvalue()


def test_a_log_gets_a_line_every_ten_seconds_and_one_last_line():
    lines = work(io.StringIO(), steps=100, seconds=0.5).splitlines()
    assert len(lines) == 5
    assert lines[0] == "train: 200/1000 images, 20 images/s, 40 s left"
    assert lines[-1] == "train: 1000/1000 images, 20 images/s, done in 50 s"


def plain(text: str) -> str:
    """Without colours and movements of the cursor."""
    return re.sub(r"\x1b\[[?\d;]*[a-zA-Z]", "", text)


@pytest.mark.parametrize("columns", [50, 80])
def test_a_terminal_gets_one_line_redrawn_at_most_five_times_a_second(columns, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    text = work(Terminal(), steps=100, seconds=0.1)
    assert 30 <= text.count("\r\x1b[2K") <= 51, "each drawing erases the one before"
    assert text.count("\n") == 1
    drawings = plain(text).splitlines()
    assert max(map(len, drawings)) <= columns
    assert drawings[1].startswith("train: 20/1000 images, 100 images/s ")
    assert drawings[2].startswith("train: 40/1000 images, 100 images/s, 10 s left ")
    assert drawings[-1].startswith("train: 1000/1000 images, 100 images/s, done in 1")
    assert columns < 80 or re.search(" ━+$", drawings[-1])


def test_a_bar_in_a_bar_and_a_line_between_leave_lines_in_their_order():
    stream = Terminal()
    clock = Clock()
    with redirect_stderr(stream), Progress("out [red]", total=2, clock=clock) as outer:
        print("said", file=sys.stderr)
        with Progress("in", total=1, clock=clock) as inner:
            clock.now += 1
            inner.advance()
        outer.advance(2)
    left = [line.split("\r")[-1] for line in plain(stream.getvalue()).split("\n")]
    shown = ["said", "in: 1/1 images", "out [red]: 2/2 images", ""]
    assert [line.split(",")[0] for line in left] == shown


def test_first_steps_that_compile_are_not_extrapolated():
    stream, clock = io.StringIO(), Clock()
    with Progress("servo", total=400, unit="steps", stream=stream, clock=clock) as progress:
        for seconds in [60, 30] + [0.5] * 398:
            clock.now += seconds
            progress.advance()
    lines = stream.getvalue().splitlines()
    assert [line for line in lines[:2] if "left" in line] == []
    assert lines[2] == "servo: 22/400 steps, 2 steps/s, 3 min 09 s left"
    assert lines[-1].endswith("done in 4 min 49 s")


def test_a_stage_counts_its_units_as_steps_of_the_work():
    progress = Progress("demo", total=100, stream=io.StringIO())
    Stage(progress, 2.5).advance(4)
    assert progress.done == 10


def test_resumed_work_does_not_count_towards_the_rate():
    lines = work(io.StringIO(), steps=40, seconds=0.5, done=1000).splitlines()
    assert lines[0] == "train: 1200/1400 images, 20 images/s, 10 s left"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.4, "0 s"), (59.6, "1 min 00 s"), (125, "2 min 05 s"), (11430, "3 h 10 min")],
)
def test_duration(seconds, text):
    assert format_duration(seconds) == text
