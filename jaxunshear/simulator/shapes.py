"""Planar shapes as exact signed distances: mm from the outline, negative inside.

A `Distance` maps points (..., 2) mm of the shape's own frame to (...,) mm. Its gradient is the
outline's normal: it has length 1 on the outline and near it, to the float. It is zero, never NaN,
where all directions are as near, as in the middle of a disk.

To make your own shape, use a polygon, a stroke or any such function:

    triangle = make_polygon(np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 30.0]]))
    Stimulus("triangle", triangle, target=(15.0, 0.0, -90.0), extent_mm=30.0)
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Num

from jaxunshear.config.stimuli import Target

Distance = Callable[[Float[jax.Array, "*B 2"]], Float[jax.Array, "*B"]]

FAR_MM = 125.0  # further than any dome reaches
AT_CORNER_MM = 1e-4  # nearer than this to a corner, rounding decides where a point lies from it
STEPS = 8  # of Newton's method: what floats can resolve, from starts as coarse as here
STARTS = 13  # along half a petal


class Radius(NamedTuple):
    """A polar curve's radius at angles, and its first two derivatives by the angle in rad."""

    value: jax.Array
    slope: jax.Array
    bend: jax.Array


PolarCurve = Callable[[jax.Array], Radius]


def _length(v: jax.Array) -> jax.Array:
    """Compute the Euclidean norm, with a gradient at zero that is zero, not NaN."""
    squared = jnp.sum(v * v, axis=-1)
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)


def _align(table: np.ndarray, p: jax.Array) -> jax.Array:
    """Give a table (V, ...) the leading axes of points (..., 2), to broadcast with them."""
    return jnp.asarray(table, p.dtype).reshape((1,) * (p.ndim - 1) + table.shape)


def make_half_plane() -> Distance:
    """Make a half plane, its straight edge along y."""
    return lambda p: p[..., 0]


def make_plane() -> Distance:
    """Make a plane without an edge: as if one were FAR_MM away from every point."""
    return lambda p: jnp.full_like(p[..., 0], -FAR_MM)


def make_disk(radius: float) -> Distance:
    return lambda p: _length(p) - radius


def _compute_fillet_centre(radius: float, offset: float, fillet: float) -> float:
    """Compute x and y of the middle of a circle that touches two neighbouring lobes."""
    return float((offset + np.sqrt(2 * (radius + fillet) ** 2 - offset**2)) / 2)


def make_clover(radius: float, offset: float, fillet: float) -> Distance:
    """Make four disks about (+-offset, 0) and (0, +-offset), rounded where they meet.

    The corners are arcs of radius `fillet`. The outline nearest to a point lies in the same eighth
    of the plane: there one lobe's arc passes into one fillet's, and the line through both centres
    separates the points of the one from those of the other.
    """
    middle = _compute_fillet_centre(radius, offset, fillet)

    def distance(p: jax.Array) -> jax.Array:
        x, y = jnp.abs(p[..., 0]), jnp.abs(p[..., 1])
        far, near = jnp.maximum(x, y), jnp.minimum(x, y)
        from_lobe = jnp.stack([far - offset, near], axis=-1)
        from_fillet = jnp.stack([far - middle, near - middle], axis=-1)
        at_fillet = (middle - offset) * from_lobe[..., 1] > middle * from_lobe[..., 0]
        return jnp.where(at_fillet, fillet - _length(from_fillet), _length(from_lobe) - radius)

    return distance


def compute_clover_corner(radius: float, offset: float, fillet: float) -> float:
    """Compute x and y of the place where the diagonal leaves the clover."""
    return _compute_fillet_centre(radius, offset, fillet) - fillet / float(np.sqrt(2))


def make_teardrop(radius: float, tip_radius: float, length: float) -> Distance:
    """Make the hull of a disk at the origin and a small one at (length, 0) (Quilez).

    Quilez calls it 'uneven capsule'.
    """
    b = (radius - tip_radius) / length
    a = float(np.sqrt(1 - b * b))

    def distance(p: jax.Array) -> jax.Array:
        along, side = p[..., 0], jnp.abs(p[..., 1])
        k = a * along - b * side
        flank = a * side + b * along - radius
        tip = _length(jnp.stack([along - length, side], axis=-1)) - tip_radius
        return jnp.where(k < 0, _length(p) - radius, jnp.where(k > a * length, tip, flank))

    return distance


def make_leaf(radius: float, offset: float, round_mm: float) -> Distance:
    """Make the overlap of two disks about (0, +-offset), tips rounded (Quilez, 'vesica')."""
    half = float(np.sqrt(radius**2 - offset**2))

    def distance(p: jax.Array) -> jax.Array:
        along, side = jnp.abs(p[..., 0]), jnp.abs(p[..., 1])
        at_tip = (along - half) * offset > side * half
        tip = _length(jnp.stack([along - half, side], axis=-1))
        arc = _length(jnp.stack([along, side + offset], axis=-1)) - radius
        return jnp.where(at_tip, tip, arc) - round_mm

    return distance


def _find_nearest_angle(
    curve: PolarCurve, start: jax.Array, low: jax.Array, high: jax.Array, p: jax.Array
) -> jax.Array:
    """Find where a polar curve, between two angles, lies nearest to points (..., 2).

    Newton's method begins at `start`; all angles are (...,) rad.
    """
    far, towards = _length(p), jnp.arctan2(p[..., 1], p[..., 0])

    def step(_: int, angle: jax.Array) -> jax.Array:
        r, rise, bend = curve(angle)
        cos, sin = far * jnp.cos(angle - towards), far * jnp.sin(angle - towards)
        slope = r * rise - rise * cos + r * sin  # of half the squared distance
        curvature = rise**2 + r * bend - bend * cos + 2 * rise * sin + r * cos
        # beyond the centre of curvature Newton's step would lead uphill
        safe = jnp.where(curvature > 0, curvature, r**2 + rise**2)
        return jnp.clip(angle - slope / safe, low, high)

    return jax.lax.fori_loop(0, STEPS, step, start)


def _evaluate_curve(curve: PolarCurve, angle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute points (..., 2) of a polar curve and the unit normals to its right."""
    r, rise, _ = curve(angle)
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    normal = jnp.stack([rise * sin + r * cos, r * sin - rise * cos], axis=-1)
    return jnp.stack([r * cos, r * sin], axis=-1), normal / jnp.sqrt(r**2 + rise**2)[..., None]


def make_flower(mean: float, wave: float, petals: int) -> Distance:
    """Make the outline `mean + wave cos(petals angle)`.

    By symmetry the outline nearest to a point lies on the same half petal.
    """
    half = np.pi / petals

    def compute_radius(angle: jax.Array) -> Radius:
        cos, sin = jnp.cos(petals * angle), jnp.sin(petals * angle)
        return Radius(mean + wave * cos, -petals * wave * sin, -(petals**2) * wave * cos)

    def distance(p: jax.Array) -> jax.Array:
        fixed = jax.lax.stop_gradient(p)
        petal = 2 * half * jnp.round(jnp.arctan2(fixed[..., 1], fixed[..., 0]) / (2 * half))
        off_axis = jnp.arctan2(fixed[..., 1], fixed[..., 0]) - petal
        folded = _length(fixed)[..., None] * jnp.stack(
            [jnp.cos(off_axis), jnp.abs(jnp.sin(off_axis))], axis=-1
        )
        starts = np.linspace(0, half, STARTS)
        squared = jnp.sum(
            (folded[..., None, :] - _evaluate_curve(compute_radius, _align(starts, p))[0]) ** 2,
            axis=-1,
        )
        start, gap = jnp.asarray(starts, p.dtype)[jnp.argmin(squared, axis=-1)], half / (STARTS - 1)
        angle = _find_nearest_angle(
            compute_radius,
            start,
            jnp.maximum(start - gap, 0),
            jnp.minimum(start + gap, half),
            folded,
        )
        point, normal = _evaluate_curve(
            compute_radius, petal + jnp.where(off_axis < 0, -angle, angle)
        )
        # the outline's point stands still, to first order
        return jnp.sum((p - point) * normal, axis=-1)

    return distance


def make_spiral(inner: float, pitch: float, turns: float, half_width: float) -> Distance:
    """Make the curve `inner + pitch angle / 2 pi`, drawn with a round pen.

    The pen must not reach the next winding anywhere.
    """
    last = 2 * np.pi * turns

    def compute_radius(angle: jax.Array) -> Radius:
        rise = jnp.full_like(angle, pitch / (2 * np.pi))
        return Radius(inner + rise * angle, rise, jnp.zeros_like(angle))

    def distance(p: jax.Array) -> jax.Array:
        fixed = jax.lax.stop_gradient(p)[..., None, :]
        windings = _align(2 * np.pi * np.arange(-1, np.ceil(turns) + 1), p)
        start = jnp.clip(jnp.arctan2(fixed[..., 1], fixed[..., 0]) + windings, 0, last)
        angle = _find_nearest_angle(
            compute_radius, start, jnp.maximum(start - 1, 0), jnp.minimum(start + 1, last), fixed
        )
        points = _evaluate_curve(compute_radius, angle)[0]
        nearest = jnp.argmin(jnp.sum((fixed - points) ** 2, axis=-1), axis=-1)
        point = jnp.take_along_axis(points, nearest[..., None, None], axis=-2)[..., 0, :]
        return _length(p - point) - half_width

    return distance


def compute_spiral_target(inner: float, pitch: float, half_width: float, turns: float) -> Target:
    """Compute where the outer side of a spiral stands after so many turns.

    The result is x, y (mm) and the direction of the outward normal (deg).
    """
    angle, rise = 2 * np.pi * turns, pitch / (2 * np.pi)
    r = inner + rise * angle
    cos, sin = np.cos(angle), np.sin(angle)
    normal = np.array([rise * sin + r * cos, r * sin - rise * cos]) / np.hypot(r, rise)
    x, y = r * np.array([cos, sin]) + half_width * normal
    return float(x), float(y), float(np.degrees(np.arctan2(normal[1], normal[0])))


class _Foot(NamedTuple):
    """The place on segments that is nearest to each point."""

    segment: jax.Array  # (...,) index
    along: jax.Array  # (...,) in [0, 1] on the segment
    place: jax.Array  # (..., 2)


def _find_foot(p: jax.Array, start: np.ndarray, end: np.ndarray) -> _Foot:
    """Find the nearest place on the segments from (V, 2) to (V, 2) for each point (..., 2)."""
    begin, side = jnp.asarray(start, p.dtype), jnp.asarray(end - start, p.dtype)
    along, offset = _align(end - start, p), p[..., None, :] - _align(start, p)
    t = jnp.clip(jnp.sum(offset * along, -1) / jnp.sum(along * along, -1), 0, 1)
    index = jnp.argmin(jnp.sum((offset - t[..., None] * along) ** 2, -1), axis=-1)
    t = jnp.take_along_axis(t, index[..., None], axis=-1)[..., 0]
    # a corner to the bit, whichever of its two segments is the nearest
    place = jnp.where(
        (t < 1)[..., None],
        begin[index] + t[..., None] * side[index],
        jnp.asarray(end, p.dtype)[index],
    )
    return _Foot(index, t, place)


def make_polygon(corners: Num[np.ndarray, "V 2"]) -> Distance:
    """Make a closed polygon that does not cross itself.

    Beside a segment the distance is that from its line, which separates inside from outside and has
    a slope on the outline, too. At a corner it is that from the corner, outside where the mean of
    both normals points to.
    """
    # the first corner may be given again as the last
    differs = np.any(corners != np.roll(corners, 1, axis=0), axis=-1)
    corners = np.asarray(corners, float)[differs]
    x, y = corners.T
    if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) < 0:
        corners = corners[::-1]
    following = np.roll(corners, -1, axis=0)
    side = following - corners
    flat = np.stack([side[:, 1], -side[:, 0]], axis=-1) / np.linalg.norm(
        side, axis=-1, keepdims=True
    )
    mean = flat + np.roll(flat, 1, axis=0)
    mean = mean / np.linalg.norm(mean, axis=-1, keepdims=True)

    def distance(p: jax.Array) -> jax.Array:
        index, t, place = _find_foot(jax.lax.stop_gradient(p), corners, following)
        inside_segment = (t > 0) & (t < 1)
        at_end = (index + (t >= 1).astype(index.dtype)) % len(corners)
        normal = jnp.where(
            inside_segment[..., None],
            jnp.asarray(flat, p.dtype)[index],
            jnp.asarray(mean, p.dtype)[at_end],
        )
        signed = jnp.sum((p - place) * normal, axis=-1)
        far = _length(p - place)
        return jnp.where(
            inside_segment | (far < AT_CORNER_MM), signed, jnp.where(signed < 0, -far, far)
        )

    return distance


def make_stroke(points: Num[np.ndarray, "V 2"], half_width: float) -> Distance:
    """Make an open curve through points, drawn with a round pen.

    The distance is exact outside. Inside it is exact except where the pen covers its own track: at
    crossings, and on the inner side of sharp bends.
    """
    points = points[np.append(True, np.any(np.diff(points, axis=0) != 0, axis=-1))]

    def distance(p: jax.Array) -> jax.Array:
        foot = _find_foot(jax.lax.stop_gradient(p), points[:-1], points[1:])
        return _length(p - foot.place) - half_width

    return distance
