"""One image's pins by identity, and how sure these are."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxunshear.image.growing import CALM, ENOUGH, off_neighbours
from jaxunshear.image.lattice import Lattice

SURE = 0.42  # of the spacing, how far a pin may stand from its neighbours' motion: levers turn sharply at an edge
FEW = 0.015  # share of the pins: of a sure frame, that stand off their neighbours; or that are missing while others are left over
HOLES = 0.007  # share of the pins, that a sure frame may lack within its outer rings
INNER = 0.75  # of the outermost shell
SEEN = 0.8  # share of the pins that a sure frame shows: on a long slide the housing hides more than a tenth


class Track(NamedTuple):
    """One image's pins by identity."""

    motion: np.ndarray  # (P, 2) px from the lattice; NaN for pins that were not found
    which: np.ndarray  # (P,) row of the found pins; -1 for those that are none of them
    doubt: float  # how far a pin stands from where its neighbours put it, at most, over the spacing; inf if too few are found
    missed: int
    extra: int
    sure: bool

    @property
    def seen(self) -> Bool[np.ndarray, "P"]:
        return ~np.isnan(self.motion[:, 0])


def judged(
    lattice: Lattice, motion: Float[np.ndarray, "P 2"], which: Int[np.ndarray, "P"], found: int
) -> Track:
    """A track of these motions, NaN where a pin is not seen.

    It is sure where motions are smooth, nothing is missing within, and not both pins and found ones are left over: identities that are
    one place off leave a row of each. A pin without the company to vouch for it counts as not seen.
    """
    pins = len(motion)
    unseen = np.isnan(motion[:, 0])
    alone = ~unseen & (np.sum(~unseen[lattice.near[:, :8]], axis=1) < ENOUGH)
    motion, unseen = np.where(alone[:, None], np.nan, motion), unseen | alone
    missed, extra = int(np.sum(unseen)), int(found - np.sum(which >= 0))
    if missed > (1 - SEEN) * pins:
        return Track(motion, which, float("inf"), missed, extra, False)
    off = off_neighbours(lattice, motion)
    holes = np.sum(unseen & (lattice.shell < INNER * lattice.shell.max()))
    most = max(1, FEW * pins)
    smooth = off.max() <= SURE and np.sum(off > CALM) <= most
    sure = smooth and holes <= HOLES * pins and min(missed, extra) <= most
    return Track(motion, which, float(off.max()), missed, extra, bool(sure))
