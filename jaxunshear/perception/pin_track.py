"""Hold the identified pins of one image, and assess whether their identities can be trusted."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxunshear.perception.identity_repair import (
    MAX_OFFSET,
    MIN_KNOWN_NEIGHBOURS,
    NEAREST,
    measure_neighbour_offsets,
)
from jaxunshear.perception.lattice import Lattice

# Of the spacing: the largest offset of a pin from its neighbours' motion. It is large because pins
# are levers, which turn sharply at an edge.
MAX_NEIGHBOUR_OFFSET = 0.42
# Share of the pins that may have more than the usual offset in an identified image, or may be
# missing while detected ones have no identity.
MAX_MISFIT_SHARE = 0.015
MAX_HOLE_SHARE = 0.007  # share of the pins that may be missing within the inner rings
INNER_RING_SHARE = 0.75  # of the outermost ring
MIN_VISIBLE_SHARE = 0.8  # on a long slide the housing hides more than a tenth of the pins


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
    offset = measure_neighbour_offsets(lattice, motion)
    holes = np.sum(missing & (lattice.ring < INNER_RING_SHARE * lattice.ring.max()))
    max_misfits = max(1, MAX_MISFIT_SHARE * pins)
    smooth = offset.max() <= MAX_NEIGHBOUR_OFFSET and np.sum(offset > MAX_OFFSET) <= max_misfits
    identified = smooth and holes <= MAX_HOLE_SHARE * pins and min(missed, extra) <= max_misfits
    return PinTrack(motion, identity, float(offset.max()), missed, extra, bool(identified))
