"""The next batch is drawn and put on the device while a step runs, in a thread of its own.

Not only to save its time. A step's intermediate arrays are one large block of the calling thread's memory (`memory.py`), which the
next step finds again as long as nobody has taken a piece of it. A thread has memory of its own.
"""

from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Drawn = TypeVar("Drawn")
Put = TypeVar("Put")


def prefetch(batches: Iterator[Drawn], put: Callable[[Drawn], Put]) -> Generator[Put, None, None]:
    """`put(batch)` of every batch of an endless iterator, in its order; close it to end the thread. Raises what these raise."""

    def draw() -> Put:
        return put(next(batches))

    with ThreadPoolExecutor(1, "batches") as thread:
        coming = thread.submit(draw)
        while True:
            ready = coming.result()
            coming = thread.submit(draw)
            yield ready
