"""Pins of a binary image: parts of their size, in each other's company, parted where they touch."""

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree
from skimage.feature import peak_local_max
from skimage.measure import label, regionprops_table
from skimage.segmentation import watershed


def find_pins(image: np.ndarray) -> np.ndarray:
    """Binary (or nearly binary) image (S, S), uint8 of {0, 255} or in [0, 1] -> centroids (N, 2) px as (column, row).

    Pins that touch are parted at the waist. The housing ring and specks are left out: they are too long, too large,
    too small or too far from other pins.
    """
    image = np.asarray(image)
    if image.ndim != 2:
        raise ValueError(f"find_pins takes one image (S, S), got shape {image.shape}")
    white = image > (127 if image.dtype == np.uint8 else 0.5)
    labels = _part(_without_ring(white))
    if not labels.any():
        return np.zeros((0, 2))
    table = regionprops_table(labels, properties=("centroid", "area"))
    centre = np.column_stack([table["centroid-1"], table["centroid-0"]])
    area = table["area"]
    typical = np.median(area[area >= 0.25 * np.median(area)])
    keep = (area > 0.4 * typical) & (area < 3 * typical)
    return in_company(centre[keep])


def _without_ring(white: np.ndarray) -> np.ndarray:
    """Drops parts that reach the edge of the circular mask, and those much longer than pins."""
    parts = label(white, connectivity=1)
    index = np.arange(1, parts.max() + 1)
    if not index.size:
        return white
    rows, columns = np.indices(white.shape)
    middle_row, middle_column = (np.array(white.shape) - 1) / 2
    reach = ndimage.maximum(np.hypot(rows - middle_row, columns - middle_column), parts, index)
    length = np.array([max(box.stop - box.start for box in part) for part in ndimage.find_objects(parts)])
    return np.isin(parts, index[(reach < 0.47 * white.shape[0]) & (length < white.shape[0] / 5)])


def _part(white: np.ndarray) -> np.ndarray:
    """Labels (S, S): connected parts, those of several pins cut at their waists (a smoothed distance to the black)."""
    parts = label(white, connectivity=1)
    area = np.bincount(parts.ravel())[1:]
    if not area.size:
        return parts
    typical = np.median(area[area >= 0.25 * np.median(area)])
    radius = np.sqrt(typical / np.pi)
    smooth = ndimage.gaussian_filter(ndimage.distance_transform_edt(white), 0.3 + 0.2 * radius)
    peaks = peak_local_max(smooth, min_distance=max(1, round(0.8 + 0.6 * radius)), labels=parts, exclude_border=False)
    markers = np.zeros_like(parts)
    markers[tuple(peaks.T)] = np.arange(1, len(peaks) + 1)
    return watershed(-smooth, markers, mask=white)


def in_company(centre: np.ndarray) -> np.ndarray:
    """Keeps of points (N, 2) those near two others: within twice the usual distance between neighbours.

    On the outline, where glints of the housing lie and the skin hardly stretches, within 1.5 times.
    """
    for outline_only in (False, True, True):
        if len(centre) < 10:
            return centre
        distance = cKDTree(centre).query(centre, k=3)[0]
        usual = np.median(distance[:, 1:])
        if outline_only:
            lonely = np.zeros(len(centre), bool)
            try:
                outline = ConvexHull(centre).vertices
            except QhullError:  # all on one line: no outline to speak of
                return centre
            lonely[outline] = distance[outline, 2] > 1.5 * usual
        else:
            lonely = distance[:, 2] > 2 * usual
        centre = centre[~lonely]
    return centre
