"""Draw the next batch and put it on the device while a step runs, in a thread of its own.

This saves not only the time to draw it. The intermediate arrays of a step are one large block of
the calling thread's memory (`environment.py`), which the next step can use again unless part of it
has been taken since. A thread has memory of its own.
"""

from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

HostBatch = TypeVar("HostBatch")
DeviceBatch = TypeVar("DeviceBatch")


def prefetch(
    batches: Iterator[HostBatch], put: Callable[[HostBatch], DeviceBatch]
) -> Generator[DeviceBatch, None, None]:
    """Yield `put(batch)` of every batch of an endless iterator, in its order.

    Close the generator to end the thread. Errors of `batches` and `put` are raised here.
    """

    def draw() -> DeviceBatch:
        return put(next(batches))

    with ThreadPoolExecutor(1, "batches") as thread:
        future = thread.submit(draw)
        while True:
            batch = future.result()
            future = thread.submit(draw)
            yield batch
