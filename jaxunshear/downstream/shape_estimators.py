"""Methods from the pins of a trajectory to the object.

A method says what each pin shows, where that is placed, and what shape is made of all of it. Both
fuse the surfaces along a trajectory, each from the heights of the pins near the sensor's axis:

voronoi   the paper's: the growth of the pins' cells, where the pins are. Cells grow most over an
          edge, so the object is what the ridge of the map surrounds. It is not trained.
skin      the position of the skin's outer face, by the inverse of `geometry.py` and the dome's own
          shape. The object is above one level, `find_separating_level`. Inverse and level are
          fitted to 300 taps of known poses.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxunshear.config.sensor import Sensor
from jaxunshear.downstream.geometry import (
    compute_relative_growth,
    estimate_indentation,
    fit_inverse,
)
from jaxunshear.downstream.reconstruct import (
    HeightMap,
    compute_skin_positions,
    extract_ridge_shape,
    interpolate_map,
)
from jaxunshear.perception.lattice import Lattice
from jaxunshear.simulator.pin_layout import compute_pin_tips

VORONOI, SKIN = "voronoi", "skin"
NEAR_MM = 6.0  # from the sensor's axis; farther out the dome curves away from what is under it


class ShapeEstimator(NamedTuple):
    # motions (T, P, 2) px -> (T, Q); NaN rows stay
    estimate_values: Callable[[np.ndarray], np.ndarray]
    locate_values: Callable[[np.ndarray], np.ndarray]  # -> (T, Q, 2) mm from the axis
    extract_shape: Callable[[HeightMap], np.ndarray]  # -> (K, K) bool
    level: float | None  # the object is where the value is higher; None for a ridge
    in_mm: bool  # whether the value is a height in mm above the sensor's apex


def make_shape_estimators(
    sensor: Sensor,
    lattice: Lattice,
    motion: np.ndarray,
    indentation_mm: np.ndarray,
    distance: np.ndarray,
) -> dict[str, ShapeEstimator]:
    """Make both methods by name, from taps at the depth of the trajectory.

    Args:
        lattice: Its rest positions.
        motion: (N, P, 2) px, NaN if unknown.
        indentation_mm: (N, P) of the skin above each pin.
        distance: (N, P) mm of that skin from the object's edge, negative over the object.
    """
    rest = compute_skin_positions(sensor)
    followed = ~np.isnan(motion[:, 0, 0])
    motion, distance = motion[followed], distance[followed]
    near = np.linalg.norm(rest, axis=-1) < NEAR_MM
    inverse = fit_inverse(lattice, motion, indentation_mm[followed])
    tips = compute_pin_tips(sensor)[:, :2]
    px_per_mm = np.sum((lattice.rest - lattice.centre) * tips) / np.sum(tips**2)
    towards_axis = np.sqrt(1 - np.sum(rest[near] ** 2, axis=-1) / sensor.dome_radius_mm**2)
    undeformed = sensor.dome_radius_mm * (1 - towards_axis)

    def estimate_growth(motion: np.ndarray) -> np.ndarray:
        growth = np.full((len(motion), np.count_nonzero(near)), np.nan)
        identified = ~np.isnan(motion[:, 0, 0])
        if identified.any():
            growth[identified] = compute_relative_growth(lattice, motion[identified])[:, near]
        return growth

    def estimate_skin_height(motion: np.ndarray) -> np.ndarray:
        return undeformed + towards_axis * estimate_indentation(inverse, motion)[:, near]

    def displace_skin(motion: np.ndarray) -> np.ndarray:
        return rest[near] + motion[:, near] / px_per_mm

    level = find_separating_level(estimate_skin_height(motion), distance[:, near] < 0)

    def extract_above_level(fused: HeightMap) -> np.ndarray:
        return np.nan_to_num(interpolate_map(fused), nan=-np.inf) > level

    return {
        VORONOI: ShapeEstimator(estimate_growth, displace_skin, extract_ridge_shape, None, False),
        SKIN: ShapeEstimator(estimate_skin_height, displace_skin, extract_above_level, level, True),
    }


def find_separating_level(values: np.ndarray, over: np.ndarray) -> float:
    """Find the level that separates values `over` the object from others.

    The share of values below it over the object equals the share of others above it.
    """
    levels = np.quantile(values, np.linspace(0, 1, 1001))
    below = np.searchsorted(np.sort(values[over]), levels) / np.sum(over)
    above = 1 - np.searchsorted(np.sort(values[~over]), levels) / np.sum(~over)
    return float(levels[np.argmin(np.abs(below - above))])
