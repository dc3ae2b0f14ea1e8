"""Beside the steps of a training: TensorBoard's event files, and batches drawn in advance."""

import contextlib
import itertools
import struct
import threading

import numpy as np
import pytest

from jaxunshear.report.training_sections import read_lines
from jaxunshear.training.devices import prefetch
from jaxunshear.training.monitor import list_scalars, open_events
from jaxunshear.training.step import make_schedule
from tests.training import small


def read(folder):
    """Return the events of a folder's files: records of a length, its check, the event, its check."""
    from tensorboardX.proto.event_pb2 import Event

    found = []
    data = b"".join(file.read_bytes() for file in sorted(folder.glob("events.out.tfevents.*")))
    while data:
        (size,) = struct.unpack("<Q", data[:8])
        found.append(Event.FromString(data[12 : 12 + size]))
        data = data[16 + size :]
    return found


def points(folder):
    """Return step and value of each figure, by tag."""
    found = {}
    for event in read(folder):
        for value in event.summary.value:
            found.setdefault(value.tag, []).append((event.step, value.simple_value))
    return found


def test_a_training_writes_what_its_log_says(tmp_path):
    small.train(tmp_path)
    lines, found = read_lines(tmp_path / "log.jsonl"), points(tmp_path)
    rate = make_schedule(small.TRAINING, 12, 4)
    assert len(lines) == 3 and found.keys() == {*list_scalars(lines[0]), "learning_rate"}
    for line in lines:
        scalars = list_scalars(line) | {"learning_rate": float(rate(line["step"] - 1))}
        for tag, value in scalars.items():
            assert (line["step"], np.float32(value)) in found[tag]


def test_one_that_goes_on_drops_what_a_stopped_one_wrote_beyond(tmp_path):
    with open_events(tmp_path, 4, lambda step: 0.5) as log:
        log({"step": 8, "train": {"loss": 1.0}, "validation": {"loss": None}})
    start, event = read(tmp_path)[1:]
    assert (start.step, start.session_log.status) == (5, 1)
    assert {value.tag for value in event.summary.value} == {"train/loss", "learning_rate"}


def test_without_the_extra_nothing_is_written(tmp_path, absent):
    absent("tensorboardX.event_file_writer")
    with open_events(tmp_path, 0, lambda step: 0.5) as log:
        log({"step": 8})
    assert not list(tmp_path.iterdir())


def test_in_order_and_one_ahead_in_a_thread_of_their_own():
    drawn, threads = [], set()

    def put(number):
        drawn.append(number)
        threads.add(threading.get_ident())
        return -number

    with contextlib.closing(prefetch(itertools.count(), put)) as stream:
        assert list(itertools.islice(stream, 5)) == [0, -1, -2, -3, -4]
    assert drawn == [0, 1, 2, 3, 4, 5]
    assert len(threads) == 1 and threading.get_ident() not in threads
    assert not any(thread.ident in threads for thread in threading.enumerate())


def test_what_drawing_raises_comes_after_the_batches_before_it():
    stream = prefetch((1 / (3 - number) for number in itertools.count()), float)
    assert [next(stream) for _ in range(3)] == [1 / 3, 1 / 2, 1.0]
    with pytest.raises(ZeroDivisionError):
        next(stream)
