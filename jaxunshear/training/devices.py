"""Devices of a training: one, or several with a part of the batch and all weights on each.

The step is the same: XLA turns its sums over the batch, of losses, gradients and normalisation,
into sums over all devices. A thread draws the next batch and puts it there while a step runs.
"""

from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxunshear.environment import DEVICE_COUNT, read_device_count
from jaxunshear.errors import UserError

State = TypeVar("State")
Fields = dict[str, np.ndarray | jax.Array]
AXIS = "batch"
HostBatch = TypeVar("HostBatch")
DeviceBatch = TypeVar("DeviceBatch")


class Devices(NamedTuple):
    """`mesh` is None for one device, where JAX puts everything by itself."""

    number: int
    mesh: Mesh | None

    @property
    def on_each(self) -> NamedSharding | None:
        return None if self.mesh is None else NamedSharding(self.mesh, PartitionSpec())

    def with_state(self, state: State) -> State:
        """Put a tree of arrays on the devices, complete on each."""
        return state if self.mesh is None else jax.device_put(state, self.on_each)

    def with_batch(self, batch: Fields) -> Fields:
        """Split fields (B, ...) over the devices.

        A field that cannot be split evenly is complete on each.
        """
        if self.mesh is None:
            return jax.device_put(batch)
        split = NamedSharding(self.mesh, PartitionSpec(AXIS))
        return {
            name: jax.device_put(values, self.on_each if len(values) % self.number else split)
            for name, values in batch.items()
        }


def get_devices(batch: int) -> Devices:
    """Get the devices that the environment asks for.

    Raises UserError if there are fewer, or if `batch` cannot be split over them.
    """
    devices = jax.devices()
    count = read_device_count() or len(devices)
    if count > len(devices):
        raise UserError(
            f"{DEVICE_COUNT}={count}: JAX sees {len(devices)} here ({devices[0].platform}): "
            "use at most so many"
        )
    if batch % count:
        raise UserError(
            f"batch: {batch} images cannot be split over {count} devices: use a multiple of {count}"
        )
    if count == 1:
        return Devices(1, None)
    return Devices(count, Mesh(np.array(devices[:count]), (AXIS,)))


def prefetch(
    batches: Iterator[HostBatch], put: Callable[[HostBatch], DeviceBatch]
) -> Generator[DeviceBatch, None, None]:
    """Yield `put(batch)` of every batch of an endless iterator, in its order.

    Close the generator to end the thread. Errors of `batches` and `put` are raised here. A thread
    not only saves the time to draw a batch: it has memory of its own. The intermediate arrays of a
    step are one large block of the calling thread's memory (`environment.keep_freed_memory`), which
    the next step can use again unless part of it has been taken since.
    """

    def draw() -> DeviceBatch:
        return put(next(batches))

    with ThreadPoolExecutor(1, "batches") as thread:
        future = thread.submit(draw)
        while True:
            batch = future.result()
            future = thread.submit(draw)
            yield batch
