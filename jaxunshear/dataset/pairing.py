"""Partners for recorded slides: which tap, or what drawn in its place, a slide is unsheared to. Pure functions of arrays.

rows, gap = nearest(targets, slide_poses, tap_poses)
images = drawn(pins, frame, background)
"""

from functools import partial

import jax
import numpy as np
from scipy.spatial import cKDTree

from jaxunshear.image.dots import dots
from jaxunshear.targets import RECORDED, Targets

DRAWN_AT_ONCE = 64
SAME_POSE = 1e-3  # mm and deg: labels of one `pose_id` that differ by more are not of one pose


_dots = partial(jax.jit, static_argnums=(1, 2))(dots)


def gaps(slides: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Absolute differences of poses (N, 6), angles the short way round."""
    apart = np.asarray(slides, np.float64) - taps
    angle = np.array([name.endswith("_deg") for name in RECORDED])
    return np.abs(np.where(angle, (apart + 180) % 360 - 180, apart))


def nearest(targets: Targets, slides: np.ndarray, taps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For every slide's pose (N, 6) the row of the nearest tap's (M, 6), in units of the targets' ranges, and that distance (N,)."""
    distance, rows = cKDTree(_scaled(targets, taps)).query(_scaled(targets, slides))
    return rows, distance


def _scaled(targets: Targets, poses: np.ndarray) -> np.ndarray:
    columns: list[np.ndarray] = []
    for target in targets:
        value = np.asarray(poses[:, target.column], np.float64)
        if target.circle:
            columns += [np.cos(np.radians(value)), np.sin(np.radians(value))]
        else:
            columns.append((value - target.middle) / target.reach)
    return np.stack(columns, axis=-1)


def weights_of(distance: np.ndarray) -> np.ndarray:
    """(N,) weights of pairs by the gap between their poses: half at its median, mean 1."""
    weight = 2.0 ** -np.square(distance / max(float(np.median(distance)), 1e-9))
    return (weight / weight.mean()).astype(np.float32)


def same_pose(
    slides: np.ndarray, slide_ids: np.ndarray, taps: np.ndarray, tap_ids: np.ndarray, checked: bool = True
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
            of_pose = of_pose[gaps(slides[row], taps[of_pose]).max(axis=1) <= SAME_POSE]
        if len(of_pose):
            turn = taken.get(own, 0)
            found[row], taken[own] = of_pose[turn % len(of_pose)], turn + 1
    return found


def drawn(pins: np.ndarray, radius_px: float, background: np.ndarray) -> np.ndarray:
    """Binary images (N, S, S) uint8 of {0, 255}: a round dot at each pin (N, P, 2) px, over what is white of `background` (S, S)."""
    images = np.empty((len(pins), *background.shape), np.uint8)
    for start in range(0, len(pins), DRAWN_AT_ONCE):
        here = np.resize(pins[start : start + DRAWN_AT_ONCE], (DRAWN_AT_ONCE, *pins.shape[1:]))  # one shape to compile
        white = np.asarray(_dots(here.astype(np.float32), radius_px, len(background)))[..., 0] > 0
        images[start : start + DRAWN_AT_ONCE] = np.where(white | background, 255, 0)[: len(pins) - start]
    return images


def background_of(images: np.ndarray, place: np.ndarray, spacing_px: float) -> np.ndarray:
    """(S, S) bool: what is white in most of the images (N, S, S) beyond the outermost pins (P, 2): the housing."""
    size = images.shape[-1]
    middle = (place.max(axis=0) + place.min(axis=0)) / 2
    rim = np.linalg.norm(place - middle, axis=-1).max()
    columns, rows = np.meshgrid(np.arange(size), np.arange(size))
    beyond = np.hypot(columns - middle[0], rows - middle[1]) > rim + 0.6 * spacing_px
    return (images.mean(axis=0, dtype=np.float32) >= 127.5) & beyond
