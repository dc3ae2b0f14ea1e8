"""Pins measured once more, each in a window of its own.

A pin that touches a glint is found between the two, a faint one not at all. Once its neighbours say where it must be, the white
within one pin's radius of there is its own.
"""

import numpy as np
from scipy.spatial import cKDTree

from jaxunshear.perception.identity_repair import fill_missing, measure_neighbour_offsets
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_detection import DetectedPins
from jaxunshear.perception.pin_track import PinTrack, assess_track

MIN_OFFSET = (
    0.1  # of the spacing off its neighbours: pins nearer than this are taken as they were found
)
MAX_WINDOW_SHIFT = 0.3  # of the spacing: a window may lead this far
AREA_RANGE = (0.2, 1.4)  # of a usual pin's area that its window holds
STEPS = 3
MAX_RIM_DEPTH = 3  # pins deep, at most, that one left out leads to others


def refine_track(lattice: Lattice, track: PinTrack, found: DetectedPins) -> PinTrack:
    """A track whose missing and doubtful pins are searched for in their windows, where there is an image."""
    if found.mask is None or track.visible.mean() < 0.6:
        return track
    motion = fill_missing(lattice, track.motion)
    expected = lattice.rest + lattice.neighbour_weights @ motion
    again = ~track.visible | (measure_neighbour_offsets(lattice, track.motion) > MIN_OFFSET)
    if not again.any():
        return track
    start = at = expected[again]
    for _ in range(STEPS):
        at, area = _centroids(found.mask, at, found.radius)
    share = area / (np.pi * found.radius**2)
    near = np.linalg.norm(at - start, axis=-1) < MAX_WINDOW_SHIFT * lattice.spacing
    good = (share > AREA_RANGE[0]) & (share < AREA_RANGE[1]) & near
    motion[again] = np.where(good[:, None], at - lattice.rest[again], np.nan)
    for _ in range(MAX_RIM_DEPTH):
        motion[_find_rim_pins(lattice, motion)] = np.nan
    return _snap_to_detected(
        lattice, assess_track(lattice, motion, track.identity, len(found.pins)), again, found
    )


def _snap_to_detected(
    lattice: Lattice, track: PinTrack, again: np.ndarray, found: DetectedPins
) -> PinTrack:
    """A track whose pins that were measured `again` (P,) stand on the complete dots that are near.

    A complete dot's centroid is the better measurement: a window that is smaller than a pin finds white all over, and stays near where the
    neighbours put it. That these expect the pin elsewhere is doubt, and was judged before.
    """
    rows = np.flatnonzero(again & track.visible)
    dots = found.pins[found.is_single]
    if not (len(rows) and len(dots)):
        return track
    distance, nearest = cKDTree(dots).query(lattice.rest[rows] + track.motion[rows])
    near = distance < MIN_OFFSET * lattice.spacing
    motion = track.motion.copy()
    motion[rows[near]] = dots[nearest[near]] - lattice.rest[rows[near]]
    return track._replace(motion=motion)


def _find_rim_pins(lattice: Lattice, motion: np.ndarray) -> np.ndarray:
    """(P,) bool: pins off their neighbours and next to one that is not seen: the housing hides part of them, or all."""
    unseen = np.isnan(motion[:, 0])
    if not unseen.any():
        return unseen
    return (measure_neighbour_offsets(lattice, motion) > MIN_OFFSET) & unseen[
        lattice.neighbours[:, :8]
    ].any(axis=1)


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
