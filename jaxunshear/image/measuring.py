"""Pins measured once more, each in a window of its own.

A pin that touches a glint is found between the two, a faint one not at all. Once its neighbours say where it must be, the white
within one pin's radius of there is its own.
"""

import numpy as np
from scipy.spatial import cKDTree

from jaxunshear.image.growing import filled, off_neighbours
from jaxunshear.image.lattice import Lattice
from jaxunshear.image.pins import Found
from jaxunshear.image.track import Track, judged

AGREED = (
    0.1  # of the spacing off its neighbours: pins nearer than this are taken as they were found
)
AWAY = 0.3  # of the spacing: a window may lead this far
WHITE = (0.2, 1.4)  # of a usual pin's area that its window holds
STEPS = 3
BRINKS = 3  # pins deep, at most, that one left out leads to others


def measured(lattice: Lattice, track: Track, found: Found) -> Track:
    """A track whose missing and doubtful pins are searched for in their windows, where there is an image."""
    if found.white is None or track.seen.mean() < 0.6:
        return track
    motion = filled(lattice, track.motion)
    expected = lattice.place + lattice.around @ motion
    again = ~track.seen | (off_neighbours(lattice, track.motion) > AGREED)
    if not again.any():
        return track
    start = at = expected[again]
    for _ in range(STEPS):
        at, area = _centroids(found.white, at, found.radius)
    share = area / (np.pi * found.radius**2)
    near = np.linalg.norm(at - start, axis=-1) < AWAY * lattice.spacing
    good = (share > WHITE[0]) & (share < WHITE[1]) & near
    motion[again] = np.where(good[:, None], at - lattice.place[again], np.nan)
    for _ in range(BRINKS):
        motion[_at_the_brink(lattice, motion)] = np.nan
    return _as_found(lattice, judged(lattice, motion, track.which, len(found.pins)), again, found)


def _as_found(lattice: Lattice, track: Track, again: np.ndarray, found: Found) -> Track:
    """A track whose pins that were measured `again` (P,) stand on the complete dots that are near.

    A complete dot's centroid is the better measurement: a window that is smaller than a pin finds white all over, and stays near where the
    neighbours put it. That these expect the pin elsewhere is doubt, and was judged before.
    """
    rows = np.flatnonzero(again & track.seen)
    dots = found.pins[found.single]
    if not (len(rows) and len(dots)):
        return track
    distance, nearest = cKDTree(dots).query(lattice.place[rows] + track.motion[rows])
    near = distance < AGREED * lattice.spacing
    motion = track.motion.copy()
    motion[rows[near]] = dots[nearest[near]] - lattice.place[rows[near]]
    return track._replace(motion=motion)


def _at_the_brink(lattice: Lattice, motion: np.ndarray) -> np.ndarray:
    """(P,) bool: pins off their neighbours and next to one that is not seen: the housing hides part of them, or all."""
    unseen = np.isnan(motion[:, 0])
    if not unseen.any():
        return unseen
    return (off_neighbours(lattice, motion) > AGREED) & unseen[lattice.near[:, :8]].any(axis=1)


def _centroids(white: np.ndarray, at: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Centroids (N, 2) and areas (N,) px of the white (S, S) within a radius of places (N, 2), column first."""
    half = int(np.ceil(radius)) + 1
    line = np.arange(-half, half + 1)
    size = np.array(white.shape)[::-1]
    middle = np.clip(np.round(at).astype(int), 0, size - 1)
    columns, rows = middle[:, :1] + line, middle[:, 1:] + line
    patch = np.pad(white, half)[rows[:, :, None] + half, columns[:, None, :] + half]
    dx, dy = columns[:, None, :] - at[:, 0, None, None], rows[:, :, None] - at[:, 1, None, None]
    weight = np.clip(radius + 0.5 - np.hypot(dx, dy), 0, 1) * patch
    area = weight.sum(axis=(1, 2))
    moved = np.stack([(weight * dx).sum(axis=(1, 2)), (weight * dy).sum(axis=(1, 2))], -1)
    return at + moved / np.maximum(area, 1e-9)[:, None], area
