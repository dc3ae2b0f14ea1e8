"""Where a training's arrays lie: on one device, or the batch split over several, with the weights on each.

The step is the same: XLA makes its sums over the batch, of losses, gradients and normalisation, sums over all devices.
"""

from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxunshear.environment import DEVICE_COUNT, read_device_count
from jaxunshear.errors import UserError

State = TypeVar("State")
Fields = dict[str, np.ndarray | jax.Array]
AXIS = "batch"


class Devices(NamedTuple):
    """`mesh` is None for one device, where JAX puts everything by itself."""

    number: int
    mesh: Mesh | None

    @property
    def on_each(self) -> NamedSharding | None:
        return None if self.mesh is None else NamedSharding(self.mesh, PartitionSpec())

    def with_state(self, state: State) -> State:
        """A tree of arrays, complete on each device."""
        return state if self.mesh is None else jax.device_put(state, self.on_each)

    def with_batch(self, batch: Fields) -> Fields:
        """Fields (B, ...), each device its part; those that cannot be split evenly are complete on each."""
        if self.mesh is None:
            return jax.device_put(batch)
        split = NamedSharding(self.mesh, PartitionSpec(AXIS))
        even = {name: len(values) % self.number == 0 for name, values in batch.items()}
        return {
            name: jax.device_put(values, split if even[name] else self.on_each)
            for name, values in batch.items()
        }


def get_devices(batch: int) -> Devices:
    """Those that the environment asks for. Raises UserError where there are fewer, or where `batch` cannot be split over them."""
    there = jax.devices()
    count = read_device_count() or len(there)
    if count > len(there):
        raise UserError(
            f"{DEVICE_COUNT}={count}: JAX sees {len(there)} here ({there[0].platform}): use at most so many"
        )
    if batch % count:
        raise UserError(
            f"batch: {batch} images cannot be split over {count} devices: use a multiple of {count}"
        )
    if count == 1:
        return Devices(1, None)
    return Devices(count, Mesh(np.array(there[:count]), (AXIS,)))
