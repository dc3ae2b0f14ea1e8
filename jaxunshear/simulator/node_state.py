"""What the nodes of a skin do: stick, slip, or touch nothing."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxunshear.simulator.contact_problem import Skin
from jaxunshear.simulator.frame import compute_level_frame, rotate

ROTATION_ROUNDING = 1e-6  # of a force, what turning it to and fro in float32 may add to its pull
MIN_PULL = 1e-33  # smaller ones lose digits, or components, to the end of float32's range


class NodeCounts(NamedTuple):
    """Numbers of nodes of B skins, each (B,)."""

    stuck: Array
    slipping: Array
    free: Array


def count_node_states(skin: Skin, friction: Float[Array, "B"], tilted: bool = False) -> NodeCounts:
    """Count the stuck, slipping and free nodes of B skins."""
    force = rotate(compute_level_frame(skin.pose), skin.force) if tilted else skin.force
    touching = force[..., -1] > 0
    if force.shape[-1] == 1:
        slipping = touching
    else:
        pull = jnp.hypot(force[..., 0], force[..., 1])  # squares of a tiny one would be zero
        limit = jnp.where(jnp.isinf(friction), 0, friction)[:, None] * force[..., 2]
        rounding = 1e-4 * limit + (ROTATION_ROUNDING * force[..., 2] if tilted else 0)
        slips = (pull >= limit - rounding) | (limit < MIN_PULL)
        slipping = touching & ~jnp.isinf(friction)[:, None] & slips
    return NodeCounts(
        jnp.sum(touching & ~slipping, -1), jnp.sum(slipping, -1), jnp.sum(~touching, -1)
    )
