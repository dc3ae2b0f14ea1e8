"""Identities taken back where they are not smooth, and grown anew from the pins around.

Where skin bends sharply, a row of pins can settle one place too far, each in its neighbour's stead: smooth but for the two ends.
Erased there and grown back, pin by pin from what is known, the row comes out right.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from jaxunshear.perception.lattice import Lattice, compute_neighbour_weights

MAX_OFFSET = 0.2  # of the spacing: how far from its neighbours' motion a pin stands at most, most of the time
ERASE_RADII = (2.2, 5.5)  # spacings around a doubtful pin, in turn
GROW_RADII = (
    0.3,
    0.45,
)  # of the spacing, from where a found pin is expected: first the sure ones, then the rest
MIN_KNOWN_NEIGHBOURS = 3  # known ones among a pin's eight nearest, to grow from


def fill_missing(lattice: Lattice, motion: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
    """A motion whose missing rows follow the nearest known ones."""
    known = ~np.isnan(motion[:, 0])
    nearest = cKDTree(lattice.rest[known]).query(lattice.rest)[1]
    guess = motion[known][nearest]
    return np.where(known[:, None], motion, lattice.neighbour_weights @ guess)


def measure_neighbour_offsets(
    lattice: Lattice, motion: Float[np.ndarray, "P 2"]
) -> Float[np.ndarray, "P"]:
    """How far each pin stands from where its neighbours' motion px puts it, over the spacing; 0 for those not seen."""
    known = fill_missing(lattice, motion) if np.isnan(motion).any() else motion
    off = np.linalg.norm(known - lattice.neighbour_weights @ known, axis=-1) / lattice.spacing
    return np.where(np.isnan(motion[:, 0]), 0, off)


class Rating(NamedTuple):
    offset: np.ndarray  # (P,) `measure_neighbour_offsets`
    fault_count: float  # pins that are off by more than CALM, and half of those that are missing

    @property
    def calm(self) -> bool:
        return bool(self.offset.max() <= MAX_OFFSET)


def rate_identities(
    lattice: Lattice, detected: Float[np.ndarray, "N 2"], identity: Int[np.ndarray, "P"]
) -> Rating:
    """Of rows of the found pins px, -1 for none."""
    known = identity >= 0
    if known.mean() < 0.6:
        return Rating(np.full(len(identity), np.inf), np.inf)
    off = measure_neighbour_offsets(
        lattice, np.where(known[:, None], detected[identity] - lattice.rest, np.nan)
    )
    return Rating(off, float(np.sum(off > MAX_OFFSET) + 0.5 * np.sum(~known)))


def repair_identities(
    lattice: Lattice,
    detected: Float[np.ndarray, "N 2"],
    tree: cKDTree,
    identity: Int[np.ndarray, "P"],
) -> Int[np.ndarray, "P"]:
    """Rows of the found pins px, -1 for none, with fewer doubtful ones where that can be had."""
    rating = rate_identities(lattice, detected, identity)
    for reach in ERASE_RADII:
        if rating.calm:
            break
        erased = (
            cKDTree(lattice.rest[rating.offset > MAX_OFFSET]).query(lattice.rest)[0]
            < reach * lattice.spacing
        )
        other = _grow_identities(lattice, detected, tree, np.where(erased, -1, identity))
        if np.array_equal(other, identity):
            break  # grown back as it was
        other_rating = rate_identities(lattice, detected, other)
        if other_rating.fault_count < rating.fault_count:
            identity, rating = other, other_rating
    return identity


def _grow_identities(
    lattice: Lattice, found: np.ndarray, tree: cKDTree, which: np.ndarray
) -> np.ndarray:
    which = which.copy()
    taken = np.zeros(len(found), bool)
    taken[which[which >= 0]] = True
    for limit in GROW_RADII:
        vain = np.zeros(len(which), bool)  # since the last one that was found
        while True:
            known = which >= 0
            company = np.where(known | vain, -1, known[lattice.neighbours[:, :8]].sum(axis=1))
            if company.max() < MIN_KNOWN_NEIGHBOURS:
                break
            next_ones = np.flatnonzero(company >= max(MIN_KNOWN_NEIGHBOURS, company.max() - 1))
            off, nearest = tree.query(_predict_positions(lattice, found, which, next_ones))
            grew = False
            for row in np.argsort(off):
                if off[row] < limit * lattice.spacing and not taken[nearest[row]]:
                    which[next_ones[row]] = nearest[row]
                    taken[nearest[row]] = grew = True
            if grew:
                vain[:] = False
            else:
                vain[next_ones] = True
    return which


def _predict_positions(
    lattice: Lattice, found: np.ndarray, which: np.ndarray, pins: np.ndarray
) -> np.ndarray:
    """(M, 2) px: where the known ones of the neighbours of pins (M,) put them."""
    near, place = lattice.neighbours[pins], lattice.rest
    known = which[near] >= 0
    share = compute_neighbour_weights(place[near] - place[pins][:, None], lattice.spacing, known)
    motion = np.where(known[..., None], found[which[near]] - place[near], 0)
    return place[pins] + np.einsum("mn,mnc->mc", share, motion)
