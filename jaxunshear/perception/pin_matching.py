"""Match the pins of a lattice to detected ones, from a first motion.

Pairs of mutually nearest pins refine polynomials of rising degree, and last each pin follows its
neighbours. The first pairs that leave no pin over and move smoothly end the search.
"""

from typing import NamedTuple

import numpy as np

from jaxunshear.perception.lattice import POLYNOMIAL_DEGREES, Lattice
from jaxunshear.perception.pin_detection import compute_median
from jaxunshear.perception.pin_track import Rating, rate_identities

MAX_MATCH_DISTANCE = 0.75  # of the spacing: beyond it a detected pin is another one
# Fits of a polynomial, fewer if the distance of pairs falls by less than this ratio.
REPEATS = 3
CONVERGED_RATIO = 0.9
NEIGHBOUR_REPEATS = 4


def compute_middle(lattice: Lattice) -> np.ndarray:
    """Compute the middle (2,) px of the box around all pins at rest."""
    return (lattice.rest.max(axis=0) + lattice.rest.min(axis=0)) / 2


def fit_affine(lattice: Lattice, detected: np.ndarray, hidden: int) -> np.ndarray:
    """Move the pins (P, 2) to the mean and covariance of the detected ones, without a turn.

    Where a side of the pins has left the view, the outermost, as many as are `hidden`, are left out
    of the comparison.
    """
    rest, middle, spread = lattice.rest, detected.mean(axis=0), _compute_covariance(detected)
    compared = np.arange(len(rest))
    for _ in range(5):
        subset = rest[compared]
        root = _root(_compute_covariance(subset))
        inverse = np.linalg.inv(root)
        stretch = inverse @ _root(root @ spread @ root) @ inverse
        position = (rest - subset.mean(axis=0)) @ stretch + middle
        if not hidden:
            break
        distance = np.linalg.norm(position - compute_middle(lattice), axis=-1)
        inner = np.sort(np.argsort(distance)[: len(rest) - hidden])
        if np.array_equal(inner, compared):
            break
        compared = inner
    return position


def _compute_covariance(points: np.ndarray) -> np.ndarray:
    offset = points - points.mean(axis=0)
    return offset.T @ offset / (len(points) - 1)


def _root(matrix: np.ndarray) -> np.ndarray:
    """Return the square root of a symmetric matrix (2, 2) without negative eigenvalues."""
    determinant = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] ** 2
    root = np.sqrt(max(determinant, 0.0))
    return (matrix + root * np.eye(2)) / np.sqrt(matrix[0, 0] + matrix[1, 1] + 2 * root)


def match_iteratively(lattice: Lattice, detected: np.ndarray, motion: np.ndarray) -> Rating:
    """Match pins to the rows of the detected ones, from a first motion (P, 2).

    Ends as soon as all have a partner that moves as its neighbours do.
    """
    pairs = _pair_nearest(lattice.rest + motion, detected)
    for degree in POLYNOMIAL_DEGREES:
        for _ in range(REPEATS):
            rating = _rate_complete(lattice, detected, pairs)
            if rating is not None:
                return rating
            middle = compute_median(pairs.distance)
            motion = _fit_polynomial(lattice, detected, pairs, degree)
            pairs = _pair_nearest(lattice.rest + motion, detected)
            if compute_median(pairs.distance) > CONVERGED_RATIO * middle:
                break
    return _follow_neighbours(lattice, detected, pairs, motion)


class _Pairs(NamedTuple):
    """Pairs of an expected and a detected pin that are each other's nearest."""

    pin: np.ndarray  # (N,) rows of the expected pins
    detected: np.ndarray  # (N,) rows of the detected pins
    distance: np.ndarray  # (N,) px


def _fit_polynomial(
    lattice: Lattice, detected: np.ndarray, pairs: _Pairs, degree: int
) -> np.ndarray:
    """Fit a motion (P, 2) px, a polynomial of the rest position, to pairs; far ones count less."""
    scale = max(2.5 * compute_median(pairs.distance), 0.06 * lattice.spacing)
    share = 1 / (1 + (pairs.distance / scale) ** 2)
    powers = lattice.powers[degree]
    paired = powers[pairs.pin]
    weighted = paired.T * share
    normal = weighted @ paired + 1e-3 * np.eye(powers.shape[1])
    motion = detected[pairs.detected] - lattice.rest[pairs.pin]
    return powers @ np.linalg.solve(normal, weighted @ motion)


def _follow_neighbours(
    lattice: Lattice, detected: np.ndarray, pairs: _Pairs, motion: np.ndarray
) -> Rating:
    """Match pins to detected ones while each pin follows the motion of its neighbours."""
    identity = np.zeros(0, int)
    for _ in range(NEIGHBOUR_REPEATS):
        rating = _rate_complete(lattice, detected, pairs)
        if rating is not None:
            return rating
        before, identity = identity, _identify(lattice, pairs)
        if np.array_equal(before, identity):
            break
        matched = np.where(identity[:, None] >= 0, detected[identity] - lattice.rest, motion)
        motion = lattice.neighbour_weights @ matched
        pairs = _pair_nearest(lattice.rest + motion, detected)
    return rate_identities(lattice, detected, identity)


def _rate_complete(lattice: Lattice, detected: np.ndarray, pairs: _Pairs) -> Rating | None:
    """Rate pairs if they leave no pin over, or no detected one, and are calm; else return None."""
    if len(pairs.pin) < min(len(lattice.rest), len(detected)):
        return None
    rating = rate_identities(lattice, detected, _identify(lattice, pairs))
    return rating if rating.complete else None


def _identify(lattice: Lattice, pairs: _Pairs) -> np.ndarray:
    """Return the rows (P,) of the detected pins in pairs, -1 for those that are too far."""
    identity = np.full(len(lattice.rest), -1)
    near = pairs.distance <= MAX_MATCH_DISTANCE * lattice.spacing
    identity[pairs.pin[near]] = pairs.detected[near]
    return identity


def _pair_nearest(expected: np.ndarray, detected: np.ndarray) -> _Pairs:
    """Pair the expected and detected pins that are each other's nearest."""
    # For some hundred pins all distances at once take less time than trees do.
    middle = detected.mean(axis=0)
    here, there = expected - middle, detected - middle
    left = np.column_stack([here, (here**2).sum(axis=1), np.ones(len(here))])
    right = np.column_stack([-2 * there, np.ones(len(there)), (there**2).sum(axis=1)])
    squares = left.astype(np.float32) @ right.astype(np.float32).T
    nearest = squares.argmin(axis=1)
    least = squares[np.arange(len(expected)), nearest]
    rows = np.flatnonzero(squares.min(axis=0)[nearest] == least)
    columns = nearest[rows]
    return _Pairs(rows, columns, np.hypot(*(expected[rows] - detected[columns]).T))
