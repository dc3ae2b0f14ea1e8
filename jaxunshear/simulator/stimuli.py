"""The objects that are touched: planar shapes with a flat top, as signed distances.

The contact sees a flat top that rounds off over the edge. For it signed distances are sampled once
on a grid about the target, so that one compiled program serves every shape and a batch may mix
shapes. Between grid points they are interpolated bilinearly, with an error below 0.01 mm away from
corners.

Each shape is written in a frame of its own. The target frame has its origin at the target contact
point, the edge or corner that the paper's Table 1 names, x along the outward normal (at a corner,
the bisector) and y along the edge.

    xy = jnp.array([[0.0, 0.0], [1.0, 0.0]])
    compute_signed_distance(STIMULI["disk"], xy)  # [0, 1] mm: on the edge, and 1 mm outside

Sizes and frictions are our choice: the paper gives pictures only. Its two acrylic shapes, with a
friction of their own, are the spirals; everything else is 3D-printed ABS. Besides the paper's seven
closed shapes there are two that are often recorded: a straight edge and a flat surface, which have
no outline to go round. `config/stimuli.py` makes your own outlines.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxunshear.config.stimuli import ABS_FRICTION, Outline, Target
from jaxunshear.errors import UserError
from jaxunshear.simulator import shapes

ACRYLIC_FRICTION = 0.45
# of the rounding: that of the node spacing, so that a node meets an edge gradually
EDGE_RADIUS_MM = 1.0
REACH_MM = 125.0  # beyond every shape, seen from its target
SPACING_MM = 0.25


@dataclass(frozen=True)
class Stimulus:
    """A shape, where its target contact point lies, and its friction."""

    name: str
    distance: shapes.Distance  # of points in the shape's own frame
    target: Target  # x, y (mm), direction of the outward normal (deg), in that frame
    # the shape lies within this radius of its own origin; an endless one is drawn so far
    extent_mm: float
    friction: float = ABS_FRICTION
    material: str = "ABS"


def compute_signed_distance(
    stimulus: Stimulus, xy: Float[jax.Array, "*B 2"]
) -> Float[jax.Array, "*B"]:
    """Compute the distance to the edge in mm, negative inside; xy in mm, target frame."""
    x, y, turn = stimulus.target
    cos, sin = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    # no matrix product, as those have fewer digits on accelerators
    shape_xy = [x + cos * xy[..., 0] - sin * xy[..., 1], y + sin * xy[..., 0] + cos * xy[..., 1]]
    return stimulus.distance(jnp.stack(shape_xy, axis=-1))


def compute_distances(
    stimulus: Stimulus, xy: Float[np.ndarray, "N M 2"]
) -> Float[np.ndarray, "N M"]:
    """Compute `compute_signed_distance` row by row: a shape of many segments needs memory."""
    by_row = jax.jit(partial(jax.lax.map, partial(compute_signed_distance, stimulus)))
    return np.asarray(by_row(jnp.asarray(xy, jnp.float32)))


def compute_outward_normal(
    stimulus: Stimulus, xy: Float[jax.Array, "*B 2"]
) -> Float[jax.Array, "*B 2"]:
    """Compute the direction away from the nearest edge: the signed distance's unit gradient."""
    flat = xy.reshape(-1, 2)
    slope = jax.vmap(jax.grad(lambda p: compute_signed_distance(stimulus, p)))(flat)
    length = jnp.linalg.norm(slope, axis=-1, keepdims=True)
    return (slope / jnp.where(length > 0, length, 1)).reshape(xy.shape)


_CORNER = shapes.compute_clover_corner(28.0, 28.0, 4.0)

STIMULI = {  # names as `StimulusName` of config/stimuli.py
    stimulus.name: stimulus
    for stimulus in (
        Stimulus("disk", shapes.make_disk(50.0), (50.0, 0.0, 0.0), 50.0),
        Stimulus("clover", shapes.make_clover(28.0, 28.0, 4.0), (_CORNER, _CORNER, 45.0), 56.0),
        Stimulus("teardrop", shapes.make_teardrop(30.0, 1.0, 45.0), (46.0, 0.0, 0.0), 46.0),
        Stimulus("flower", shapes.make_flower(38.0, 7.0, 5), (45.0, 0.0, 0.0), 45.0),
        Stimulus("leaf", shapes.make_leaf(55.0, 32.0, 1.0), (0.0, 24.0, 90.0), 46.0),
        Stimulus(
            "spiral_1",
            shapes.make_spiral(9.0, 20.0, 2.0, 5.0),
            shapes.compute_spiral_target(9.0, 20.0, 5.0, 1.5),
            54.0,
            ACRYLIC_FRICTION,
            "acrylic",
        ),
        Stimulus(
            "spiral_2",
            shapes.make_spiral(14.0, 30.0, 1.25, 8.0),
            shapes.compute_spiral_target(14.0, 30.0, 8.0, 5 / 6),
            60.0,
            ACRYLIC_FRICTION,
            "acrylic",
        ),
        Stimulus("edge", shapes.make_half_plane(), (0.0, 0.0, 0.0), 25.0),
        Stimulus("surface", shapes.make_plane(), (0.0, 0.0, 0.0), 25.0),
    )
}
TRAINING = ("disk", "clover", "teardrop")
UNSEEN = ("flower", "leaf", "spiral_1", "spiral_2")
SHAPES = (*TRAINING, *UNSEEN)  # of the paper: each has an outline that closes


def get_stimulus(name: str) -> Stimulus:
    if name not in STIMULI:
        raise UserError(f"stimulus '{name}' is unknown: use one of {', '.join(STIMULI)}")
    return STIMULI[name]


@lru_cache(maxsize=64)
def _make_from_outline(outline: Outline) -> Stimulus:
    distance = shapes.make_polygon(np.array(outline.points))
    return Stimulus(
        outline.name, distance, outline.place, outline.extent_mm, outline.friction, "own"
    )


def make_stimulus(shape: str | Outline | Stimulus) -> Stimulus:
    """Return the stimulus of a name or an outline, the same object each time.

    Raises UserError for an unknown name.
    """
    if isinstance(shape, Stimulus):
        return shape
    return _make_from_outline(shape) if isinstance(shape, Outline) else get_stimulus(shape)


def get_closed_stimulus(shape: str | Outline) -> Stimulus:
    """Return a stimulus with an outline to follow. Raises UserError for one without."""
    if isinstance(shape, str) and get_stimulus(shape).name not in SHAPES:
        raise UserError(
            f"stimulus '{shape}' has no outline that closes: use one of {', '.join(SHAPES)}"
        )
    return make_stimulus(shape)


class Obstacles(NamedTuple):
    """Signed distances of S stimuli on a square grid of SPACING_MM about each target point."""

    distance: jax.Array  # (S, H, H) mm


def sample_obstacles(stimuli: Sequence[str | Outline | Stimulus]) -> Obstacles:
    """Sample shapes as obstacles, once for each combination of shapes.

    Raises UserError where a distance or a target is not finite.
    """
    return _sample_obstacles(tuple(map(make_stimulus, stimuli)))


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
