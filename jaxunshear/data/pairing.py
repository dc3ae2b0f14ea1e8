"""Pair recorded slides with taps, or with images drawn in their place. Pure functions of arrays.

rows, distance = find_nearest(targets, slide_poses, tap_poses)
images = warp_images(tap_images, motion, interpolate_over_pixels(rest, spacing_px, size))
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import Delaunay, cKDTree

from jaxunshear.angles import wrap_degrees
from jaxunshear.config.targets import RECORDED_FIELDS, Targets

# Of the pins' spacing: how far beyond the outermost pins an image moves with them.
MAX_OUTSIDE_SPACINGS = 0.75
SAME_POSE = 1e-3  # mm and deg: labels of one `pose_id` that differ by more are of different poses


def compute_pose_gaps(slides: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Return absolute differences of poses (N, 6), angles the short way round."""
    difference = taps - np.asarray(slides, np.float64)
    is_angle = np.array([name.endswith("_deg") for name in RECORDED_FIELDS])
    return np.abs(np.where(is_angle, wrap_degrees(difference), difference))


def find_nearest(
    targets: Targets, slides: np.ndarray, taps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find for each slide's pose (N, 6) the row of the nearest tap's (M, 6), and their distance.

    Distances (N,) are in units of the targets' ranges.
    """
    distance, rows = cKDTree(_scale_poses(targets, taps)).query(_scale_poses(targets, slides))
    return rows, distance


def _scale_poses(targets: Targets, poses: np.ndarray) -> np.ndarray:
    columns: list[np.ndarray] = []
    for target in targets:
        value = np.asarray(poses[:, target.column], np.float64)
        if target.is_circular:
            columns += [np.cos(np.radians(value)), np.sin(np.radians(value))]
        else:
            columns.append((value - target.centre) / target.half_range)
    return np.stack(columns, axis=-1)


def compute_pair_weights(distance: np.ndarray) -> np.ndarray:
    """Return weights (N,) of pairs by the gap between their poses: half at its median, mean 1."""
    weight = 2.0 ** -np.square(distance / max(float(np.median(distance)), 1e-9))
    return (weight / weight.mean()).astype(np.float32)


def match_same_pose(
    slides: np.ndarray,
    slide_ids: np.ndarray,
    taps: np.ndarray,
    tap_ids: np.ndarray,
    checked: bool = True,
) -> np.ndarray:
    """Return for each slide the row (N,) of a tap of the same `pose_id`; -1 if there is none.

    If `checked`, the poses must be the same, too. The slides of a pose take its taps in turn.
    """
    rows_by_id: dict[int, list[int]] = {}
    for row, pose_id in enumerate(tap_ids.tolist()):
        if pose_id >= 0:
            rows_by_id.setdefault(pose_id, []).append(row)
    turns: dict[int, int] = {}
    matches = np.full(len(slides), -1)
    for row, pose_id in enumerate(slide_ids.tolist()):
        candidates = np.array(rows_by_id.get(pose_id, []), int)
        if checked and len(candidates):
            gaps = compute_pose_gaps(slides[row], taps[candidates])
            candidates = candidates[gaps.max(axis=1) <= SAME_POSE]
        if len(candidates):
            turn = turns.get(pose_id, 0)
            matches[row], turns[pose_id] = candidates[turn % len(candidates)], turn + 1
    return matches


class PixelMotion(NamedTuple):
    """How the motions of pins give the motions of pixels.

    They are linear between three pins, and end beyond the outermost ones.
    """

    size: int  # of the images, px
    pins: np.ndarray  # (S S, 3) whose motions give a pixel's
    weights: np.ndarray  # (S S, 3) float32


def interpolate_over_pixels(rest: np.ndarray, spacing_px: float, size: int) -> PixelMotion:
    """Interpolate between pins with rest positions (P, 2) px as (column, row).

    The images have `size` px.
    """
    grid = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1)
    pixels = grid.reshape(-1, 2).astype(float)
    mesh = Delaunay(rest)
    triangle = mesh.find_simplex(pixels)
    pins = mesh.simplices[triangle]
    to_barycentric, origin = mesh.transform[triangle, :2], mesh.transform[triangle, 2]
    first = np.einsum("nij,nj->ni", to_barycentric, pixels - origin)
    weights = np.column_stack([first, 1 - first.sum(axis=1)])
    distance, nearest_pin = cKDTree(rest).query(pixels)
    outside = triangle < 0
    pins[outside], weights[outside] = nearest_pin[outside, None], (1.0, 0.0, 0.0)
    weights[outside & (distance > MAX_OUTSIDE_SPACINGS * spacing_px)] = 0
    return PixelMotion(size, pins, weights.astype(np.float32))


def warp_images(images: np.ndarray, motion: np.ndarray, pixel_motion: PixelMotion) -> np.ndarray:
    """Warp images (N, S, S) uint8 so that their pins move by `motion` (N, P, 2) px.

    The edges of pins become grey, which shows fractions of a pixel.
    """
    size = pixel_motion.size
    rows, columns = np.mgrid[:size, :size].astype(np.float32)
    warped = np.empty_like(images)
    for i, image in enumerate(images):
        pin_motion = motion[i].astype(np.float32)[pixel_motion.pins]
        shift = (pin_motion * pixel_motion.weights[..., None]).sum(axis=1).reshape(size, size, 2)
        sources = [rows - shift[..., 1], columns - shift[..., 0]]
        warped[i] = ndimage.map_coordinates(image, sources, np.uint8, order=1, mode="nearest")
    return warped
