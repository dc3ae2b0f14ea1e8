"""Identify the pins of a dome that has lost some, carries dust, or is pressed against a sharp edge.

This tracking is slower, and only for images whose pins the usual one does not identify. It accepts
a hole among the pins if the pins around it agree, and a pin away from where its neighbours put it
if nearly every pin is found. A dot that moves unlike all dots around it is dust.

>>> lost = find_lost_pins(track_all(lattice, frames))
>>> tracks = track_all(make_lattice(lattice.rest, lattice.ring, lost), frames)
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from jaxunshear.angles import rotation_2d
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_detection import DetectedPins
from jaxunshear.perception.pin_matching import fit_affine, match_iteratively
from jaxunshear.perception.pin_track import (
    MAX_OFFSET,
    MIN_DETECTED_SHARE,
    MIN_IDENTIFIED_SHARE,
    MIN_VISIBLE_SHARE,
    NEAREST,
    PinTrack,
    add_lost_pins,
    drop_lost_pins,
    repair_identities,
)

# Limits are between what right and wrong identities of simulated frames have: with 0 to 8 % of
# pins lost and 0 to 2 % dust, and of 127 pins also under deep contacts of sharp shapes.
MAX_DETECTED_SHARE = 1.1  # of the pins: among the dots of noise any lattice finds itself
MAX_WORN_OFFSET = 0.45  # of the spacing, of a pin from its neighbours' motion
MAX_WORN_HOLE_SHARE = 0.1  # of the pins that may be missing within the inner rings
MIN_NEIGHBOURS = 4  # of NEAREST, seen around such a hole; an outer pin that is sure has more
# Pins off their neighbours, plus twice the pins or dots, whichever are fewer, without a partner:
# identities that are one row off have this many in a row, which is about sqrt(pins) long.
MAX_ROW_FAULTS = 1.5
CALM_OFFSET = 0.12  # of the spacing, of all pins around a dot that alone moves otherwise
MAX_OFFSET_AT_HOLE = 0.3
DUST_ROUNDS = 2
WORN_TURNS_DEG = (0, 4, -4)
MIN_WORN_MARGIN = 2  # pins and dots without a partner, by which other identities must be worse
MAX_WORN_FAULT_SHARE = 0.25  # of the pins: identities with more faults are not repaired
MIN_STEP_SHARE = 0.7  # of the pins, which a step puts near others' places if it fits the lattice
MAX_STEP_DISTANCE = 0.3  # of the spacing
AROUND = 6  # neighbours that touch a pin's place
MIN_FRAMES = 10  # identified ones that show which pins are lost
MAX_SEEN_SHARE = 0.02  # of the frames, in which dust may stand for a lost pin


def find_lost_pins(tracks: Sequence[PinTrack]) -> list[int]:
    """Find the pins that no frame of a camera shows; none if fewer than MIN_FRAMES are sure."""
    seen = [track.visible | (track.identity >= 0) for track in tracks if track.identified]
    if len(seen) < MIN_FRAMES:
        return []
    return np.flatnonzero(np.mean(seen, axis=0) <= MAX_SEEN_SHARE).tolist()


def track_worn_pins(lattice: Lattice, detected: DetectedPins, track: PinTrack) -> PinTrack:
    """Track the pins of an image again, as on a worn dome, unless `track` is identified.

    Returns `track` if this does not identify them either.
    """
    share = len(detected.pins) / len(lattice.rest)
    if track.identified or not MIN_DETECTED_SHARE <= share <= MAX_DETECTED_SHARE:
        return track
    if lattice.intact is not None:
        return add_lost_pins(
            lattice, track_worn_pins(lattice.intact, detected, drop_lost_pins(lattice, track))
        )
    if track.is_final:
        own = assess_worn_track(lattice, detected.pins, track.identity)
        if not own.identified:
            return track  # other first motions lead to the same identities
    motions = _propose_worn_motions(lattice, detected.pins)
    first = next(_find_worn_tracks(lattice, detected.pins, motions), None)
    if first is None:
        return track
    # a regular lattice with one side behind the housing may also fit one place further
    moved = [lattice.fill_missing(first.motion) + step for step in _find_steps(lattice)]
    tracks = [first, *_find_worn_tracks(lattice, detected.pins, moved)]
    tracks.sort(key=lambda worn: worn.missed + worn.extra)
    best = tracks[0]
    is_sure = all(
        np.array_equal(each.identity, best.identity)
        or each.missed + each.extra >= best.missed + best.extra + MIN_WORN_MARGIN
        for each in tracks[1:]
    )
    return best if is_sure else track


def _find_steps(lattice: Lattice) -> list[np.ndarray]:
    """Find the steps px from a pin to the next by which the lattice moves onto itself."""
    middle = np.argmin(np.linalg.norm(lattice.rest - lattice.centre, axis=-1))
    steps = lattice.rest[lattice.neighbours[middle, :AROUND]] - lattice.rest[middle]
    tree, near = cKDTree(lattice.rest), MAX_STEP_DISTANCE * lattice.spacing
    shares = [np.mean(tree.query(lattice.rest + step)[0] < near) for step in steps]
    return [step for step, share in zip(steps, shares, strict=True) if share >= MIN_STEP_SHARE]


def _find_worn_tracks(
    lattice: Lattice, detected: np.ndarray, motions: Iterable[np.ndarray]
) -> Iterator[PinTrack]:
    """Yield the identified ones of the tracks that start from first motions (P, 2) px."""
    for motion in motions:
        rating = match_iteratively(lattice, detected, motion)
        if rating.fault_count > MAX_WORN_FAULT_SHARE * len(lattice.rest):
            continue
        identity = repair_identities(lattice, detected, rating)
        worn = assess_worn_track(lattice, detected, identity)
        if worn.identified:
            yield worn


def _propose_worn_motions(lattice: Lattice, detected: np.ndarray) -> Iterator[np.ndarray]:
    """Propose motions (P, 2) px of pins of which some are lost, anywhere."""
    unseen = len(lattice.rest) - len(detected)
    for hidden in sorted({0, max(unseen, 0) // 2, max(unseen, 0)}):
        likeliest = fit_affine(lattice, detected, hidden)
        middle = likeliest.mean(axis=0)
        for angle in np.radians(WORN_TURNS_DEG):
            yield (likeliest - middle) @ rotation_2d(-angle) + middle - lattice.rest


def assess_worn_track(
    lattice: Lattice, detected: Float[np.ndarray, "N 2"], identity: Int[np.ndarray, "P"]
) -> PinTrack:
    """Make a track of identities, the pins' rows in the detected pins px, and decide on it.

    Pins may be missing anywhere, but not in clusters: identities around these are in doubt.
    """
    identity = _drop_dust(lattice, detected, identity)
    missing = identity < 0
    motion = np.where(missing[:, None], np.nan, detected[identity] - lattice.rest)
    missed, extra = int(missing.sum()), int(len(detected) - np.sum(~missing))
    if missed > (1 - MIN_VISIBLE_SHARE) * len(motion):
        return PinTrack(motion, identity, float("inf"), missed, extra, False)
    offset = lattice.measure_offsets(motion)
    holes = missing & lattice.is_inner
    support = np.sum(~missing[lattice.neighbours[:, :NEAREST]], axis=1)
    faults = np.sum(offset > MAX_OFFSET) + 2 * min(missed, extra)
    identified = (
        offset.max() <= MAX_WORN_OFFSET
        and holes.sum() <= MAX_WORN_HOLE_SHARE * len(motion)
        and (support[holes] >= MIN_NEIGHBOURS).all()
        and faults <= MAX_ROW_FAULTS * np.sqrt(len(motion))
    )
    # at the rim dust beside a missing pin is as likely as the pin
    unsure = (support <= MIN_NEIGHBOURS) & ~lattice.is_inner
    motion = np.where(unsure[:, None], np.nan, motion)
    missed = int(np.sum(missing | unsure))
    return PinTrack(motion, identity, float(offset.max()), missed, extra, bool(identified))


def _drop_dust(lattice: Lattice, detected: np.ndarray, identity: np.ndarray) -> np.ndarray:
    """Drop identities of dots that alone move otherwise than the calm pins around them.

    Beside a missing pin, whose dot they may be, less is enough to doubt them.
    """
    for _ in range(DUST_ROUNDS):
        if np.mean(identity >= 0) < MIN_IDENTIFIED_SHARE:
            return identity
        motion = np.where(identity[:, None] >= 0, detected[identity] - lattice.rest, np.nan)
        offset = lattice.measure_offsets(motion)
        is_calm = offset[lattice.neighbours[:, :AROUND]].max(axis=1) <= CALM_OFFSET
        beside_hole = (identity < 0)[lattice.neighbours[:, :AROUND]].any(axis=1)
        is_dust = (offset > MAX_OFFSET) & is_calm
        is_doubtful = (offset > MAX_OFFSET_AT_HOLE) & beside_hole
        identity = np.where(is_dust | is_doubtful, -1, identity)
    return identity
