"""Taps and slides among labelled contacts, and how near in pose the nearest of the others is."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from jaxunshear.angles import wrap_degrees

STILL = 1e-6  # mm and degrees: a contact moved by less is a tap
SAME_POSE = 1e-3  # mm and degrees
MM_OF_DEGREE = 0.1  # a degree weighs as much in the search for the nearest pose
RADIUS_MM = np.degrees(MM_OF_DEGREE)  # of the circle on which angles then lie
MOST_GAP_DEG = 20.0  # between neighbours, of angles that cover the full circle


@dataclass(frozen=True)
class Column:
    """What a labelled column holds."""

    name: str
    unit: str
    low: float
    high: float
    circle: bool  # angles all the way round

    @property
    def varies(self) -> bool:
        return self.high - self.low > STILL


@dataclass(frozen=True)
class Pairing:
    """How slides find their taps."""

    taps: int
    slides: int
    by_id: int  # slides with a tap of the same pose_id and pose
    gap_mm: float | None  # median, of a slide from the tap nearest in pose; None where poses are not known
    gap_deg: float | None


def column(name: str, unit: str, values: np.ndarray) -> Column | None:
    """Of values (N,), NaN where unknown; None where all are."""
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    return Column(name, unit, float(known.min()), float(known.max()), unit == "deg" and full_circle(known))


def full_circle(angles: np.ndarray) -> bool:
    """Whether angles (N,) in degrees leave no gap to speak of on the circle."""
    turned = np.unique(np.mod(angles, 360.0))
    return len(turned) > 1 and bool(np.diff(turned, append=turned[0] + 360.0).max() < MOST_GAP_DEG)


def taps_and_slides(moves: np.ndarray | None, contacts: int) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool each, from moves (N, 6) or None; a contact whose move is not known is neither."""
    if moves is None:
        return np.zeros(contacts, bool), np.zeros(contacts, bool)
    known = np.isfinite(moves).all(axis=1)
    still = known & (np.abs(np.where(known[:, None], moves, 0.0)) <= STILL).all(axis=1)
    return still, known & ~still


def pairing(poses: np.ndarray | None, moves: np.ndarray | None, ids: np.ndarray | None, contacts: int) -> Pairing:
    """Of N contacts; poses and moves (N, 6) in mm and degrees, ids (N,) with -1 where unknown, or None."""
    taps, slides = taps_and_slides(moves, contacts)
    nothing = Pairing(int(taps.sum()), int(slides.sum()), 0, None, None)
    if poses is None:
        return nothing
    posed = np.isfinite(poses).all(axis=1)
    tap, slide = np.flatnonzero(taps & posed), np.flatnonzero(slides & posed)
    if not len(tap) or not len(slide):
        return nothing
    near = tap[cKDTree(_places(poses[tap])).query(_places(poses[slide]))[1]]
    apart = poses[near] - poses[slide]
    mm = float(np.median(np.linalg.norm(apart[:, :3], axis=1)))
    deg = float(np.median(np.abs(wrap_degrees(apart[:, 3:])).max(axis=1)))
    by_id = 0 if ids is None else _same(poses, ids, tap, slide)
    return Pairing(nothing.taps, nothing.slides, by_id, mm, deg)


def _places(poses: np.ndarray) -> np.ndarray:
    """(N, 9) mm: positions, and angles as points on circles, where 180 and -180 degrees are one."""
    angles = np.radians(poses[:, 3:])
    return np.hstack([poses[:, :3], RADIUS_MM * np.cos(angles), RADIUS_MM * np.sin(angles)])


def _same(poses: np.ndarray, ids: np.ndarray, tap: np.ndarray, slide: np.ndarray) -> int:
    """How many slides (rows) have a tap of their number and pose."""
    by_id: dict[int, list[int]] = {}
    for row in tap:
        by_id.setdefault(int(ids[row]), []).append(row)
    found = 0
    for row in slide:
        others = by_id.get(int(ids[row]), []) if ids[row] >= 0 else []
        apart = poses[row] - poses[others]
        apart[:, 3:] = wrap_degrees(apart[:, 3:])
        found += bool((np.abs(apart) < SAME_POSE).all(axis=1).any())
    return found
