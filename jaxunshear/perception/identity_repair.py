"""Remove pin identities where the motion is not smooth, and grow them anew from the pins around.

Where skin bends sharply, a row of pins can match one place too far, each in its neighbour's stead:
smooth except at its two ends. Erased there and grown back, pin by pin from identified ones, the
row comes out right.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from jaxunshear.perception.lattice import Lattice, compute_neighbour_weights

MAX_OFFSET = 0.2  # of the spacing: the largest usual offset of a pin from its neighbours' motion
ERASE_RADII = (2.2, 5.5)  # spacings around a doubtful pin, in turn
# of the spacing, from where a pin is expected: first the certain ones, then the rest
GROW_RADII = (0.3, 0.45)
NEAREST = 8  # neighbours of a pin that it is grown from
MIN_KNOWN_NEIGHBOURS = 3  # of these, that must be identified
MIN_IDENTIFIED_SHARE = 0.6  # share of the pins below which identities are not rated


def fill_missing(lattice: Lattice, motion: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
    """Fill the missing rows of a motion from the nearest ones that are not missing."""
    visible = ~np.isnan(motion[:, 0])
    nearest = cKDTree(lattice.rest[visible]).query(lattice.rest)[1]
    guess = motion[visible][nearest]
    return np.where(visible[:, None], motion, lattice.neighbour_weights @ guess)


def measure_neighbour_offsets(
    lattice: Lattice, motion: Float[np.ndarray, "P 2"]
) -> Float[np.ndarray, "P"]:
    """Measure how far each pin stands from where its neighbours' motion px puts it.

    Offsets are in units of the spacing; 0 for pins that are not visible.
    """
    full = fill_missing(lattice, motion) if np.isnan(motion).any() else motion
    offset = np.linalg.norm(full - lattice.neighbour_weights @ full, axis=-1) / lattice.spacing
    return np.where(np.isnan(motion[:, 0]), 0, offset)


class Rating(NamedTuple):
    """How smooth the identities of an image are."""

    offset: np.ndarray  # (P,) `measure_neighbour_offsets`
    fault_count: float  # pins with an offset above MAX_OFFSET, plus half of the missing ones

    @property
    def calm(self) -> bool:
        """Whether no offset is above the usual."""
        return bool(self.offset.max() <= MAX_OFFSET)


def rate_identities(
    lattice: Lattice, detected: Float[np.ndarray, "N 2"], identity: Int[np.ndarray, "P"]
) -> Rating:
    """Rate the identities of pins: their rows in the detected pins px, -1 for none."""
    identified = identity >= 0
    if identified.mean() < MIN_IDENTIFIED_SHARE:
        return Rating(np.full(len(identity), np.inf), np.inf)
    motion = np.where(identified[:, None], detected[identity] - lattice.rest, np.nan)
    offset = measure_neighbour_offsets(lattice, motion)
    return Rating(offset, float(np.sum(offset > MAX_OFFSET) + 0.5 * np.sum(~identified)))


def repair_identities(
    lattice: Lattice,
    detected: Float[np.ndarray, "N 2"],
    tree: cKDTree,
    identity: Int[np.ndarray, "P"],
) -> Int[np.ndarray, "P"]:
    """Replace doubtful identities where that leaves fewer faults.

    `tree` holds the detected pins px; identities are their rows, -1 for none.
    """
    rating = rate_identities(lattice, detected, identity)
    for radius in ERASE_RADII:
        if rating.calm:
            break
        doubtful = cKDTree(lattice.rest[rating.offset > MAX_OFFSET])
        erased = doubtful.query(lattice.rest)[0] < radius * lattice.spacing
        other = _grow_identities(lattice, detected, tree, np.where(erased, -1, identity))
        if np.array_equal(other, identity):
            break  # it grew back as it was
        other_rating = rate_identities(lattice, detected, other)
        if other_rating.fault_count < rating.fault_count:
            identity, rating = other, other_rating
    return identity


def _grow_identities(
    lattice: Lattice, detected: np.ndarray, tree: cKDTree, identity: np.ndarray
) -> np.ndarray:
    """Identify missing pins next to identified ones, the best supported first."""
    identity = identity.copy()
    used = np.zeros(len(detected), bool)
    used[identity[identity >= 0]] = True
    for limit in GROW_RADII:
        failed = np.zeros(len(identity), bool)  # tried in vain since the last success
        while True:
            identified = identity >= 0
            support = identified[lattice.neighbours[:, :NEAREST]].sum(axis=1)
            support = np.where(identified | failed, -1, support)
            if support.max() < MIN_KNOWN_NEIGHBOURS:
                break
            pins = np.flatnonzero(support >= max(MIN_KNOWN_NEIGHBOURS, support.max() - 1))
            distance, nearest = tree.query(_predict_positions(lattice, detected, identity, pins))
            grew = False
            for row in np.argsort(distance):
                if distance[row] < limit * lattice.spacing and not used[nearest[row]]:
                    identity[pins[row]] = nearest[row]
                    used[nearest[row]] = grew = True
            if grew:
                failed[:] = False
            else:
                failed[pins] = True
    return identity


def _predict_positions(
    lattice: Lattice, detected: np.ndarray, identity: np.ndarray, pins: np.ndarray
) -> np.ndarray:
    """Predict the positions (M, 2) px of pins (M,) from their identified neighbours."""
    near, rest = lattice.neighbours[pins], lattice.rest
    identified = identity[near] >= 0
    offset = rest[near] - rest[pins][:, None]
    weight = compute_neighbour_weights(offset, lattice.spacing, identified)
    motion = np.where(identified[..., None], detected[identity[near]] - rest[near], 0)
    return rest[pins] + np.einsum("mn,mnc->mc", weight, motion)
