"""The rigid stimulus as the contact sees it: a flat top that rounds off over the edge.

Signed distances are sampled once on a grid about the target, so that one compiled program serves
every shape and a batch may mix shapes. Between grid points they are interpolated bilinearly, with
an error below 0.01 mm away from corners.
"""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxunshear.config.stimuli import Outline
from jaxunshear.errors import UserError
from jaxunshear.simulator.stimuli import Stimulus, compute_signed_distance, make_stimulus

# of the rounding: that of the node spacing, so that a node meets an edge gradually
EDGE_RADIUS_MM = 1.0
REACH_MM = 125.0  # beyond every shape, seen from its target
SPACING_MM = 0.25


class Obstacles(NamedTuple):
    """Signed distances of S stimuli on a square grid of SPACING_MM about each target point."""

    distance: jax.Array  # (S, H, H) mm


def sample_obstacles(shapes: Sequence[str | Outline | Stimulus]) -> Obstacles:
    """Sample shapes as obstacles, once for each combination of shapes.

    Raises UserError where a distance or a target is not finite.
    """
    return _sample_obstacles(tuple(map(make_stimulus, shapes)))


@lru_cache(maxsize=16)  # 4 MiB a shape: all that have a name, one by one, and some drawn by hand
def _sample_obstacles(stimuli: tuple[Stimulus, ...]) -> Obstacles:
    return Obstacles(jnp.stack([_sample_distance(stimulus) for stimulus in stimuli]))


def _sample_distance(stimulus: Stimulus) -> jax.Array:
    line = jnp.asarray(np.arange(-REACH_MM, REACH_MM + SPACING_MM / 2, SPACING_MM), jnp.float32)

    def sample_row(y: jax.Array) -> jax.Array:
        return compute_signed_distance(stimulus, jnp.stack([line, jnp.full_like(line, y)], -1))

    # row by row: a shape of many segments needs memory
    grid = jax.jit(partial(jax.lax.map, sample_row))(line)
    if not (np.isfinite(stimulus.target).all() and bool(jnp.isfinite(grid).all())):
        raise UserError(
            f"stimulus '{stimulus.name}': its target and its signed distance must be finite "
            "numbers everywhere"
        )
    return grid


def interpolate_distance(
    obstacles: Obstacles, index: Int[jax.Array, "B"], xy: Float[jax.Array, "B N 2"]
) -> Float[jax.Array, "B N"]:
    """Interpolate the signed distances in mm of obstacles `index` in their target frames.

    Beyond the grid the distance to the grid is added: far outside, as every shape lies within.
    """
    size = obstacles.distance.shape[-1]
    half = SPACING_MM * (size - 1) / 2
    inside = jnp.clip(xy, -half, half)
    place = jnp.minimum((inside + half) / SPACING_MM, size - 1.001)
    cell = place.astype(jnp.int32)
    share = place - cell.astype(place.dtype)
    flat = obstacles.distance.reshape(-1)
    base = index[:, None] * size * size + cell[..., 1] * size + cell[..., 0]
    corner = [flat[base + step].astype(xy.dtype) for step in (0, 1, size, size + 1)]
    lower = corner[0] * (1 - share[..., 0]) + corner[1] * share[..., 0]
    upper = corner[2] * (1 - share[..., 0]) + corner[3] * share[..., 0]
    return (
        lower * (1 - share[..., 1]) + upper * share[..., 1] + jnp.max(jnp.abs(xy - inside), axis=-1)
    )


def compute_surface_drop(
    obstacles: Obstacles, index: Int[jax.Array, "B"], xy: Float[jax.Array, "B N 2"]
) -> Float[jax.Array, "B N"]:
    """Compute how far in mm the stimulus' surface lies below its flat top.

    The drop is a parabola that osculates the edge's rounding.
    """
    outside = jnp.maximum(interpolate_distance(obstacles, index, xy), 0)
    return outside**2 / (2 * EDGE_RADIUS_MM)
