"""Ways from a walk's pins to the object: what each pin shows, where it is put, and what shape is made of all of it.

Both fuse the surfaces that a walk felt, each a height of the pins near the sensor's axis:

voronoi   the paper's: the growth of the pins' cells, where the pins are. Cells grow most over an edge: what the ridge of the map surrounds
          is the object. It learns from nothing.
skin      where the skin's outer face stands, by the inverse of `geometry.py` and the dome's own shape; above one level, `find_separating_level`,
          lies the object. Inverse and level are from 300 taps of known poses.
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
NEAR_MM = (
    6.0  # pins from the sensor's axis: farther out the dome curves away from what lies under it
)


class ShapeEstimator(NamedTuple):
    estimate_values: Callable[
        [np.ndarray], np.ndarray
    ]  # motions (T, P, 2) px -> (T, Q); NaN rows stay
    locate_values: Callable[[np.ndarray], np.ndarray]  # -> (T, Q, 2) mm from the axis
    extract_shape: Callable[[HeightMap], np.ndarray]  # -> (K, K) bool
    level: float | None  # of the value, over which the object lies; none for a ridge
    in_mm: bool  # whether the value is a height in mm above the sensor's apex


def make_shape_estimators(
    sensor: Sensor,
    lattice: Lattice,
    motion: np.ndarray,
    indentation_mm: np.ndarray,
    distance: np.ndarray,
) -> dict[str, ShapeEstimator]:
    """By name; from motions (N, P, 2) px, NaN where unknown, of taps at the depth of the walk, how far the skin above each pin is pressed
    in (N, P), and how far outside the object it lies (N, P) mm."""
    rest = compute_skin_positions(sensor)
    followed = ~np.isnan(motion[:, 0, 0])
    motion, distance = motion[followed], distance[followed]
    near = np.linalg.norm(rest, axis=-1) < NEAR_MM
    inverse = fit_inverse(lattice, motion, indentation_mm[followed])
    tips = compute_pin_tips(sensor)[:, :2]
    px_per_mm = np.sum((lattice.rest - lattice.centre) * tips) / np.sum(tips**2)
    towards_axis = np.sqrt(1 - np.sum(rest[near] ** 2, axis=-1) / sensor.dome_radius_mm**2)
    undeformed = sensor.dome_radius_mm * (1 - towards_axis)

    def growth(motion: np.ndarray) -> np.ndarray:
        found = np.full((len(motion), np.count_nonzero(near)), np.nan)
        sure = ~np.isnan(motion[:, 0, 0])
        if sure.any():
            found[sure] = compute_relative_growth(lattice, motion[sure])[:, near]
        return found

    def stands(motion: np.ndarray) -> np.ndarray:
        return undeformed + towards_axis * estimate_indentation(inverse, motion)[:, near]

    def displace_pins(motion: np.ndarray) -> np.ndarray:
        return rest[near] + motion[:, near] / px_per_mm

    def above(fused: HeightMap) -> np.ndarray:
        return np.nan_to_num(interpolate_map(fused), nan=-np.inf) > level

    level = find_separating_level(stands(motion), distance[:, near] < 0)
    return {
        VORONOI: ShapeEstimator(growth, displace_pins, extract_ridge_shape, None, in_mm=False),
        SKIN: ShapeEstimator(stands, displace_pins, above, level, in_mm=True),
    }


def find_separating_level(values: np.ndarray, over: np.ndarray) -> float:
    """The level that as large a share of the skin beside the object exceeds as of the skin `over` it falls short of."""
    levels = np.quantile(values, np.linspace(0, 1, 1001))
    short = np.searchsorted(np.sort(values[over]), levels) / np.sum(over)
    beyond = 1 - np.searchsorted(np.sort(values[~over]), levels) / np.sum(~over)
    return float(levels[np.argmin(np.abs(short - beyond))])
