"""The outline of a stimulus by arc length, in its target frame: what a contour following has to close.

>>> line = trace_contour(STIMULI["disk"])
>>> line.length, measure_contour_distances(line, np.array([[1.0, 0.0]]))        # (314.2 mm, [1.0] mm)
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from skimage.measure import find_contours

from jaxunshear.simulator.obstacle import REACH_MM
from jaxunshear.simulator.stimuli import (
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
        """Indices of the points at these lengths along the curve, which goes round and round."""
        return np.round(np.asarray(arc_mm) / self.length * len(self.points)).astype(int) % len(
            self.points
        )


def trace_contour(stimulus: Stimulus) -> Contour:
    """The longest closed curve on which the signed distance is zero, to about 0.01 mm."""
    line = np.arange(-REACH_MM, REACH_MM + GRID_MM / 2, GRID_MM)
    distance = compute_distances(stimulus, np.stack(np.meshgrid(line, line), -1))
    curves = [line[0] + GRID_MM * curve[:, ::-1] for curve in find_contours(distance, 0.0)]
    curve = max(curves, key=_length)
    x, y = curve.T
    if np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) < 0:
        curve = curve[::-1]
    start = int(np.argmin(np.linalg.norm(curve[:-1], axis=-1)))
    curve = np.concatenate([curve[start:-1], curve[: start + 1]])
    arc = np.append(0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=-1)))
    count = max(8, round(arc[-1] / SPACING_MM))
    even = np.linspace(0, arc[-1], count, endpoint=False)
    points = np.stack([np.interp(even, arc, values) for values in curve.T], -1)
    normal, points = _on_edge(stimulus, points)
    return Contour(points, normal, _length(np.concatenate([points, points[:1]])))


def _length(curve: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=-1).sum())


def _on_edge(stimulus: Stimulus, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (K, 2), and points (K, 2) moved along them onto the edge."""

    def both(xy: jax.Array) -> tuple[jax.Array, jax.Array]:
        return compute_signed_distance(stimulus, xy), compute_outward_normal(stimulus, xy)

    distance, normal = (
        np.asarray(value, float) for value in jax.jit(both)(jnp.asarray(points, jnp.float32))
    )
    return normal, points - distance[:, None] * normal


def measure_contour_distances(line: Contour, xy: np.ndarray) -> np.ndarray:
    """Distances (N,) mm of points (N, 2) from the curve."""
    return cKDTree(line.points).query(xy)[0]


def update_arc_positions(
    line: Contour, arc_mm: np.ndarray, xy: np.ndarray, window_mm: float
) -> np.ndarray:
    """Where along the curve points (N, 2) are that were at `arc_mm` (N,) before: the nearest place within a window about it.

    Lengths grow beyond `length` when a point goes round again.
    """
    steps = (
        np.arange(-round(window_mm / SPACING_MM), round(window_mm / SPACING_MM) + 1) * SPACING_MM
    )
    near = np.asarray(arc_mm)[:, None] + steps
    apart = np.linalg.norm(line.points[line.at(near)] - xy[:, None], axis=-1)
    return near[np.arange(len(near)), np.argmin(apart, axis=1)]
