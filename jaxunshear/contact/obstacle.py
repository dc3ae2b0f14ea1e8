"""The rigid stimulus as the contact sees it: a flat top that rounds off over the edge.

Signed distances are sampled once on a grid about the target, so that one compiled program serves every shape and a batch
may mix shapes; between grid points they are interpolated bilinearly (below 0.01 mm of error away from corners).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.scene.stimuli import signed_distance, stimulus_named

EDGE_RADIUS_MM = 0.5  # of the rounding: also keeps the contact at an edge from flipping node by node
REACH_MM = 30.0
SPACING_MM = 0.25


class Obstacles(NamedTuple):
    """Signed distances (S, H, H) in mm on a square grid of half-width REACH_MM about each target point."""

    distance: jax.Array


def sample(names: tuple[str, ...]) -> Obstacles:
    """The named stimuli as obstacles, (S, H, H)."""
    line = np.arange(-REACH_MM, REACH_MM + SPACING_MM / 2, SPACING_MM)
    grid = jnp.asarray(np.stack(np.meshgrid(line, line, indexing="xy"), -1), jnp.float32)
    return Obstacles(jnp.stack([jax.jit(lambda p, s=stimulus_named(n): signed_distance(s, p))(grid) for n in names]))


def distance_at(obstacles: Obstacles, which: jax.Array, xy: jax.Array) -> jax.Array:
    """Signed distance (B, N) in mm at points xy (B, N, 2) of the target frame of obstacle which (B,)."""
    size = obstacles.distance.shape[-1]
    place = jnp.clip((xy + REACH_MM) / SPACING_MM, 0, size - 1.001)
    cell = place.astype(jnp.int32)
    share = place - cell
    flat = obstacles.distance.reshape(-1)
    base = which[:, None] * size * size + cell[..., 1] * size + cell[..., 0]
    lower = flat[base] * (1 - share[..., 0]) + flat[base + 1] * share[..., 0]
    upper = flat[base + size] * (1 - share[..., 0]) + flat[base + size + 1] * share[..., 0]
    return lower * (1 - share[..., 1]) + upper * share[..., 1]


def drop(obstacles: Obstacles, which: jax.Array, xy: jax.Array) -> jax.Array:
    """How far (mm) the stimulus' surface lies below its flat top: a parabola that osculates the edge's rounding."""
    outside = jnp.maximum(distance_at(obstacles, which, xy), 0)
    return outside**2 / (2 * EDGE_RADIUS_MM)
