"""Measure missing and doubtful pins once more, each in a window where it is expected.

A pin that touches a glint is detected between the two, and a faint one not at all. Its neighbours
say where it must be; the white pixels within one pin radius of there belong to it.
"""

import numpy as np
from scipy.spatial import cKDTree

from jaxunshear.perception.identity_repair import (
    MIN_IDENTIFIED_SHARE,
    NEAREST,
    fill_missing,
    measure_neighbour_offsets,
)
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_detection import DetectedPins, MeasuredPins
from jaxunshear.perception.pin_track import PinTrack, assess_track

MIN_OFFSET = 0.1  # of the spacing off its neighbours, from which a pin is measured again
MAX_WINDOW_SHIFT = 0.3  # of the spacing: how far a window may move from where it started
AREA_RANGE = (0.2, 1.4)  # of a usual pin's area that its window holds
STEPS = 3
MAX_RIM_DEPTH = 3  # rows of pins at the rim that are dropped, at most


def refine_track(lattice: Lattice, track: PinTrack, detected: DetectedPins) -> PinTrack:
    """Search for missing and doubtful pins in their windows, if `detected` holds the image."""
    if detected.mask is None or track.visible.mean() < MIN_IDENTIFIED_SHARE:
        return track
    motion = fill_missing(lattice, track.motion)
    expected = lattice.rest + lattice.neighbour_weights @ motion
    again = ~track.visible | (measure_neighbour_offsets(lattice, track.motion) > MIN_OFFSET)
    if not again.any():
        return track
    start = position = expected[again]
    for _ in range(STEPS):
        position, area = _measure_windows(detected.mask, position, detected.radius)
    share = area / (np.pi * detected.radius**2)
    near = np.linalg.norm(position - start, axis=-1) < MAX_WINDOW_SHIFT * lattice.spacing
    good = (share > AREA_RANGE[0]) & (share < AREA_RANGE[1]) & near
    motion[again] = np.where(good[:, None], position - lattice.rest[again], np.nan)
    for _ in range(MAX_RIM_DEPTH):
        motion[_find_rim_pins(lattice, motion)] = np.nan
    assessed = assess_track(lattice, motion, track.identity, len(detected.pins))
    return _snap_to_dots(lattice, assessed, again, detected)


def _snap_to_dots(
    lattice: Lattice, track: PinTrack, again: np.ndarray, detected: DetectedPins
) -> PinTrack:
    """Move pins that were measured `again` (P,) to the complete dots that are near.

    A complete dot's centroid is the better measurement: a window that is smaller than a pin is
    white all over, and stays near where the neighbours put it. That these expect the pin elsewhere
    was assessed before.
    """
    rows = np.flatnonzero(again & track.visible)
    dots = detected.pins[detected.is_single]
    if not (len(rows) and len(dots)):
        return track
    distance, nearest = cKDTree(dots).query(lattice.rest[rows] + track.motion[rows])
    near = distance < MIN_OFFSET * lattice.spacing
    motion = track.motion.copy()
    motion[rows[near]] = dots[nearest[near]] - lattice.rest[rows[near]]
    return track._replace(motion=motion)


def _find_rim_pins(lattice: Lattice, motion: np.ndarray) -> np.ndarray:
    """Find pins (P,) bool off their neighbours and next to a missing one.

    The housing hides part of them, or all.
    """
    missing = np.isnan(motion[:, 0])
    if not missing.any():
        return missing
    beside_missing = missing[lattice.neighbours[:, :NEAREST]].any(axis=1)
    return (measure_neighbour_offsets(lattice, motion) > MIN_OFFSET) & beside_missing


def _measure_windows(white: np.ndarray, position: np.ndarray, radius: float) -> MeasuredPins:
    """Measure the white (S, S) within a radius px of positions (N, 2) px, column first."""
    half = int(np.ceil(radius)) + 1
    line = np.arange(-half, half + 1)
    size = np.array(white.shape)[::-1]
    middle = np.clip(np.round(position).astype(int), 0, size - 1)
    columns, rows = middle[:, :1] + line, middle[:, 1:] + line
    patch = np.pad(white, half)[rows[:, :, None] + half, columns[:, None, :] + half]
    dx = columns[:, None, :] - position[:, 0, None, None]
    dy = rows[:, :, None] - position[:, 1, None, None]
    weight = np.clip(radius + 0.5 - np.hypot(dx, dy), 0, 1) * patch
    area = weight.sum(axis=(1, 2))
    moment = np.stack([(weight * dx).sum(axis=(1, 2)), (weight * dy).sum(axis=(1, 2))], -1)
    return MeasuredPins(position + moment / np.maximum(area, 1e-9)[:, None], area)
