"""Fuse contact geometries along a trajectory to a complete object (paper section 4.4).

Each step gives, for the skin around the sensor's axis, how high it stands or how its cells have
grown. These values are placed where the sensor was and averaged over all steps that touched a cell.
The result is a band along the outline, which is interpolated to a map of the object. The object is
where the map is above a level. Growth is greatest over an edge, so for growth the object is what
the ridge of the map surrounds.

An estimator says what each pin shows, where that is placed, and what shape is made of all of it.
Both estimators use the heights of the pins near the sensor's axis:

voronoi   the paper's: the growth of the pins' cells, where the pins are. Cells grow most over an
          edge, so the object is what the ridge of the map surrounds. It is not trained.
skin      the position of the skin's outer face, by the inverse of `geometry.py` and the dome's own
          shape. The object is above one level, `find_separating_level`. Inverse and level are
          fitted to 300 taps of known poses.

Read `fuse_heights`, then `interpolate_map` and `extract_ridge_shape`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree
from skimage.measure import find_contours
from skimage.morphology import reconstruction
from skimage.segmentation import watershed

from jaxunshear.angles import rotate_2d
from jaxunshear.config.sensor import Sensor
from jaxunshear.downstream.contour import Contour, measure_contour_distances
from jaxunshear.downstream.geometry import (
    compute_relative_growth,
    estimate_indentation,
    fit_inverse,
)
from jaxunshear.perception.lattice import Lattice
from jaxunshear.simulator.pin_layout import (
    compute_face_points,
    compute_outward_normals,
    compute_pin_lattice,
    compute_pin_tips,
)

CELL_MM = 0.5
BLUR_MM = 0.6  # pins are farther apart than cells
DEEP_FRACTION = 0.75  # of the deepest hollow of a map; hollows as deep are the inside
MIN_PINS_PER_CELL = 0.02  # blurred pins per cell, for it to count as touched
VORONOI, SKIN = "voronoi", "skin"
NEAR_MM = 6.0  # from the sensor's axis; farther out the dome curves away from what is under it


class HeightMap(NamedTuple):
    """Mean height on a square grid, rows along y; NaN if nothing was touched."""

    line: np.ndarray  # (K,) mm, target frame: of its columns along x, and of its rows along y
    value: np.ndarray  # (K, K)

    @property
    def xy(self) -> np.ndarray:
        """(K, K, 2) mm, the position of each value."""
        return np.stack(np.meshgrid(self.line, self.line), -1)


def compute_skin_positions(sensor: Sensor) -> np.ndarray:
    """Compute where the undeformed skin is above each pin: (P, 2) mm, sensor frame.

    Positions are on the outer face, projected along the sensor's axis.
    """
    return compute_face_points(sensor)[:, :2]


def transform_to_target(point: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Transform positions (P, 2) or (T, P, 2) mm to the target frame: (T, P, 2) mm.

    They are in the sensor frame at points (T, 3): x, y mm and yaw deg.
    """
    return point[:, None, :2] + rotate_2d(positions, np.radians(point[:, 2])[:, None])


def fuse_heights(
    point: np.ndarray, positions: np.ndarray, value: np.ndarray, cover_mm: float
) -> HeightMap:
    """Average values of the skin along a trajectory on a grid around them.

    Rows with a NaN (images whose pins were not identified) are left out.

    Args:
        point: (T, 3) x, y mm and yaw deg of the sensor.
        positions: (T, Q, 2) mm of the values, from the axis of the sensor.
        value: (T, Q).
        cover_mm: How far the grid reaches from the origin at least.
    """
    followed = ~np.isnan(value).any(axis=-1) & ~np.isnan(point[:, 0])
    positions = positions[followed]
    x, y = np.moveaxis(transform_to_target(point[followed], positions), -1, 0)
    touched_mm = np.abs(point[followed, :2]).max(initial=0.0) + np.abs(positions).max(initial=0.0)
    reach = max(cover_mm, touched_mm + 4 * BLUR_MM)
    edges = np.arange(-reach, reach + CELL_MM, CELL_MM)

    def accumulate(weights: np.ndarray) -> np.ndarray:
        cells = np.histogram2d(y.ravel(), x.ravel(), (edges, edges), weights=weights.ravel())[0]
        return ndimage.gaussian_filter(cells, BLUR_MM / CELL_MM)

    total = accumulate(np.ones_like(x))
    touched = total > MIN_PINS_PER_CELL
    unknown = np.full(total.shape, np.nan)
    mean = np.divide(accumulate(value[followed]), total, out=unknown, where=touched)
    return HeightMap((edges[1:] + edges[:-1]) / 2, mean)


def extract_ridge_shape(fused: HeightMap) -> np.ndarray:
    """Extract what the ridge of a map surrounds, (K, K) bool.

    It is for heights that are greatest over an edge and lower on both sides of it. The inside are
    the deepest hollows of the map: those that water would fill before it ran off at the border. A
    watershed rises from there and from the border to the ridge. There is no hollow if no ridge
    closes.
    """
    heights = np.pad(interpolate_map(fused), 1, constant_values=np.nan)
    if np.isnan(heights).all():
        return np.zeros(fused.value.shape, bool)
    heights = np.nan_to_num(heights, nan=np.nanmin(heights))
    border = np.pad(np.zeros(fused.value.shape, bool), 1, constant_values=True)
    flooded = reconstruction(np.where(border, heights, heights.max()), heights, method="erosion")
    depth = flooded - heights
    hollow = (depth > DEEP_FRACTION * depth.max()) & (depth > 0)
    return (watershed(heights, np.where(hollow, 2, border.astype(int))) == 2)[1:-1, 1:-1]


def interpolate_map(fused: HeightMap) -> np.ndarray:
    """Interpolate (K, K) linearly between the touched cells; NaN outside of all of them."""
    touched = ~np.isnan(fused.value)
    rim = touched & ndimage.binary_dilation(~touched, np.ones((3, 3)), border_value=True)
    if np.count_nonzero(rim) < 3 or touched.all():
        return np.where(touched.all(), fused.value, np.nan)
    full, xy = fused.value.copy(), fused.xy
    full[~touched] = LinearNDInterpolator(xy[rim], fused.value[rim])(xy[~touched])
    return full


class ShapeScore(NamedTuple):
    iou: float
    mean_mm: float  # between the outlines, both ways
    hausdorff_mm: float  # the largest distance of a point of one from the other
    iou_touched: float  # over the touched cells alone


def score_shape(
    fused: HeightMap, shape: np.ndarray, true: np.ndarray, contour: Contour
) -> ShapeScore:
    """Compare a shape (K, K) with the true one (K, K), whose outline is `contour`.

    Distances of an empty shape are infinite.
    """
    touched = ~np.isnan(fused.value)
    iou, iou_touched = _compute_iou(shape, true), _compute_iou(shape & touched, true & touched)
    curves = find_contours(np.pad(shape, 1).astype(float), 0.5)
    if not curves:
        return ShapeScore(iou, float("inf"), float("inf"), iou_touched)
    outline = fused.line[0] + CELL_MM * (np.concatenate(curves)[:, ::-1] - 1)
    to_true = measure_contour_distances(contour, outline)
    from_true = cKDTree(outline).query(contour.points)[0]
    mean_mm = float((to_true.mean() + from_true.mean()) / 2)
    return ShapeScore(iou, mean_mm, float(max(to_true.max(), from_true.max())), iou_touched)


def _compute_iou(shape: np.ndarray, true: np.ndarray) -> float:
    union = np.count_nonzero(shape | true)
    return float(np.count_nonzero(shape & true) / union) if union else 0.0


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
    undeformed = compute_face_points(sensor)[near, 2]
    towards_axis = -compute_outward_normals(sensor, compute_pin_lattice(sensor))[near, 2]

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
