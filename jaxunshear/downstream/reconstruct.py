"""Complete objects (paper section 4.4): the contact geometries along a walk, fused onto a grid, and the shape that they enclose.

Each step gives, of the skin around the sensor's axis, how high it stands or how its cells have grown. Put where the sensor was,
averaged over all steps that touched a cell, this makes a band along the outline, which is interpolated to a map of the entire object.
The object is where the map is above a level; or, of growth, which is greatest over an edge, what the ridge of the map surrounds.

Read `fuse_heights`, then `interpolate_map` and `extract_ridge_shape`.
"""

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
from jaxunshear.simulator.pin_layout import compute_pin_tips

CELL_MM = 0.5
BLUR_MM = 0.6  # pins are farther apart than cells
DEEP_FRACTION = 0.75  # of the deepest hollow of a map: what is as deep is the inside
MIN_PINS_PER_CELL = 0.02  # pins a cell, blurred, for it to count as touched


class HeightMap(NamedTuple):
    """Mean height on a square grid, rows along y; NaN where nothing was touched."""

    line: np.ndarray  # (K,) mm, target frame: of its columns along x, and of its rows along y
    value: np.ndarray  # (K, K)

    @property
    def xy(self) -> np.ndarray:
        """(K, K, 2) mm, where each value is."""
        return np.stack(np.meshgrid(self.line, self.line), -1)


def compute_skin_positions(sensor: Sensor) -> np.ndarray:
    """(P, 2) mm in the sensor frame: the outer face of the undeformed skin above each pin, seen from above."""
    centre = np.array([0, 0, sensor.dome_radius_mm])
    outward = compute_pin_tips(sensor) - centre
    return sensor.dome_radius_mm * outward[:, :2] / np.linalg.norm(outward, axis=-1, keepdims=True)


def transform_to_target(point: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Places (P, 2) or (T, P, 2) mm of the sensor frame, seen from points (T, 3) x, y mm and yaw deg: (T, P, 2) mm of the target frame."""
    return point[:, None, :2] + rotate_2d(place, np.radians(point[:, 2])[:, None])


def fuse_heights(
    point: np.ndarray, place: np.ndarray, value: np.ndarray, cover_mm: float
) -> HeightMap:
    """Values (T, Q) of skin at (T, Q, 2) mm from the axis, felt at points (T, 3) x, y mm and yaw deg, averaged on a grid
    around them that reaches at least `cover_mm` from the origin.

    Rows with a NaN (an image whose pins were not identified) are left out.
    """
    followed = ~np.isnan(value).any(axis=-1) & ~np.isnan(point[:, 0])
    put = place[followed]
    x, y = np.moveaxis(transform_to_target(point[followed], put), -1, 0)
    reach = max(
        cover_mm,
        np.abs(point[followed, :2]).max(initial=0.0) + np.abs(put).max(initial=0.0) + 4 * BLUR_MM,
    )
    edges = np.arange(-reach, reach + CELL_MM, CELL_MM)

    def accumulate(weights: np.ndarray) -> np.ndarray:
        cells = np.histogram2d(y.ravel(), x.ravel(), (edges, edges), weights=weights.ravel())[0]
        return ndimage.gaussian_filter(cells, BLUR_MM / CELL_MM)

    total = accumulate(np.ones_like(x))
    touched = total > MIN_PINS_PER_CELL
    mean = np.divide(
        accumulate(value[followed]), total, out=np.full(total.shape, np.nan), where=touched
    )
    return HeightMap((edges[1:] + edges[:-1]) / 2, mean)


def extract_ridge_shape(fused: HeightMap) -> np.ndarray:
    """(K, K) bool: what the ridge of the heights surrounds, for heights that are greatest over an edge and lie lower on both sides of it.

    Of the map's hollows, which water would fill before it ran off at the border, the deepest are the inside; from there and from the
    border a watershed climbs to the ridge. Nothing is a hollow where no ridge closes.
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
    """(K, K): what was felt, and between it linear over the cells that were not, from the felt ones beside them; NaN outside of all
    that was felt."""
    felt = ~np.isnan(fused.value)
    rim = felt & ndimage.binary_dilation(~felt, np.ones((3, 3)), border_value=True)
    if np.count_nonzero(rim) < 3 or felt.all():
        return np.where(felt.all(), fused.value, np.nan)
    full, xy = fused.value.copy(), fused.xy
    full[~felt] = LinearNDInterpolator(xy[rim], fused.value[rim])(xy[~felt])
    return full


class ShapeScore(NamedTuple):
    iou: float  # area shared over area of either
    mean_mm: float  # between the outlines, both ways
    hausdorff_mm: float  # the largest distance of a point of one from the other
    iou_touched: float  # over the cells that were touched alone


def score_shape(fused: HeightMap, shape: np.ndarray, true: np.ndarray, line: Contour) -> ShapeScore:
    """Of a shape (K, K) with the true one (K, K), whose outline is `line`. Infinite distances where the shape is empty."""
    felt = ~np.isnan(fused.value)
    iou, iou_felt = _iou(shape, true), _iou(shape & felt, true & felt)
    curves = find_contours(np.pad(shape, 1).astype(float), 0.5)
    if not curves:
        return ShapeScore(iou, float("inf"), float("inf"), iou_felt)
    outline = fused.line[0] + CELL_MM * (np.concatenate(curves)[:, ::-1] - 1)
    there, back = measure_contour_distances(line, outline), cKDTree(outline).query(line.points)[0]
    return ShapeScore(
        iou, float((there.mean() + back.mean()) / 2), float(max(there.max(), back.max())), iou_felt
    )


def _iou(shape: np.ndarray, true: np.ndarray) -> float:
    either = np.count_nonzero(shape | true)
    return float(np.count_nonzero(shape & true) / either) if either else 0.0
