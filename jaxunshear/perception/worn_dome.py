"""Identify the pins of a dome that has lost some, carries dust, or is pressed against a sharp edge.

This road is slower and is for images in which pins are not identified otherwise: a hole among the
pins is no fault here as long as the pins around it agree, nor is a pin off its neighbours as long
as nearly every pin is found. A dot that alone moves otherwise than all dots around it is dust.

>>> lost = find_lost_pins(lattice, track_all(lattice, frames))
>>> tracks = track_all(make_lattice(lattice.rest, lattice.ring, lost), frames)
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_track import (
    MAX_OFFSET,
    MIN_IDENTIFIED_SHARE,
    MIN_VISIBLE_SHARE,
    NEAREST,
    PinTrack,
)

# Limits are between what right and wrong identities of simulated frames have, which
# `python -m benchmarks lost_pins` makes: 0 to 8 % of pins lost, 0 to 2 % dust, sharp contacts.
MAX_WORN_OFFSET = 0.45  # of the spacing, of a pin from its neighbours' motion
MAX_HOLE_SHARE = 0.1  # of the pins that may be missing within the inner rings
MIN_NEIGHBOURS = (
    4  # of NEAREST, that are seen around such a hole; around an outer pin there are more
)
# Pins off their neighbours, plus twice the pins or dots, whichever are fewer, without a partner:
# identities that are one row off have this many in a row, which is about sqrt(pins) long.
MAX_ROW_FAULTS = 1.5
CALM_OFFSET = 0.12  # of the spacing, of all pins around a dot that alone moves otherwise
MAX_OFFSET_AT_HOLE = 0.3
DUST_ROUNDS = 2
AROUND = 6  # neighbours that touch a pin's place
MIN_FRAMES = 10  # identified ones that show which pins are lost
MAX_SEEN_SHARE = 0.02  # of the frames, in which dust may stand for a lost pin


def find_lost_pins(lattice: Lattice, tracks: Sequence[PinTrack]) -> list[int]:
    """Find the pins that no frame of a camera shows; none if fewer than MIN_FRAMES are sure."""
    seen = [track.visible for track in tracks if track.identified]
    if len(seen) < MIN_FRAMES:
        return list(lattice.lost)
    return np.flatnonzero(np.mean(seen, axis=0) <= MAX_SEEN_SHARE).tolist()


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
        and holes.sum() <= MAX_HOLE_SHARE * len(motion)
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
