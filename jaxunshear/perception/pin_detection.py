"""Detect the pins of a binary image: components of a pin's size, split where pins touch."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree
from skimage.feature import peak_local_max
from skimage.segmentation import watershed

# A component of more than this times the usual pin's area, or length, may be several pins.
MERGED_AREA = 1.45
MERGED_LENGTH = 1.6
# Of the usual pin's area: a pin that something touches or partly hides is outside.
SINGLE_AREA_RANGE = (0.65, 1.35)
PIN_AREA_RANGE = (0.4, 3)  # of the usual pin's area; specks and blobs are outside
MASK_EDGE_SHARE = 0.47  # of the image's height: radius from which a pixel is at the mask's edge
MIN_CLUSTER = 10  # points below which no distance is usual


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
    return _detect(image, _split_at_waists)


def detect_pins_fast(image: np.ndarray) -> Float[np.ndarray, "N 2"]:
    """Find pins like `detect_pin_centres` in a third of the time, and in a tenth for noise.

    Pins that touch are put in a row of equal steps, a fraction of a pixel off. That is enough for
    what many pins have in common.
    """
    return _detect(image, _split_in_row).pins


def _detect(image: np.ndarray, split: "_Split") -> DetectedPins:
    image = np.asarray(image)
    if image.ndim != 2:
        raise ValueError(f"detect_pin_centres takes one image (S, S), got shape {image.shape}")
    components = _find_components(image > (127 if image.dtype == np.uint8 else 0.5))
    short = components.length < len(image) / 5  # the housing ring is longer
    at_edge = np.zeros(len(short) + 1, bool)
    at_edge[components.labels.ravel()[_find_edge_pixels(*components.labels.shape)]] = True
    candidate = short & ~at_edge[1:]
    mask = np.append(False, short)[components.labels]
    if not candidate.any():
        return DetectedPins(np.zeros((0, 2)), mask=mask)
    (centre, area), single_count = _split_blobs(components, np.flatnonzero(candidate), split)
    usual = _compute_usual_area(area)
    is_single = (np.arange(len(area)) < single_count) & _is_in_range(area, usual, SINGLE_AREA_RANGE)
    pins = np.flatnonzero(_is_in_range(area, usual, PIN_AREA_RANGE))
    pins = pins[find_clusters(centre[pins])]
    return DetectedPins(centre[pins], is_single[pins], mask, float(np.sqrt(usual / np.pi)))


class _Components(NamedTuple):
    """Connected components of an image, numbered from 1 in `labels`; row k is component k + 1."""

    labels: np.ndarray  # (S, S)
    boxes: list[tuple[slice, slice]]  # rows and columns
    centre: np.ndarray  # (N, 2) px as (column, row)
    area: np.ndarray  # (N,) px
    length: np.ndarray  # (N,) px, of the longer side of the box


# (components, number of one, px diameter of the usual pin) -> the pins that touch in it
_Split = Callable[[_Components, int, float], MeasuredPins]


def _find_components(white: np.ndarray) -> _Components:
    labels, count = ndimage.label(white)
    boxes = ndimage.find_objects(labels)
    lengths = [max(rows.stop - rows.start, columns.stop - columns.start) for rows, columns in boxes]
    return _Components(labels, boxes, *_measure_parts(labels, count), np.array(lengths))


def _measure_parts(labels: np.ndarray, count: int) -> MeasuredPins:
    white = np.flatnonzero(labels)
    rows, columns = np.divmod(white, labels.shape[1])
    number = labels.ravel()[white] - 1
    area = np.bincount(number, None, count)
    row, column = np.bincount(number, rows, count), np.bincount(number, columns, count)
    return MeasuredPins(np.stack([column, row], -1) / area[:, None], area)


@lru_cache(maxsize=8)
def _find_edge_pixels(height: int, width: int) -> np.ndarray:
    """Find the pixels (flat indices) at the edge of an image's circular mask, or beyond."""
    rows, columns = np.arange(height) - (height - 1) / 2, np.arange(width) - (width - 1) / 2
    return np.flatnonzero(np.hypot(rows[:, None], columns) >= MASK_EDGE_SHARE * height)


def _compute_usual_area(area: np.ndarray) -> float:
    return float(np.median(area[area >= 0.25 * np.median(area)]))


def _is_in_range(area: np.ndarray, usual: float, limits: tuple[float, float]) -> np.ndarray:
    return (area > limits[0] * usual) & (area < limits[1] * usual)


def _split_blobs(
    components: _Components, rows: np.ndarray, split: _Split
) -> tuple[MeasuredPins, int]:
    """Split those of the components `rows` in which several pins may touch.

    Also returns how many of the first pins are components of their own.
    """
    centre, area = components.centre[rows], components.area[rows]
    usual = _compute_usual_area(area)
    diameter = 2 * np.sqrt(usual / np.pi)
    is_long = components.length[rows] > MERGED_LENGTH * diameter
    merged = (area > MERGED_AREA * usual) | is_long
    pieces = [split(components, number, diameter) for number in 1 + rows[merged]]
    centre = np.concatenate([centre[~merged], *(piece.centre for piece in pieces)])
    area = np.concatenate([area[~merged], *(piece.area for piece in pieces)])
    return MeasuredPins(centre, area), int(np.sum(~merged))


def _split_at_waists(components: _Components, number: int, diameter: float) -> MeasuredPins:
    """Split a component at the watersheds of its smoothed distance to the black."""
    rows, columns = components.boxes[number - 1]
    white = np.pad(components.labels[rows, columns] == number, 2)
    smooth = ndimage.gaussian_filter(ndimage.distance_transform_edt(white), 0.3 + 0.1 * diameter)
    peaks = peak_local_max(
        smooth,
        min_distance=max(1, round(0.8 + 0.3 * diameter)),
        labels=white.astype(int),
        exclude_border=False,
    )
    markers = np.zeros(white.shape, int)
    markers[tuple(peaks.T)] = np.arange(1, len(peaks) + 1)
    pieces = _measure_parts(watershed(-smooth, markers, mask=white), len(peaks))
    corner = np.array([columns.start - 2, rows.start - 2])
    return pieces._replace(centre=pieces.centre + corner)


def _split_in_row(components: _Components, number: int, diameter: float) -> MeasuredPins:
    """Replace a component by equal discs along its longer axis.

    Together they have its area and its second moment.
    """
    rows, columns = components.boxes[number - 1]
    row, column = np.nonzero(components.labels[rows, columns] == number)
    row, column, area = row + rows.start, column + columns.start, len(row)
    centre = components.centre[number - 1]
    count = max(1, round(4 * area / (np.pi * diameter**2)))
    if count == 1:
        return MeasuredPins(centre[None], np.array([float(area)]))
    x, y = column - centre[0], row - centre[1]
    angle = 0.5 * np.arctan2(2 * np.mean(x * y), np.mean(x**2) - np.mean(y**2))
    axis = np.array([np.cos(angle), np.sin(angle)])
    along_axis = np.mean((x * axis[0] + y * axis[1]) ** 2)
    spacing = np.sqrt(max(along_axis - diameter**2 / 16, 0.0) * 12 / (count**2 - 1))
    steps = spacing * (np.arange(count) - (count - 1) / 2)
    return MeasuredPins(centre + steps[:, None] * axis, np.full(count, area / count))


def find_clusters(centre: Float[np.ndarray, "N 2"]) -> Int[np.ndarray, "M"]:
    """Find the rows of points that are near two others.

    The limit is twice the usual distance between neighbours, and 1.5 times on the outline, where
    glints of the housing lie and the skin hardly stretches.
    """
    rows = np.arange(len(centre))
    distance = _measure_two_nearest(centre)
    for outline_only in (False, True, True):
        if len(rows) < MIN_CLUSTER:
            return rows
        usual = np.median(distance)
        lonely = distance[:, 1] > (1.5 if outline_only else 2) * usual
        if outline_only and lonely.any():
            lonely &= np.isin(np.arange(len(rows)), find_hull(centre[rows]))
        if lonely.any():
            rows = rows[~lonely]
            distance = _measure_two_nearest(centre[rows])
    return rows


def find_hull(points: Float[np.ndarray, "N 2"]) -> Int[np.ndarray, "M"]:
    """Find the rows of the corners of the convex hull.

    There are none if the points are too few, or all on one line.
    """
    try:
        return ConvexHull(points).vertices
    except QhullError:
        return np.zeros(0, int)


def _measure_two_nearest(centre: np.ndarray) -> np.ndarray:
    """Measure the distances (N, 2) px from each point (N, 2) to the nearest two others."""
    return cKDTree(centre).query(centre, k=3)[0][:, 1:]
