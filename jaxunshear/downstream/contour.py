"""The outline of a stimulus by arc length, and the controller that follows it.

>>> contour = trace_contour(STIMULI["disk"])
>>> contour.length                                                   # 314.2 mm
>>> measure_contour_distances(contour, np.array([[1.0, 0.0]]))       # [1.0] mm

The contour is in the stimulus' target frame. The paper's controller (appendix C) is proportional
and integral. It steers towards a pose normal to the edge, with a constant step along it.

>>> zero = ControllerState(jnp.zeros(1), jnp.zeros(1))
>>> control(ControllerGains(), zero, edge_mm=jnp.array([1.0]), edge_deg=jnp.array([10.0]))
    # move [[-0.8, 0.5]] mm and turn [6.] deg, in the sensor frame
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
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


@dataclass(frozen=True)
class ControllerGains:
    """Gains of appendix C, and limits of our own.

    The limits keep one wrong prediction from moving the sensor off the object.
    """

    proportional: float = 0.5
    integral_mm: float = 0.3
    integral_deg: float = 0.1
    step_mm: float = 0.5  # along the edge
    limit_mm: float = 1.5  # of a correction
    limit_deg: float = 20.0  # what a tip of a millimetre needs


class ControllerState(NamedTuple):
    """Sums of the errors so far, zero at the start."""

    normal_mm: Array  # (B,)
    turn_deg: Array  # (B,)


class Command(NamedTuple):
    """The next motion in the sensor frame.

    x points across the edge, outwards, and y along it, counter-clockwise around the object.
    """

    move: Array  # (B, 2) mm
    turn: Array  # (B,) deg
    state: ControllerState


def control(
    gains: ControllerGains, state: ControllerState, edge_mm: Array, edge_deg: Array
) -> Command:
    """Compute the next motion from the perceived edge.

    An error sum does not grow further while its correction is at a limit (anti-windup).

    Args:
        edge_mm: (B,) distance of the edge, negative inside.
        edge_deg: (B,) direction of its outward normal.
    """
    across, normal_mm = _compute_correction(
        -edge_mm, state.normal_mm, gains.proportional, gains.integral_mm, gains.limit_mm
    )
    turn, turn_deg = _compute_correction(
        edge_deg, state.turn_deg, gains.proportional, gains.integral_deg, gains.limit_deg
    )
    move = jnp.stack([across, jnp.full_like(across, gains.step_mm)], -1)
    return Command(move, turn, ControllerState(normal_mm, turn_deg))


def _compute_correction(
    error: Array, total: Array, proportional: float, integral: float, limit: float
) -> tuple[Array, Array]:
    new_total = total + error
    unlimited = proportional * error + integral * new_total
    correction = jnp.clip(unlimited, -limit, limit)
    winding_up = (unlimited != correction) & (jnp.sign(error) == jnp.sign(unlimited))
    return correction, jnp.where(winding_up, total, new_total)
