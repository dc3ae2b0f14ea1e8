"""The rate, the time left, and not too many lines."""

import io

import pytest

from jaxunshear.progress import Progress, duration


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def work(stream: io.StringIO, steps: int, seconds: float, done: int = 0) -> str:
    clock = Clock()
    with Progress("train", total=done + 10 * steps, done=done, stream=stream, clock=clock) as progress:
        for _ in range(steps):
            clock.now += seconds
            progress.advance(10)
    return stream.getvalue()


def test_a_log_gets_a_line_every_ten_seconds_and_a_last_one():
    lines = work(io.StringIO(), steps=100, seconds=0.5).splitlines()
    assert len(lines) == 6
    assert lines[0] == "train: 200/1000 images, 20 images/s, 40 s left"
    assert lines[-1] == "train: 1000/1000 images, 20 images/s, done in 50 s"


def test_a_terminal_gets_one_line_redrawn_at_most_five_times_a_second():
    text = work(Terminal(), steps=100, seconds=0.1)
    assert text.count("\r") <= 51
    assert text.count("\n") == 1
    widths = [len(line.rstrip()) for line in text.rstrip().split("\r")[1:]]
    padded = [len(line) for line in text.rstrip("\n").split("\r")[1:]]
    assert all(after >= before for before, after in zip(widths, padded[1:], strict=False)), "leftovers of a longer line"


def test_resumed_work_does_not_count_towards_the_rate():
    lines = work(io.StringIO(), steps=40, seconds=0.5, done=1000).splitlines()
    assert lines[0] == "train: 1200/1400 images, 20 images/s, 10 s left"


def test_an_interrupted_line_is_ended():
    stream = Terminal()
    with pytest.raises(KeyboardInterrupt), Progress("train", total=10, stream=stream):
        raise KeyboardInterrupt
    assert stream.getvalue().endswith("\n")


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (59.6, "1 min 00 s"), (125, "2 min 05 s"), (11430, "3 h 10 min")]
)
def test_duration(seconds, text):
    assert duration(seconds) == text
