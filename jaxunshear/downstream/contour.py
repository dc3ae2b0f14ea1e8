"""The outline of a stimulus by arc length, in its target frame.

>>> contour = trace_contour(STIMULI["disk"])
>>> contour.length                                                   # 314.2 mm
>>> measure_contour_distances(contour, np.array([[1.0, 0.0]]))       # [1.0] mm
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from skimage.measure import find_contours

from jaxunshear.simulator.stimuli import (
    REACH_MM,
    Stimulus,
    compute_distances,
    compute_outward_normal,
    compute_signed_distance,
)

GRID_MM = 0.25
SPACING_MM = 0.1


class Contour(NamedTuple):
    """A closed curve, counter-clockwise, from the point nearest to the target."""

    points: np.ndarray  # (K, 2) mm, SPACING_MM apart; the last is the first's neighbour
    normal: np.ndarray  # (K, 2) outward unit normals
    length: float  # mm

    def at(self, arc_mm: np.ndarray) -> np.ndarray:
        """Find the indices of the points at these lengths along the curve, modulo its length."""
        count = len(self.points)
        return np.round(np.asarray(arc_mm) / self.length * count).astype(int) % count


def trace_contour(stimulus: Stimulus) -> Contour:
    """Trace the longest closed curve on which the signed distance is zero, to about 0.01 mm."""
    line = np.arange(-REACH_MM, REACH_MM + GRID_MM / 2, GRID_MM)
    distance = compute_distances(stimulus, np.stack(np.meshgrid(line, line), -1))
    curves = [line[0] + GRID_MM * curve[:, ::-1] for curve in find_contours(distance, 0.0)]
    curve = max(curves, key=_measure_length)
    x, y = curve.T
    if np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) < 0:
        curve = curve[::-1]
    start = int(np.argmin(np.linalg.norm(curve[:-1], axis=-1)))
    curve = np.concatenate([curve[start:-1], curve[: start + 1]])
    arc = np.append(0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=-1)))
    count = max(8, round(arc[-1] / SPACING_MM))
    even = np.linspace(0, arc[-1], count, endpoint=False)
    points = np.stack([np.interp(even, arc, values) for values in curve.T], -1)
    normal, points = _move_onto_edge(stimulus, points)
    return Contour(points, normal, _measure_length(np.concatenate([points, points[:1]])))


def _measure_length(curve: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=-1).sum())


def _move_onto_edge(stimulus: Stimulus, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute normals (K, 2), and move points (K, 2) along them onto the edge."""

    @jax.jit
    def compute_edge(xy: jax.Array) -> tuple[jax.Array, jax.Array]:
        return compute_signed_distance(stimulus, xy), compute_outward_normal(stimulus, xy)

    edge = compute_edge(jnp.asarray(points, jnp.float32))
    distance, normal = np.asarray(edge[0], float), np.asarray(edge[1], float)
    return normal, points - distance[:, None] * normal


def measure_contour_distances(contour: Contour, xy: np.ndarray) -> np.ndarray:
    """Measure the distances (N,) mm of points (N, 2) from the curve."""
    return cKDTree(contour.points).query(xy)[0]


def update_arc_positions(
    contour: Contour, arc_mm: np.ndarray, xy: np.ndarray, window_mm: float
) -> np.ndarray:
    """Find the arc positions (N,) mm of points (N, 2) that were at `arc_mm` (N,) before.

    They are the nearest positions within a window. They grow beyond `length` when a point goes
    round again.
    """
    half = round(window_mm / SPACING_MM)
    near = np.asarray(arc_mm)[:, None] + np.arange(-half, half + 1) * SPACING_MM
    distance = np.linalg.norm(contour.points[contour.at(near)] - xy[:, None], axis=-1)
    return near[np.arange(len(near)), np.argmin(distance, axis=1)]
