"""Whole objects (paper section 4.4): the contact geometries along a walk, fused onto a grid, and the shape that they enclose.

Each step tells how far the skin is pressed in around the sensor. Put where the sensor was, averaged over all steps that touched a
cell, these heights make a band along the outline: high over the object, low beside it. What a closed band surrounds is the
object.

Read `fuse`, then `filled_shape`.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.interpolate import griddata
from scipy.spatial import cKDTree
from skimage.measure import find_contours

from jaxunshear.applications.contour import Outline
from jaxunshear.scene.sensor import Sensor, pin_tips

CELL_MM = 0.5
NEAR_MM = 6.0  # from the sensor's axis: farther out the dome curves away from what lies under it
GAP_MM = 1.5  # cells this near to a touched one are interpolated
LEAST = 1e-3  # weight of a cell that counts as touched


class Fused(NamedTuple):
    """Heights on a square grid, rows along y; NaN where nothing was touched."""

    x: np.ndarray  # (K,) mm, target frame
    y: np.ndarray  # (K,)
    height: np.ndarray  # (K, K)


def skin_places(sensor: Sensor) -> np.ndarray:
    """(P, 2) mm in the sensor frame: the outer face of the undeformed skin above each pin, seen from above."""
    centre = np.array([0, 0, sensor.dome_radius_mm])
    outward = pin_tips(sensor) - centre
    return sensor.dome_radius_mm * outward[:, :2] / np.linalg.norm(outward, axis=-1, keepdims=True)


def nearness(place: np.ndarray) -> np.ndarray:
    """(P,) weights of pins at (P, 2) mm from the sensor's axis: 1 there, and 0 from NEAR_MM on."""
    return np.maximum(1 - np.sum(place**2, axis=-1) / NEAR_MM**2, 0)


def to_target(point: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Places (P, 2) mm of the sensor frame, seen from points (T, 3) x, y mm and yaw deg: (T, P, 2) mm of the target frame."""
    yaw = np.radians(point[:, 2])[:, None]
    x = point[:, 0, None] + np.cos(yaw) * place[:, 0] - np.sin(yaw) * place[:, 1]
    y = point[:, 1, None] + np.sin(yaw) * place[:, 0] + np.cos(yaw) * place[:, 1]
    return np.stack([x, y], -1)


def fuse(sensor: Sensor, point: np.ndarray, height: np.ndarray) -> Fused:
    """Heights (T, P) felt at points (T, 3) x, y mm and yaw deg, averaged over the cells of a grid around them all.

    Rows with NaN heights (an image whose pins were not identified) are left out. Cells between are interpolated linearly.
    """
    told = ~np.isnan(height).any(axis=-1) & ~np.isnan(point[:, 0])
    place = skin_places(sensor)
    x, y = np.moveaxis(to_target(point[told], place), -1, 0)
    weight = np.broadcast_to(nearness(place), x.shape)
    reach = np.abs(point[told, :2]).max(initial=0.0) + sensor.dome_radius_mm
    edges = np.arange(-reach, reach + CELL_MM, CELL_MM)
    total = np.histogram2d(y.ravel(), x.ravel(), (edges, edges), weights=weight.ravel())[0]
    summed = np.histogram2d(y.ravel(), x.ravel(), (edges, edges), weights=(weight * height[told]).ravel())[0]
    touched = total > LEAST
    mean = np.divide(summed, total, out=np.full(total.shape, np.nan), where=touched)
    middle = (edges[1:] + edges[:-1]) / 2
    return Fused(middle, middle, _without_gaps(mean, touched))


def _without_gaps(mean: np.ndarray, touched: np.ndarray) -> np.ndarray:
    gaps = ~touched & (ndimage.distance_transform_edt(~touched) <= GAP_MM / CELL_MM)
    if np.count_nonzero(touched) < 4 or not gaps.any():
        return mean
    filled = mean.copy()
    filled[gaps] = griddata(np.argwhere(touched), mean[touched], np.argwhere(gaps), "linear")
    return filled


def filled_shape(fused: Fused, threshold: float) -> np.ndarray:
    """(K, K) bool: cells pressed in by more than `threshold`, and all that they surround but for what was felt to be free."""
    felt = ~np.isnan(fused.height)
    solid = felt & (np.nan_to_num(fused.height) > threshold)
    return ndimage.binary_fill_holes(solid) & ~(felt & ~solid)


class Likeness(NamedTuple):
    iou: float  # area shared over area of either
    mean_mm: float  # between the outlines, both ways
    hausdorff_mm: float  # the largest distance of a point of one from the other


def likeness(fused: Fused, shape: np.ndarray, true: np.ndarray, line: Outline) -> Likeness:
    """Of a shape (K, K) with the true one (K, K), whose outline is `line`. Infinite distances where the shape is empty."""
    either = np.count_nonzero(shape | true)
    iou = np.count_nonzero(shape & true) / either if either else 0.0
    curves = find_contours(np.pad(shape, 1).astype(float), 0.5)
    if not curves:
        return Likeness(iou, float("inf"), float("inf"))
    outline = fused.x[0] + CELL_MM * (np.concatenate(curves)[:, ::-1] - 1)
    there, back = cKDTree(line.points).query(outline)[0], cKDTree(outline).query(line.points)[0]
    return Likeness(float(iou), float((there.mean() + back.mean()) / 2), float(max(there.max(), back.max())))


def best_threshold(height: np.ndarray, inside: np.ndarray, weight: np.ndarray) -> float:
    """The height (mm) that parts skin over the object from skin beside it: heights (N, P), inside (N, P) bool, weights (P,).

    Both sides count the same; NaN heights are left out.
    """
    told = ~np.isnan(height)
    values, solid = height[told], inside[told]
    share = np.broadcast_to(weight, height.shape)[told]
    order = np.argsort(values)
    values, solid, share = values[order], solid[order], share[order]
    over = np.where(solid, share, 0) / np.sum(share[solid])
    beside = np.where(solid, 0, share) / np.sum(share[~solid])
    missed = np.cumsum(over) + 1 - np.cumsum(beside)  # of a threshold just above each value
    return float(values[np.argmin(missed)])
