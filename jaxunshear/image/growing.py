"""Identities taken back where they are not smooth, and grown anew from the pins around.

Where skin bends sharply, a row of pins can settle one place too far, each in its neighbour's stead: smooth but for the two ends.
Erased there and grown back, pin by pin from what is known, the row comes out right.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from jaxunshear.image.lattice import Lattice, weights

CALM = 0.2  # of the spacing: how far from its neighbours' motion a pin stands at most, most of the time
ERASED = (2.2, 5.5)  # spacings around a doubtful pin, in turn
GROWN = (
    0.3,
    0.45,
)  # of the spacing, from where a found pin is expected: first the sure ones, then the rest
ENOUGH = 3  # known ones among a pin's eight nearest, to grow from


def filled(lattice: Lattice, motion: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
    """A motion whose missing rows follow the nearest known ones."""
    known = ~np.isnan(motion[:, 0])
    nearest = cKDTree(lattice.place[known]).query(lattice.place)[1]
    guess = motion[known][nearest]
    return np.where(known[:, None], motion, lattice.around @ guess)


def off_neighbours(lattice: Lattice, motion: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P"]:
    """How far each pin stands from where its neighbours' motion px puts it, over the spacing; 0 for those not seen."""
    known = filled(lattice, motion) if np.isnan(motion).any() else motion
    off = np.linalg.norm(known - lattice.around @ known, axis=-1) / lattice.spacing
    return np.where(np.isnan(motion[:, 0]), 0, off)


class Rating(NamedTuple):
    off: np.ndarray  # (P,) `off_neighbours`
    faults: float  # pins that are off by more than CALM, and half of those that are missing

    @property
    def calm(self) -> bool:
        return bool(self.off.max() <= CALM)


def rated(lattice: Lattice, found: Float[np.ndarray, "N 2"], which: Int[np.ndarray, "P"]) -> Rating:
    """Of rows of the found pins px, -1 for none."""
    known = which >= 0
    if known.mean() < 0.6:
        return Rating(np.full(len(which), np.inf), np.inf)
    off = off_neighbours(lattice, np.where(known[:, None], found[which] - lattice.place, np.nan))
    return Rating(off, float(np.sum(off > CALM) + 0.5 * np.sum(~known)))


def repaired(
    lattice: Lattice, found: Float[np.ndarray, "N 2"], tree: cKDTree, which: Int[np.ndarray, "P"]
) -> Int[np.ndarray, "P"]:
    """Rows of the found pins px, -1 for none, with fewer doubtful ones where that can be had."""
    rating = rated(lattice, found, which)
    for reach in ERASED:
        if rating.calm:
            break
        erased = (
            cKDTree(lattice.place[rating.off > CALM]).query(lattice.place)[0]
            < reach * lattice.spacing
        )
        other = _grown(lattice, found, tree, np.where(erased, -1, which))
        if np.array_equal(other, which):
            break  # grown back as it was
        other_rating = rated(lattice, found, other)
        if other_rating.faults < rating.faults:
            which, rating = other, other_rating
    return which


def _grown(lattice: Lattice, found: np.ndarray, tree: cKDTree, which: np.ndarray) -> np.ndarray:
    which = which.copy()
    taken = np.zeros(len(found), bool)
    taken[which[which >= 0]] = True
    for limit in GROWN:
        vain = np.zeros(len(which), bool)  # since the last one that was found
        while True:
            known = which >= 0
            company = np.where(known | vain, -1, known[lattice.near[:, :8]].sum(axis=1))
            if company.max() < ENOUGH:
                break
            next_ones = np.flatnonzero(company >= max(ENOUGH, company.max() - 1))
            off, nearest = tree.query(_expected(lattice, found, which, next_ones))
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


def _expected(
    lattice: Lattice, found: np.ndarray, which: np.ndarray, pins: np.ndarray
) -> np.ndarray:
    """(M, 2) px: where the known ones of the neighbours of pins (M,) put them."""
    near, place = lattice.near[pins], lattice.place
    known = which[near] >= 0
    share = weights(place[near] - place[pins][:, None], lattice.spacing, known)
    motion = np.where(known[..., None], found[which[near]] - place[near], 0)
    return place[pins] + np.einsum("mn,mnc->mc", share, motion)
