"""Repair, assess and refine the identities of one image's pins.

Where skin bends sharply, a row of pins can match one place too far, each in its neighbour's stead:
smooth except at its two ends. Erased there and grown back, pin by pin from identified ones, the
row comes out right.

A pin that touches a glint is detected between the two, and a faint one not at all. Its neighbours
say where it must be; the white pixels within one pin radius of there belong to it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from jaxunshear.perception.lattice import RIDGE, Lattice
from jaxunshear.perception.pin_detection import DetectedPins, MeasuredPins

NEAREST = 8  # neighbours of a pin that it is grown from
MIN_KNOWN_NEIGHBOURS = 3  # of these, that must be identified
MAX_OFFSET = 0.2  # of the spacing: the largest usual offset of a pin from its neighbours' motion
MIN_DETECTED_SHARE = 0.7  # of the lattice's pins
MIN_IDENTIFIED_SHARE = 0.6  # share of the pins below which identities are not rated

# Repair. Lengths are in units of the spacing.
ERASE_RADII = (2.2, 5.5)  # around a doubtful pin, in turn
GROW_RADII = (0.3, 0.45)  # from where a pin is expected: first the certain ones, then the rest

# Assessment.
# The largest offset of a pin from its neighbours' motion, over the spacing. It is large because
# pins are levers, which turn sharply at an edge.
MAX_NEIGHBOUR_OFFSET = 0.42
# Share of the pins that may have more than the usual offset in an identified image, or may be
# missing while detected ones have no identity.
MAX_MISFIT_SHARE = 0.015
MAX_HOLE_SHARE = 0.007  # share of the pins that may be missing within the inner rings
MIN_VISIBLE_SHARE = 0.8  # on a long slide the housing hides more than a tenth of the pins

# Refinement.
MIN_OFFSET = 0.1  # of the spacing off its neighbours, from which a pin is measured again
MAX_WINDOW_SHIFT = 0.3  # of the spacing: how far a window may move from where it started
AREA_RANGE = (0.2, 1.4)  # of a usual pin's area that its window holds
STEPS = 3
MAX_RIM_DEPTH = 3  # rows of pins at the rim that are dropped, at most


class PinTrack(NamedTuple):
    """One image's pins by identity."""

    motion: np.ndarray  # (P, 2) px from the lattice; NaN for pins that are missing
    identity: np.ndarray  # (P,) row of the detected pins; -1 for those that are none of them
    # largest distance of a pin from where its neighbours put it, over the spacing; inf if too few
    # are visible
    max_offset: float
    missed: int
    extra: int
    identified: bool

    @property
    def visible(self) -> Bool[np.ndarray, "P"]:
        """Which pins have a motion."""
        return ~np.isnan(self.motion[:, 0])

    @property
    def is_final(self) -> bool:
        """Whether no other first motion helps: it is identified, or only undetected pins miss.

        Then pins with a dot move smoothly, and few dots have no pin.
        """
        max_misfits = max(1, MAX_MISFIT_SHARE * len(self.motion))
        is_full = self.visible.sum() >= np.sum(self.identity >= 0) and self.extra <= max_misfits
        return self.identified or bool(is_full and self.max_offset <= MAX_OFFSET)


def drop_lost_pins(lattice: Lattice, track: PinTrack) -> PinTrack:
    """Drop the pins that are lost from a track."""
    remaining = lattice.remaining
    return track._replace(motion=track.motion[remaining], identity=track.identity[remaining])


def add_lost_pins(lattice: Lattice, track: PinTrack) -> PinTrack:
    """Add the pins that are lost to a track of the others, as missing."""
    motion, identity = np.full(lattice.rest.shape, np.nan), np.full(len(lattice.rest), -1)
    motion[lattice.remaining], identity[lattice.remaining] = track.motion, track.identity
    return track._replace(motion=motion, identity=identity)


def assess_track(
    lattice: Lattice,
    motion: Float[np.ndarray, "P 2"],
    identity: Int[np.ndarray, "P"],
    detected_count: int,
) -> PinTrack:
    """Make a track of motions, NaN for missing pins, and decide whether it is identified.

    It is identified if motions are smooth, no pin is missing within, and not both pins and
    detected ones remain without a partner: identities that are one place off leave a row of each.
    A pin with too few visible neighbours counts as missing.
    """
    pins = len(motion)
    missing = np.isnan(motion[:, 0])
    support = np.sum(~missing[lattice.neighbours[:, :NEAREST]], axis=1)
    lonely = ~missing & (support < MIN_KNOWN_NEIGHBOURS)
    motion, missing = np.where(lonely[:, None], np.nan, motion), missing | lonely
    missed, extra = int(np.sum(missing)), int(detected_count - np.sum(identity >= 0))
    if missed > (1 - MIN_VISIBLE_SHARE) * pins:
        return PinTrack(motion, identity, float("inf"), missed, extra, False)
    offset = lattice.measure_offsets(motion)
    holes = np.sum(missing & lattice.is_inner)
    max_misfits = max(1, MAX_MISFIT_SHARE * pins)
    smooth = offset.max() <= MAX_NEIGHBOUR_OFFSET and np.sum(offset > MAX_OFFSET) <= max_misfits
    identified = smooth and holes <= MAX_HOLE_SHARE * pins and min(missed, extra) <= max_misfits
    return PinTrack(motion, identity, float(offset.max()), missed, extra, bool(identified))


class Rating(NamedTuple):
    """How smooth the identities of an image are."""

    identity: np.ndarray  # (P,) row of the detected pins, -1 for none
    offset: np.ndarray  # (P,) `Lattice.measure_offsets`
    fault_count: float  # pins with an offset above MAX_OFFSET, plus half of the missing ones
    left: int  # pins or detected ones without a partner, whichever are fewer

    @property
    def calm(self) -> bool:
        """Whether no offset is above the usual."""
        return bool(self.offset.max() <= MAX_OFFSET)

    @property
    def complete(self) -> bool:
        """Whether besides all pins have a partner, or all detected ones."""
        return self.left == 0 and self.calm


def rate_identities(
    lattice: Lattice, detected: Float[np.ndarray, "N 2"], identity: Int[np.ndarray, "P"]
) -> Rating:
    """Rate the identities of pins: their rows in the detected pins px, -1 for none."""
    identified = identity >= 0
    left = min(len(identity), len(detected)) - int(identified.sum())
    if identified.mean() < MIN_IDENTIFIED_SHARE:
        return Rating(identity, np.full(len(identity), np.inf), np.inf, left)
    motion = np.where(identified[:, None], detected[identity] - lattice.rest, np.nan)
    offset = lattice.measure_offsets(motion)
    fault_count = float(np.sum(offset > MAX_OFFSET) + 0.5 * np.sum(~identified))
    return Rating(identity, offset, fault_count, left)


def repair_identities(
    lattice: Lattice, detected: Float[np.ndarray, "N 2"], rating: Rating
) -> Int[np.ndarray, "P"]:
    """Replace doubtful ones of rated identities where that leaves fewer faults."""
    if rating.calm:
        return rating.identity
    tree = cKDTree(detected)
    for radius in ERASE_RADII:
        doubtful = cKDTree(lattice.rest[rating.offset > MAX_OFFSET])
        erased = doubtful.query(lattice.rest)[0] < radius * lattice.spacing
        grown = _grow_identities(lattice, detected, tree, np.where(erased, -1, rating.identity))
        if np.array_equal(grown, rating.identity):
            break  # it grew back as it was
        other = rate_identities(lattice, detected, grown)
        if other.fault_count < rating.fault_count:
            rating = other
        if rating.calm:
            break
    return rating.identity


def _grow_identities(
    lattice: Lattice, detected: np.ndarray, tree: cKDTree, identity: np.ndarray
) -> np.ndarray:
    """Identify missing pins next to identified ones, the best supported first."""
    identity = identity.copy()
    used = np.zeros(len(detected), bool)
    used[identity[identity >= 0]] = True
    for limit in GROW_RADII:
        failed = np.zeros(len(identity), bool)  # tried in vain since a neighbour was identified
        while True:
            identified = identity >= 0
            support = identified[lattice.neighbours[:, :NEAREST]].sum(axis=1)
            candidate = ~identified & (support >= MIN_KNOWN_NEIGHBOURS)
            pins = np.flatnonzero(candidate & ~failed)
            if not len(pins):
                break
            distance, nearest = tree.query(_predict_positions(lattice, detected, identity, pins))
            near = (distance < limit * lattice.spacing) & ~used[nearest]
            failed[pins[~near]] = True
            if not near.any():
                break
            level = support[candidate].max()
            while not (first := near & (support[pins] >= level - 1)).any():
                level = support[candidate & (support < level - 1)].max()
            for row in np.flatnonzero(first)[np.argsort(distance[first])]:
                if not used[nearest[row]]:
                    identity[pins[row]] = nearest[row]
                    used[nearest[row]] = True
            grown = ~identified & (identity >= 0)
            failed[grown[lattice.neighbours].any(axis=1)] = False
    return identity


def _predict_positions(
    lattice: Lattice, detected: np.ndarray, identity: np.ndarray, pins: np.ndarray
) -> np.ndarray:
    """Predict the positions (M, 2) px of pins (M,) from their identified neighbours."""
    near = lattice.neighbours[pins]
    partner = identity[near]
    weighted = lattice.weighted_powers[pins] * (partner >= 0)[:, None]
    normal = weighted @ lattice.neighbour_powers[pins] + RIDGE
    motion = detected[partner] - lattice.rest[near]
    return lattice.rest[pins] + np.linalg.solve(normal, weighted @ motion)[:, 0]


def refine_track(lattice: Lattice, track: PinTrack, detected: DetectedPins) -> PinTrack:
    """Search for missing and doubtful pins in their windows, if `detected` holds the image."""
    if detected.mask is None or track.visible.mean() < MIN_IDENTIFIED_SHARE:
        return track
    motion = lattice.fill_missing(track.motion)
    expected = lattice.neighbour_weights @ motion
    off = np.hypot(*(motion - expected).T) > MIN_OFFSET * lattice.spacing
    again = ~track.visible | off
    if not again.any():
        return track
    start = position = (lattice.rest + expected)[again]
    margin = int(np.ceil(detected.radius)) + 1
    white = np.pad(detected.mask, margin)
    for _ in range(STEPS):
        position, area = _measure_windows(white, margin, position, detected.radius)
    share = area / (np.pi * detected.radius**2)
    near = np.hypot(*(position - start).T) < MAX_WINDOW_SHIFT * lattice.spacing
    good = (share > AREA_RANGE[0]) & (share < AREA_RANGE[1]) & near
    motion[again] = np.where(good[:, None], position - lattice.rest[again], np.nan)
    for _ in range(MAX_RIM_DEPTH):
        missing = np.isnan(motion[:, 0])
        if not missing.any():
            break
        # the housing hides part of the pins next to a missing one, or all of it
        beside_missing = missing[lattice.neighbours[:, :NEAREST]].any(axis=1)
        motion[(lattice.measure_offsets(motion) > MIN_OFFSET) & beside_missing] = np.nan
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
    place = lattice.rest[rows] + track.motion[rows]
    squares = ((place[:, None] - dots) ** 2).sum(axis=-1)
    near = squares.min(axis=1) < (MIN_OFFSET * lattice.spacing) ** 2
    motion = track.motion.copy()
    motion[rows[near]] = dots[squares[near].argmin(axis=1)] - lattice.rest[rows[near]]
    return track._replace(motion=motion)


def _measure_windows(
    white: np.ndarray, margin: int, position: np.ndarray, radius: float
) -> MeasuredPins:
    """Measure the white within a radius px of positions (N, 2) px, column first.

    `white` is the mask (S, S) with a black margin, which holds the half of a window.
    """
    line = np.arange(-margin, margin + 1)
    size = np.array(white.shape)[::-1] - 2 * margin
    middle = np.clip(np.rint(position).astype(int), 0, size - 1)
    columns, rows = middle[:, :1] + line, middle[:, 1:] + line
    patch = white[rows[:, :, None] + margin, columns[:, None, :] + margin]
    dx = (columns - position[:, :1])[:, None, :]
    dy = (rows - position[:, 1:])[:, :, None]
    weight = np.clip(radius + 0.5 - np.hypot(dx, dy), 0, 1) * patch
    across, down = weight.sum(axis=1), weight.sum(axis=2)
    area = across.sum(axis=1)
    moment = np.stack([(across * dx[:, 0]).sum(axis=1), (down * dy[:, :, 0]).sum(axis=1)], -1)
    return MeasuredPins(position + moment / np.maximum(area, 1e-9)[:, None], area)
