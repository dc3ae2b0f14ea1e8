"""Partners for recorded slides: which tap, or what drawn in its place, a slide is unsheared to. Pure functions of arrays.

rows, gap = find_nearest(targets, slide_poses, tap_poses)
images = drawn(pins, frame, background)
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import Delaunay, cKDTree

from jaxunshear.angles import wrap_degrees
from jaxunshear.config.targets import RECORDED_FIELDS, Targets

MAX_OUTSIDE_SPACINGS = (
    0.75  # of the pins' spacing: how far beyond the outermost pins an image moves with them
)
SAME_POSE = 1e-3  # mm and deg: labels of one `pose_id` that differ by more are not of one pose


def compute_pose_gaps(slides: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Absolute differences of poses (N, 6), angles the short way round."""
    apart = taps - np.asarray(slides, np.float64)
    angle = np.array([name.endswith("_deg") for name in RECORDED_FIELDS])
    return np.abs(np.where(angle, wrap_degrees(apart), apart))


def find_nearest(
    targets: Targets, slides: np.ndarray, taps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """For every slide's pose (N, 6) the row of the nearest tap's (M, 6), in units of the targets' ranges, and that distance (N,)."""
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
    """(N,) weights of pairs by the gap between their poses: half at its median, mean 1."""
    weight = 2.0 ** -np.square(distance / max(float(np.median(distance)), 1e-9))
    return (weight / weight.mean()).astype(np.float32)


def match_same_pose(
    slides: np.ndarray,
    slide_ids: np.ndarray,
    taps: np.ndarray,
    tap_ids: np.ndarray,
    checked: bool = True,
) -> np.ndarray:
    """(N,) row of a tap of the same `pose_id` and, where that is `checked`, the same pose; -1 where there is none.

    The slides of a pose take its taps in turn.
    """
    by_id: dict[int, list[int]] = {}
    for row, own in enumerate(tap_ids.tolist()):
        if own >= 0:
            by_id.setdefault(own, []).append(row)
    taken: dict[int, int] = {}
    found = np.full(len(slides), -1)
    for row, own in enumerate(slide_ids.tolist()):
        of_pose = np.array(by_id.get(own, []), int)
        if checked and len(of_pose):
            of_pose = of_pose[
                compute_pose_gaps(slides[row], taps[of_pose]).max(axis=1) <= SAME_POSE
            ]
        if len(of_pose):
            turn = taken.get(own, 0)
            found[row], taken[own] = of_pose[turn % len(of_pose)], turn + 1
    return found


class PixelMotion(NamedTuple):
    """From motions of pins to motions of pixels: linear between three pins, ending beyond the outermost ones."""

    size: int  # of the images, px
    pins: np.ndarray  # (S S, 3) whose motions a pixel's is made of
    weights: np.ndarray  # (S S, 3) float32


def interpolate_over_pixels(place: np.ndarray, spacing_px: float, size: int) -> PixelMotion:
    """Of pins that stand untouched at `place` (P, 2) px as (column, row), in images of `size` px."""
    pixels = (
        np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1)
        .reshape(-1, 2)
        .astype(float)
    )
    mesh = Delaunay(place)
    corner = mesh.find_simplex(pixels)
    pins = mesh.simplices[corner]
    turn, origin = mesh.transform[corner, :2], mesh.transform[corner, 2]
    first = np.einsum("nij,nj->ni", turn, pixels - origin)
    share = np.column_stack([first, 1 - first.sum(axis=1)])
    off, nearest_pin = cKDTree(place).query(pixels)
    outside = corner < 0
    pins[outside], share[outside] = nearest_pin[outside, None], (1.0, 0.0, 0.0)
    share[outside & (off > MAX_OUTSIDE_SPACINGS * spacing_px)] = 0
    return PixelMotion(size, pins, share.astype(np.float32))


def warp_images(images: np.ndarray, motion: np.ndarray, spread: PixelMotion) -> np.ndarray:
    """Images (N, S, S) uint8 whose pins have moved by `motion` (N, P, 2) px: grey at the edges, which show fractions of a pixel."""
    rows, columns = np.mgrid[: spread.size, : spread.size].astype(np.float32)
    moved = np.empty_like(images)
    for i, image in enumerate(images):
        across = (motion[i].astype(np.float32)[spread.pins] * spread.weights[..., None]).sum(axis=1)
        across = across.reshape(spread.size, spread.size, 2)
        places = [rows - across[..., 1], columns - across[..., 0]]
        moved[i] = ndimage.map_coordinates(image, places, np.uint8, order=1, mode="nearest")
    return moved
