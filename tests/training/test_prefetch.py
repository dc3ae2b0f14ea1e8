"""Batches that are drawn ahead of their steps come in their order, and a failure to draw one arrives with it."""

import contextlib
import itertools
import threading

import pytest

from jaxunshear.training.devices import prefetch


def test_in_order_and_one_ahead_in_a_thread_of_their_own():
    drawn, threads = [], set()

    def put(number):
        drawn.append(number)
        threads.add(threading.get_ident())
        return -number

    with contextlib.closing(prefetch(itertools.count(), put)) as stream:
        assert list(itertools.islice(stream, 5)) == [0, -1, -2, -3, -4]
    assert drawn == [0, 1, 2, 3, 4, 5]
    assert len(threads) == 1
    assert threading.get_ident() not in threads
    assert not any(thread.ident in threads for thread in threading.enumerate())


def test_what_drawing_raises_comes_after_the_batches_before_it():
    stream = prefetch((1 / (3 - number) for number in itertools.count()), float)
    assert [next(stream) for _ in range(3)] == [1 / 3, 1 / 2, 1.0]
    with pytest.raises(ZeroDivisionError):
        next(stream)
