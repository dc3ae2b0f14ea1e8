"""One image's pins by identity, and how sure these are."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxunshear.perception.identity_repair import (
    MAX_OFFSET,
    MIN_KNOWN_NEIGHBOURS,
    measure_neighbour_offsets,
)
from jaxunshear.perception.lattice import Lattice

MAX_NEIGHBOUR_OFFSET = 0.42  # of the spacing, how far a pin may stand from its neighbours' motion: levers turn sharply at an edge
MAX_MISFIT_SHARE = 0.015  # share of the pins: of a sure frame, that stand off their neighbours; or that are missing while others are left over
MAX_HOLE_SHARE = 0.007  # share of the pins, that a sure frame may lack within its outer rings
INNER_RING_SHARE = 0.75  # of the outermost shell
MIN_VISIBLE_SHARE = 0.8  # share of the pins that a sure frame shows: on a long slide the housing hides more than a tenth


class PinTrack(NamedTuple):
    """One image's pins by identity."""

    motion: np.ndarray  # (P, 2) px from the lattice; NaN for pins that were not found
    identity: np.ndarray  # (P,) row of the found pins; -1 for those that are none of them
    max_offset: float  # how far a pin stands from where its neighbours put it, at most, over the spacing; inf if too few are found
    missed: int
    extra: int
    identified: bool

    @property
    def visible(self) -> Bool[np.ndarray, "P"]:
        return ~np.isnan(self.motion[:, 0])


def assess_track(
    lattice: Lattice, motion: Float[np.ndarray, "P 2"], which: Int[np.ndarray, "P"], found: int
) -> PinTrack:
    """A track of these motions, NaN where a pin is not seen.

    It is sure where motions are smooth, nothing is missing within, and not both pins and found ones are left over: identities that are
    one place off leave a row of each. A pin without the company to vouch for it counts as not seen.
    """
    pins = len(motion)
    unseen = np.isnan(motion[:, 0])
    alone = ~unseen & (np.sum(~unseen[lattice.neighbours[:, :8]], axis=1) < MIN_KNOWN_NEIGHBOURS)
    motion, unseen = np.where(alone[:, None], np.nan, motion), unseen | alone
    missed, extra = int(np.sum(unseen)), int(found - np.sum(which >= 0))
    if missed > (1 - MIN_VISIBLE_SHARE) * pins:
        return PinTrack(motion, which, float("inf"), missed, extra, False)
    off = measure_neighbour_offsets(lattice, motion)
    holes = np.sum(unseen & (lattice.ring < INNER_RING_SHARE * lattice.ring.max()))
    most = max(1, MAX_MISFIT_SHARE * pins)
    smooth = off.max() <= MAX_NEIGHBOUR_OFFSET and np.sum(off > MAX_OFFSET) <= most
    sure = smooth and holes <= MAX_HOLE_SHARE * pins and min(missed, extra) <= most
    return PinTrack(motion, which, float(off.max()), missed, extra, bool(sure))
