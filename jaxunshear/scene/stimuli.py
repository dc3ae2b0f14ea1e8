"""What is touched: planar shapes with a flat top, as signed distance functions.

Each shape is written in a frame of its own and then seen from its target contact point, the edge or corner that the
paper's Table 1 names: origin at the target, x along the outward normal (at a corner, the bisector), y along the edge.

    xy = jnp.array([[0.0, 0.0], [1.0, 0.0]])
    signed_distance(STIMULI["disk"], xy)  # [0, 1] mm: on the edge, and 1 mm outside

Sizes and frictions are our choice: the paper gives pictures only. Its two acrylic shapes, with a friction of their own,
are the spirals; everything else is 3D-printed ABS. Beside its seven closed shapes stand what recordings are often of: a
straight edge and a flat surface, which have no outline to go round.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.errors import UserError

Distance = Callable[[jax.Array], jax.Array]

# Rubber on hard plastic lies between about 0.5 and 0.9. The evidence is divided (docs/simulator.md): with 0.35 a PoseNet
# trained on taps hardly minds the slide, where the paper's is no better than chance (its Table 2), but recordings of another
# sensor, whose pins stay behind by no more than 0.8-1 mm, suggest 0.2 to 0.4.
ABS_FRICTION = 0.7
ACRYLIC_FRICTION = 0.45
FAR_MM = 125.0  # further than any dome reaches


@dataclass(frozen=True)
class Stimulus:
    """`distance` maps points of the shape's own frame to mm; `target` is (x, y, degrees of the outward normal) there."""

    name: str
    distance: Distance
    target: tuple[float, float, float]
    extent_mm: float  # the shape lies within this radius of its own origin; what has no end is drawn so far
    friction: float = ABS_FRICTION
    material: str = "ABS"


def signed_distance(stimulus: Stimulus, xy: jax.Array) -> jax.Array:
    """Distance to the shape's edge in mm, negative inside; xy (..., 2) in mm in the target frame -> (...)."""
    x, y, turn = stimulus.target
    cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    rotation = jnp.asarray([[cos, sin], [-sin, cos]], xy.dtype)  # row vectors: target frame -> own frame
    return stimulus.distance(xy @ rotation + jnp.asarray([x, y], xy.dtype))


def outward_normal(stimulus: Stimulus, xy: jax.Array) -> jax.Array:
    """Unit gradient of the signed distance, (..., 2) -> (..., 2): the direction away from the nearest edge."""
    flat = xy.reshape(-1, 2)
    slope = jax.vmap(jax.grad(lambda p: signed_distance(stimulus, p)))(flat)
    length = jnp.linalg.norm(slope, axis=-1, keepdims=True)
    return (slope / jnp.where(length > 0, length, 1)).reshape(xy.shape)


def _length(v: jax.Array) -> jax.Array:
    """Euclidean norm whose gradient at zero is zero, not NaN."""
    squared = jnp.sum(v * v, axis=-1)
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)


def edge() -> Distance:
    """A half plane, its straight edge along y."""
    return lambda p: p[..., 0]


def surface() -> Distance:
    """A plane without an edge: as if one were FAR_MM away, wherever it is asked."""
    return lambda p: jnp.full_like(p[..., 0], -FAR_MM)


def disk(radius: float) -> Distance:
    return lambda p: _length(p) - radius


def clover(radius: float, offset: float, fillet: float) -> Distance:
    """Four disks about the corners of a square; a smooth union rounds the four inner corners (exact away from them)."""

    def distance(p: jax.Array) -> jax.Array:
        # by symmetry the two nearest lobes are those of the octant's axes
        across = jnp.abs(p)
        first = _length(across - jnp.asarray([offset, 0.0], p.dtype)) - radius
        second = _length(across - jnp.asarray([0.0, offset], p.dtype)) - radius
        share = jnp.clip(0.5 + (second - first) / (2 * fillet), 0, 1)
        return second + (first - second) * share - fillet * share * (1 - share)

    return distance


def teardrop(radius: float, tip_radius: float, length: float) -> Distance:
    """Convex hull of a disk at the origin and a small one at (length, 0): exact (Quilez, 'uneven capsule')."""
    b = (radius - tip_radius) / length
    a = float(np.sqrt(1 - b * b))

    def distance(p: jax.Array) -> jax.Array:
        along, side = p[..., 0], jnp.abs(p[..., 1])
        k = a * along - b * side
        flank = a * side + b * along - radius
        tip = _length(jnp.stack([along - length, side], axis=-1)) - tip_radius
        return jnp.where(k < 0, _length(p) - radius, jnp.where(k > a * length, tip, flank))

    return distance


def leaf(radius: float, offset: float, round_mm: float) -> Distance:
    """The overlap of two disks with centres (0, +-offset), its two tips rounded: exact (Quilez, 'vesica')."""
    half = float(np.sqrt(radius**2 - offset**2))

    def distance(p: jax.Array) -> jax.Array:
        along, side = jnp.abs(p[..., 0]), jnp.abs(p[..., 1])
        at_tip = (along - half) * offset > side * half
        tip = _length(jnp.stack([along - half, side], axis=-1))
        arc = _length(jnp.stack([along, side + offset], axis=-1)) - radius
        return jnp.where(at_tip, tip, arc) - round_mm

    return distance


def _segments(p: jax.Array, start: np.ndarray, end: np.ndarray) -> tuple[jax.Array, jax.Array, jax.Array]:
    begin, along = jnp.asarray(start, p.dtype), jnp.asarray(end - start, p.dtype)
    offset = p[..., None, :] - begin
    t = jnp.clip(jnp.sum(offset * along, -1) / jnp.sum(along * along, -1), 0, 1)
    return jnp.min(_length(offset - t[..., None] * along), axis=-1), offset, along


def polygon(corners: np.ndarray) -> Distance:
    """A closed polygon, corners (V, 2) counter-clockwise: exact, the sign by crossing number."""
    following = np.roll(corners, -1, axis=0)

    def distance(p: jax.Array) -> jax.Array:
        unsigned, offset, along = _segments(p, corners, following)
        # the same comparison for an edge's end and the next one's start, to the bit: a corner must not count twice or never
        y = p[..., None, 1]
        above, below_end = y >= jnp.asarray(corners[:, 1], p.dtype), y < jnp.asarray(following[:, 1], p.dtype)
        left = along[..., 0] * offset[..., 1] > along[..., 1] * offset[..., 0]
        crossing = (above & below_end & left) | (~above & ~below_end & ~left)
        return jnp.where(jnp.sum(crossing, axis=-1) % 2 == 1, -unsigned, unsigned)

    return distance


def stroke(points: np.ndarray, half_width: float) -> Distance:
    """An open curve through points (V, 2), drawn with a round pen: exact outside its self-overlaps."""
    return lambda p: _segments(p, points[:-1], points[1:])[0] - half_width


def _polar(radius: Callable[[np.ndarray], np.ndarray], corners: int) -> np.ndarray:
    angle = np.arange(corners) * 2 * np.pi / corners
    return radius(angle)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _spiral(inner: float, pitch: float, turns: float, points: int) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi * turns, points)
    return (inner + pitch * angle / (2 * np.pi))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _clover_corner(radius: float, offset: float, fillet: float) -> float:
    """Where the diagonal leaves the clover: there both lobes lie `fillet` / 4 away."""
    reach = radius + fillet / 4
    return float((offset + np.sqrt(2 * reach**2 - offset**2)) / 2)


def _stroke_target(points: np.ndarray, index: int, half_width: float) -> tuple[float, float, float]:
    tangent = points[index + 1] - points[index - 1]
    normal = np.array([tangent[1], -tangent[0]]) / np.linalg.norm(tangent)
    edge = points[index] + half_width * normal
    return float(edge[0]), float(edge[1]), float(np.degrees(np.arctan2(normal[1], normal[0])))


_CORNER = _clover_corner(28.0, 28.0, 4.0)
_SPIRAL_1 = _spiral(inner=9.0, pitch=20.0, turns=2.0, points=161)
_SPIRAL_2 = _spiral(inner=14.0, pitch=30.0, turns=1.25, points=121)

STIMULI = {
    stimulus.name: stimulus
    for stimulus in (
        Stimulus("disk", disk(50.0), (50.0, 0.0, 0.0), 50.0),
        Stimulus("clover", clover(28.0, 28.0, 4.0), (_CORNER, _CORNER, 45.0), 56.0),
        Stimulus("teardrop", teardrop(30.0, 1.0, 45.0), (46.0, 0.0, 0.0), 46.0),
        Stimulus("flower", polygon(_polar(lambda a: 38 + 7 * np.cos(5 * a), 360)), (45.0, 0.0, 0.0), 45.0),
        Stimulus("leaf", leaf(55.0, 32.0, 1.0), (0.0, 24.0, 90.0), 46.0),
        Stimulus(
            "spiral_1", stroke(_SPIRAL_1, 5.0), _stroke_target(_SPIRAL_1, 120, 5.0), 54.0, ACRYLIC_FRICTION, "acrylic"
        ),
        Stimulus(
            "spiral_2", stroke(_SPIRAL_2, 8.0), _stroke_target(_SPIRAL_2, 80, 8.0), 60.0, ACRYLIC_FRICTION, "acrylic"
        ),
        Stimulus("edge", edge(), (0.0, 0.0, 0.0), 25.0),
        Stimulus("surface", surface(), (0.0, 0.0, 0.0), 25.0),
    )
}
TRAINING = ("disk", "clover", "teardrop")
UNSEEN = ("flower", "leaf", "spiral_1", "spiral_2")
SHAPES = (*TRAINING, *UNSEEN)  # the paper's: each has an outline that closes


def stimulus_named(name: str) -> Stimulus:
    if name not in STIMULI:
        raise UserError(f"stimulus '{name}' is unknown: use one of {', '.join(STIMULI)}")
    return STIMULI[name]


def shape_named(name: str) -> Stimulus:
    """One with an outline to follow."""
    if stimulus_named(name).name not in SHAPES:
        raise UserError(f"stimulus '{name}' has no outline that closes: use one of {', '.join(SHAPES)}")
    return STIMULI[name]
