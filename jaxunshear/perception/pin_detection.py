"""Detect the pins of a binary image: components of a pin's size, split where pins touch."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree
from skimage.segmentation import watershed

# A component of more than this times the usual pin's area, or length, may be several pins.
MERGED_AREA = 1.45
MERGED_LENGTH = 1.6
# Of the usual pin's area: a pin that something touches or partly hides is outside.
SINGLE_AREA_RANGE = (0.65, 1.35)
PIN_AREA_RANGE = (0.4, 3)  # of the usual pin's area; specks and blobs are outside
MASK_EDGE_SHARE = 0.47  # of the image's height: radius from which a pixel is at the mask's edge
MIN_CLUSTER = 10  # points below which no distance is usual
CLUSTER_NEIGHBOURS = 4  # of a point, of which two belong to its cluster


class DetectedPins(NamedTuple):
    """The pins of an image, and what is needed to search for missing ones."""

    pins: np.ndarray  # (N, 2) px, centroids as (column, row)
    is_single: np.ndarray | None = None  # (N,) bool: a component of its own, of the usual size
    mask: np.ndarray | None = None  # (S, S) bool, without components as long as the housing ring's
    radius: float = 0.0  # px, of the usual pin; 0 if there is none


class MeasuredPins(NamedTuple):
    """Centroids (K, 2) px as (column, row) and areas (K,) px of pins."""

    centre: np.ndarray
    area: np.ndarray


def detect_pin_centres(image: np.ndarray) -> Float[np.ndarray, "N 2"]:
    """Find the centroids px, as (column, row), of the pins in a binary image.

    The image (S, S) is uint8 of {0, 255} or in [0, 1], binary or nearly so. Pins that touch are
    split at the waist. The housing ring and specks are left out: they are too long, too large, too
    small or too far from other pins.
    """
    return detect_pins(image).pins


def detect_pins(image: np.ndarray) -> DetectedPins:
    """Detect pins like `detect_pin_centres`, with what is needed to search for missing ones."""
    image = np.asarray(image)
    if image.ndim != 2:
        raise ValueError(f"detect_pin_centres takes one image (S, S), got shape {image.shape}")
    parts = _find_components(image > (127 if image.dtype == np.uint8 else 0.5))
    length = parts.size.max(axis=0)
    short = length < len(image) / 5  # the housing ring is longer
    at_edge = np.zeros(len(short) + 1, bool)
    at_edge[parts.labels.ravel()[_find_edge_pixels(*parts.labels.shape)]] = True
    candidate = short & ~at_edge[1:]
    mask = np.append(False, short).take(parts.labels)
    if not candidate.any():
        return DetectedPins(np.zeros((0, 2)), mask=mask)
    usual = _compute_usual_area(parts.area[candidate])
    diameter = 2 * np.sqrt(usual / np.pi)
    is_large = (length > MERGED_LENGTH * diameter) | (parts.area > MERGED_AREA * usual)
    merged = candidate & is_large
    pieces = _split_at_waists(parts, merged, diameter)
    lone = candidate & ~merged
    centre = np.concatenate([parts.centre[lone], pieces.centre])
    area = np.concatenate([parts.area[lone], pieces.area])
    usual = _compute_usual_area(area)
    is_single = _is_in_range(area, usual, SINGLE_AREA_RANGE)
    is_single[lone.sum() :] = False
    pins = np.flatnonzero(_is_in_range(area, usual, PIN_AREA_RANGE))
    pins = pins[find_clusters(centre[pins])]
    return DetectedPins(centre[pins], is_single[pins], mask, float(np.sqrt(usual / np.pi)))


class _Components(NamedTuple):
    """Connected components of an image, and its white pixels."""

    labels: np.ndarray  # (S, S) number of the component, from 1
    row: np.ndarray  # (W,) of the white pixels, row by row
    column: np.ndarray  # (W,)
    part: np.ndarray  # (W,) component, from 0
    low: np.ndarray  # (2, N) px, least row and column
    size: np.ndarray  # (2, N) px, rows and columns
    centre: np.ndarray  # (N, 2) px as (column, row)
    area: np.ndarray  # (N,) px


def _find_components(white: np.ndarray) -> _Components:
    labels, count = ndimage.label(white)
    pixels = np.flatnonzero(white)
    row, column = np.divmod(pixels, white.shape[1])
    part = labels.ravel()[pixels] - 1
    low, high = np.full((2, count), max(white.shape)), np.zeros((2, count), int)
    for axis, place in enumerate((row, column)):
        np.minimum.at(low[axis], part, place)
        np.maximum.at(high[axis], part, place)
    size = high + 1 - low
    measured = _measure_parts(row, column, part, count)
    return _Components(labels, row, column, part, low, size, *measured)


def _measure_parts(
    row: np.ndarray, column: np.ndarray, part: np.ndarray, count: int
) -> MeasuredPins:
    """Measure parts, from 0, of the white pixels (W,)."""
    area = np.bincount(part, None, count)
    moment = [np.bincount(part, place, count) for place in (column, row)]
    return MeasuredPins(np.stack(moment, -1) / area[:, None], area)


@lru_cache(maxsize=8)
def _find_edge_pixels(height: int, width: int) -> np.ndarray:
    """Find the pixels (flat indices) at the edge of an image's circular mask, or beyond."""
    rows, columns = np.arange(height) - (height - 1) / 2, np.arange(width) - (width - 1) / 2
    return np.flatnonzero(np.hypot(rows[:, None], columns) >= MASK_EDGE_SHARE * height)


def _compute_usual_area(area: np.ndarray) -> float:
    return compute_median(area[area >= 0.25 * compute_median(area)])


def compute_median(values: np.ndarray) -> float:
    """Compute the median of values (N,); `numpy.median` spends most of its time on checks."""
    ordered, middle = np.sort(values), len(values) // 2
    return float(ordered[middle - 1 + len(values) % 2] + ordered[middle]) / 2


def _is_in_range(area: np.ndarray, usual: float, limits: tuple[float, float]) -> np.ndarray:
    return (area > limits[0] * usual) & (area < limits[1] * usual)


def _split_at_waists(parts: _Components, merged: np.ndarray, diameter: float) -> MeasuredPins:
    """Split the `merged` (N,) components at the watersheds of their smoothed distance to the black.

    They are laid side by side on one canvas, which takes a tenth of the time of one by one.
    """
    if not merged.any():
        return MeasuredPins(np.zeros((0, 2)), np.zeros(0))
    sigma = 0.3 + 0.1 * diameter
    gap = int(4 * sigma + 0.5)  # the filter's radius
    pixels = np.flatnonzero(merged[parts.part])
    row, column, part = parts.row[pixels], parts.column[pixels], parts.part[pixels]
    height, width = np.where(merged, parts.size + gap, 0)
    left = np.cumsum(width) - width
    place = row - parts.low[0, part] + gap, column - parts.low[1, part] + left[part] + gap
    white = np.zeros((height.max() + gap, width.sum() + gap), bool)
    white[place] = True
    smooth = ndimage.gaussian_filter(ndimage.distance_transform_edt(white), sigma) * white
    peaks = _find_peaks(smooth, max(1, round(0.8 + 0.3 * diameter)))
    markers = np.zeros(white.shape, int)
    markers[tuple(peaks.T)] = np.arange(1, len(peaks) + 1)
    # of equal peaks the first is flooded first, whatever other components are on the canvas
    smooth[tuple(peaks.T)] += 1e-9 * np.arange(len(peaks), 0, -1)
    pieces = watershed(-smooth, markers, mask=white)[place] - 1
    return _measure_parts(row, column, pieces, len(peaks))


def _find_peaks(smooth: np.ndarray, distance: int) -> np.ndarray:
    """Find the peaks (K, 2), as (row, column), that are the highest within `distance` px.

    Of equal ones nearer to each other the first is a peak.
    """
    highest = ndimage.maximum_filter(smooth, 2 * distance + 1)
    peaks = np.argwhere((smooth == highest) & (smooth > 0))
    kept = np.ones(len(peaks), bool)
    for first, second in sorted(cKDTree(peaks).query_pairs(distance - 0.5, p=np.inf)):
        kept[second] &= not kept[first]
    return peaks[kept]


def find_clusters(centre: Float[np.ndarray, "N 2"]) -> Int[np.ndarray, "M"]:
    """Find the rows of points that are near two others.

    The limit is twice the usual distance between neighbours, and 1.5 times on the outline, where
    glints of the housing lie and the skin hardly stretches.
    """
    if len(centre) < MIN_CLUSTER:
        return np.arange(len(centre))
    distance, near = cKDTree(centre).query(centre, k=CLUSTER_NEIGHBOURS + 1)
    distance, near = distance[:, 1:], near[:, 1:]
    kept = np.ones(len(centre), bool)
    for outline_only in (False, True, True):
        rows = np.flatnonzero(kept)
        if len(rows) < MIN_CLUSTER:
            break
        is_kept = kept[near[rows]]
        two = distance[rows][:, :2]
        if not is_kept[:, :2].all():
            two = np.sort(np.where(is_kept, distance[rows], np.inf), axis=1)[:, :2]
        lonely = two[:, 1] > (1.5 if outline_only else 2) * compute_median(two.ravel())
        if outline_only and lonely.any():
            lonely[lonely] = _are_corners(centre[rows], centre[rows[lonely]])
        kept[rows[lonely]] = False
    return np.flatnonzero(kept)


def _are_corners(points: np.ndarray, tested: np.ndarray) -> np.ndarray:
    """Return which (M,) of the points `tested` (M, 2) are corners of the hull of all (N, 2).

    From a corner all others are seen within half a turn. For a few points this takes less time
    than the hull.
    """
    x, y = np.moveaxis(points - tested[:, None], -1, 0)
    middle_x, middle_y = (points.mean(axis=0) - tested).T[..., None]
    along = middle_x * x + middle_y * y + 0.0  # of the point itself 0, never -0
    angle = np.arctan2(middle_x * y - middle_y * x, along)
    return np.ptp(angle, axis=1) < np.pi


def find_hull(points: Float[np.ndarray, "N 2"]) -> Int[np.ndarray, "M"]:
    """Find the rows of the corners of the convex hull.

    There are none if the points are too few, or all on one line.
    """
    try:
        return ConvexHull(points).vertices
    except QhullError:
        return np.zeros(0, int)
