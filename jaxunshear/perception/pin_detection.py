"""Pins of a binary image: parts of their size, in each other's company, parted where they touch."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree
from skimage.feature import peak_local_max
from skimage.segmentation import watershed

# A part of more than this times the usual pin's area, or length, may be several pins that touch.
MERGED_AREA = 1.45
MERGED_LENGTH = 1.6
SINGLE_AREA_RANGE = (
    0.65,
    1.35,
)  # of the usual pin's area: a pin that something touches, or hides in part, is off by more


class DetectedPins(NamedTuple):
    """The pins of an image, and what is needed to search again."""

    pins: np.ndarray  # (N, 2) px, centroids as (column, row)
    is_single: np.ndarray | None = None  # (N,) bool: a part of its own, of a pin's usual size
    mask: np.ndarray | None = (
        None  # (S, S) bool, without parts as long as those of the housing ring
    )
    radius: float = 0.0  # px, of the usual pin; 0 where there is none


def find_pins(image: np.ndarray) -> Float[np.ndarray, "N 2"]:
    """Binary (or nearly binary) image (S, S), uint8 of {0, 255} or in [0, 1] -> centroids px as (column, row).

    Pins that touch are parted at the waist. The housing ring and specks are left out: they are too long, too large,
    too small or too far from other pins.
    """
    return detect_pins(image).pins


def detect_pins(image: np.ndarray) -> DetectedPins:
    """`find_pins`, with what it saw."""
    return _detect(image, _split_touching)


def detect_pins_fast(image: np.ndarray) -> Float[np.ndarray, "N 2"]:
    """`find_pins` in a third of the time, and in a tenth for noise: pins that touch are set in a row of equal steps, a fraction of a pixel
    off. Good for what many pins have in common."""
    return _detect(image, _split_in_row).pins


def _detect(image: np.ndarray, part: "_SplitComponent") -> DetectedPins:
    image = np.asarray(image)
    if image.ndim != 2:
        raise ValueError(f"find_pins takes one image (S, S), got shape {image.shape}")
    parts = _find_components(image > (127 if image.dtype == np.uint8 else 0.5))
    short = parts.length < len(image) / 5
    kept = short & _is_inside_mask(parts)
    white = np.append(False, short)[parts.labels]
    if not kept.any():
        return DetectedPins(np.zeros((0, 2)), mask=white)
    centre, area = parts.centre[kept], parts.area[kept]
    usual = _compute_usual_area(area)
    diameter = 2 * np.sqrt(usual / np.pi)
    merged = (area > MERGED_AREA * usual) | (parts.length[kept] > MERGED_LENGTH * diameter)
    pieces = [part(parts, number, diameter) for number in 1 + np.flatnonzero(kept)[merged]]
    centre = np.concatenate([centre[~merged], *(piece[0] for piece in pieces)])
    area = np.concatenate([area[~merged], *(piece[1] for piece in pieces)])
    usual = _compute_usual_area(area)
    single = (
        (np.arange(len(area)) < np.sum(~merged))
        & (area > SINGLE_AREA_RANGE[0] * usual)
        & (area < SINGLE_AREA_RANGE[1] * usual)
    )
    pins = np.flatnonzero((area > 0.4 * usual) & (area < 3 * usual))
    pins = pins[find_clustered(centre[pins])]
    return DetectedPins(centre[pins], single[pins], white, float(np.sqrt(usual / np.pi)))


class _Components(NamedTuple):
    """Connected parts of an image, numbered from 1 in `labels`; row k of the others is part k + 1."""

    labels: np.ndarray  # (S, S)
    boxes: list[tuple[slice, slice]]  # rows and columns
    centre: np.ndarray  # (N, 2) px as (column, row)
    area: np.ndarray  # (N,) px
    length: np.ndarray  # (N,) px, of the longer side of the box


# (parts, number of one, px diameter of the usual pin) -> centroids (K, 2) px and areas (K,) px of the pins that touch in it
_SplitComponent = Callable[[_Components, int, float], tuple[np.ndarray, np.ndarray]]


def _find_components(white: np.ndarray) -> _Components:
    labels, count = ndimage.label(white)
    boxes = ndimage.find_objects(labels)
    length = np.array(
        [max(rows.stop - rows.start, columns.stop - columns.start) for rows, columns in boxes]
    )
    return _Components(labels, boxes, *_centres(labels, count), length)


def _centres(labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Centroids (count, 2) px as (column, row) and areas (count,) of the parts 1 to count."""
    white = np.flatnonzero(labels)
    rows, columns = np.divmod(white, labels.shape[1])
    number = labels.ravel()[white] - 1
    area, row, column = (np.bincount(number, weights, count) for weights in (None, rows, columns))
    return np.stack([column, row], -1) / area[:, None], area


def _is_inside_mask(parts: _Components) -> np.ndarray:
    """(N,) bool: parts that do not reach the edge of the circular mask."""
    at_edge = np.zeros(len(parts.area) + 1, bool)
    at_edge[parts.labels.ravel()[_edge(*parts.labels.shape)]] = True
    return ~at_edge[1:]


@lru_cache(maxsize=8)
def _edge(height: int, width: int) -> np.ndarray:
    """Flat places of the pixels of an image at the edge of the circular mask, or beyond."""
    rows, columns = np.arange(height) - (height - 1) / 2, np.arange(width) - (width - 1) / 2
    return np.flatnonzero(np.hypot(rows[:, None], columns) >= 0.47 * height)


def _compute_usual_area(area: np.ndarray) -> float:
    return float(np.median(area[area >= 0.25 * np.median(area)]))


def _split_touching(
    parts: _Components, number: int, diameter: float
) -> tuple[np.ndarray, np.ndarray]:
    """One part cut at its waists, the watersheds of a smoothed distance to the black: centroids and areas of the pieces."""
    rows, columns = parts.boxes[number - 1]
    white = np.pad(parts.labels[rows, columns] == number, 2)
    smooth = ndimage.gaussian_filter(ndimage.distance_transform_edt(white), 0.3 + 0.1 * diameter)
    apart = max(1, round(0.8 + 0.3 * diameter))
    peaks = peak_local_max(
        smooth, min_distance=apart, labels=white.astype(int), exclude_border=False
    )
    markers = np.zeros(white.shape, int)
    markers[tuple(peaks.T)] = np.arange(1, len(peaks) + 1)
    centre, area = _centres(watershed(-smooth, markers, mask=white), len(peaks))
    return centre + np.array([columns.start - 2, rows.start - 2]), area


def _split_in_row(
    parts: _Components, number: int, diameter: float
) -> tuple[np.ndarray, np.ndarray]:
    """One part as equal discs along its longer axis, of its area and its second moment in all: centroids and areas."""
    rows, columns = parts.boxes[number - 1]
    row, column = np.nonzero(parts.labels[rows, columns] == number)
    row, column, area = row + rows.start, column + columns.start, len(row)
    centre = parts.centre[number - 1]
    count = max(1, round(4 * area / (np.pi * diameter**2)))
    if count == 1:
        return centre[None], np.array([float(area)])
    x, y = column - centre[0], row - centre[1]
    angle = 0.5 * np.arctan2(2 * np.mean(x * y), np.mean(x**2) - np.mean(y**2))
    axis = np.array([np.cos(angle), np.sin(angle)])
    apart = np.sqrt(
        max(np.mean((x * axis[0] + y * axis[1]) ** 2) - diameter**2 / 16, 0.0) * 12 / (count**2 - 1)
    )
    steps = apart * (np.arange(count) - (count - 1) / 2)
    return centre + steps[:, None] * axis, np.full(count, area / count)


def find_clustered(centre: Float[np.ndarray, "N 2"]) -> Int[np.ndarray, "M"]:
    """Rows of those points that are near two others: within twice the usual distance between neighbours.

    On the outline, where glints of the housing lie and the skin hardly stretches, within 1.5 times.
    """
    kept = np.arange(len(centre))
    distance = _to_two_nearest(centre)
    for outline_only in (False, True, True):
        if len(kept) < 10:
            return kept
        usual = np.median(distance)
        lonely = distance[:, 1] > (1.5 if outline_only else 2) * usual
        if outline_only and lonely.any():
            lonely &= np.isin(np.arange(len(kept)), find_hull(centre[kept]))
        if lonely.any():
            kept = kept[~lonely]
            distance = _to_two_nearest(centre[kept])
    return kept


def find_hull(points: Float[np.ndarray, "N 2"]) -> Int[np.ndarray, "M"]:
    """Rows of the corners of their convex hull; none where they are too few, or all on one line."""
    try:
        return ConvexHull(points).vertices
    except QhullError:
        return np.zeros(0, int)


def _to_two_nearest(centre: np.ndarray) -> np.ndarray:
    """(N, 2) px from each point (N, 2) to the next two."""
    return cKDTree(centre).query(centre, k=3)[0][:, 1:]
