"""The lattice of a sensor's pins in an image at rest, with what pin tracking needs of it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

from jaxunshear.config.sensor import Sensor
from jaxunshear.errors import UserError

NEIGHBOURS = 18  # pins that predict the position of another one
POLYNOMIAL_DEGREES = (2, 3, 4)  # of the polynomials that refine a motion, in turn
INNER_RING_SHARE = 0.75  # of the outermost ring
# By which a quadratic motion is drawn towards fewer terms, mostly on the rim.
RIDGE = np.diag([1e-12, 0.05, 0.05, 0.5, 0.5, 0.5])
RIM_RINGS = 2  # of the outermost rings, which show the view's shift
MAX_EDGE = 1.6  # of the spacing, from a pin to its neighbour
# of an edge, from its middle to any third pin: less in a square's diagonal, which chance would draw
MIN_FREE = 0.6


class Lattice(NamedTuple):
    """The rest positions of P pins, and their neighbours."""

    rest: np.ndarray  # (P, 2) px as (column, row), in the order of the sensor's lattice
    ring: np.ndarray  # (P,) 0 in the middle, the largest on the rim
    spacing: float  # px, usual distance between neighbours
    neighbours: np.ndarray  # (P, NEIGHBOURS) the nearest other pins, the nearest first
    neighbour_weights: np.ndarray  # (P, P): their weights
    neighbour_powers: np.ndarray  # (P, NEIGHBOURS, 6) of their offsets, up to squares
    weighted_powers: np.ndarray  # (P, 6, NEIGHBOURS): nearer ones weigh more
    powers: dict[int, np.ndarray]  # by degree, (P, terms) polynomials of the rest position
    lost: tuple[int, ...] = ()  # pins that are no longer on the dome, in order
    intact: "Lattice | None" = None  # the lattice of the other pins, if any are lost

    @property
    def is_inner(self) -> Bool[np.ndarray, "P"]:
        """Which pins are so far within that the housing hides none of them."""
        return self.ring < INNER_RING_SHARE * self.ring.max()

    @property
    def remaining(self) -> Int[np.ndarray, "L"]:
        """The pins that are not lost."""
        return np.setdiff1d(np.arange(len(self.rest)), self.lost)

    @property
    def centre(self) -> Float[np.ndarray, "2"]:
        """The centre px of the outermost ring, which a contact moves least."""
        return self.rest[self.ring == self.ring.max()].mean(axis=0)

    def fill_missing(self, motion: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
        """Fill the missing rows of a motion from the nearest ones that are not missing."""
        missing = np.isnan(motion[:, 0])
        rows, full = np.flatnonzero(missing), motion.copy()
        if not len(rows):
            return full
        near = self.neighbours[rows]
        nearest = near[np.arange(len(rows)), np.argmin(missing[near], axis=1)]
        if missing[nearest].any():
            visible = np.flatnonzero(~missing)
            nearest = visible[cKDTree(self.rest[visible]).query(self.rest[rows])[1]]
        full[rows] = motion[nearest]
        full[rows] = self.neighbour_weights[rows] @ full
        return full

    def fill_holes(self, motion: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
        """Fill the rows of lost pins, and of inner ones that are missing, from their neighbours.

        Outer pins that the housing hides remain NaN: no neighbour beyond them is seen.
        """
        missing = np.isnan(motion[:, 0])
        hole = missing & (self.is_inner | np.isin(np.arange(len(motion)), self.lost))
        if missing.all() or not hole.any():
            return motion
        return np.where(hole[:, None], self.fill_missing(motion), motion)

    def measure_offsets(self, motion: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P"]:
        """Measure how far each pin stands from where its neighbours' motion px puts it.

        Offsets are in units of the spacing; 0 for pins that are missing.
        """
        full = self.fill_missing(motion)
        offset = np.hypot(*(full - self.neighbour_weights @ full).T) / self.spacing
        return np.where(np.isnan(motion[:, 0]), 0, offset)


def compute_rings(sensor: Sensor) -> Int[np.ndarray, "P"]:
    """Return the ring of each pin of a sensor, 0 in the middle."""
    return estimate_rings(sensor.place_pins())


def find_neighbours(rest: Float[np.ndarray, "P 2"]) -> Int[np.ndarray, "E 2"]:
    """Find which pins are next to each other: edges of Delaunay's triangles, unless they are long.

    Diagonals of squares are left out. Pins on one line have no neighbours.
    """
    try:
        corners = Delaunay(rest).simplices
    except QhullError:
        return np.zeros((0, 2), int)
    sides = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [0, 2]]])
    edges = np.unique(np.sort(sides, axis=1), axis=0)
    first, second = rest[edges[:, 0]], rest[edges[:, 1]]
    length = np.linalg.norm(first - second, axis=-1)
    third = cKDTree(rest).query((first + second) / 2, k=3)[0][:, 2]
    return edges[(length < MAX_EDGE * measure_spacing(rest)) & (third > MIN_FREE * length)]


def estimate_rings(rest: Float[np.ndarray, "P 2"]) -> Int[np.ndarray, "P"]:
    """Estimate the rings of pins in any layout, by steps from the outline to neighbours."""
    edges, depth = find_neighbours(rest), np.zeros(len(rest), int)
    if not len(edges):
        return depth
    sides = ConvexHull(rest).equations
    inside = -np.max(rest @ sides[:, :2].T + sides[:, 2], axis=1)
    reached = inside < 0.5 * measure_spacing(rest)
    front = reached
    while front.any():
        near = edges[front[edges].any(axis=1)].ravel()
        front = np.isin(np.arange(len(rest)), near) & ~reached
        depth[~reached] += 1
        reached = reached | front
    return depth.max() - depth


def make_lattice(
    rest: Float[np.ndarray, "P 2"],
    ring: Int[np.ndarray, "P"] | None = None,
    lost: Sequence[int] = (),
) -> Lattice:
    """Make a lattice from the rest positions px of its pins.

    Rings are estimated if None. Pins that are `lost` are searched for in no image.
    """
    offset, spacing = rest - rest.mean(axis=0), measure_spacing(rest)
    unit = offset / np.abs(offset).max()
    powers = {degree: _powers(unit, degree) for degree in POLYNOMIAL_DEGREES}
    ring = estimate_rings(rest) if ring is None else ring
    near = cKDTree(rest).query(rest, k=min(NEIGHBOURS + 1, len(rest)))[1][:, 1:]
    near_offset = (rest[near] - rest[:, None]) / spacing
    near_powers = _powers(near_offset, 2)
    weighted = np.swapaxes(near_powers / (1 + (near_offset**2).sum(-1))[..., None], -1, -2)
    weights = np.zeros((len(rest), len(rest)))
    near_weights = np.linalg.solve(weighted @ near_powers + RIDGE, weighted)[:, 0]
    np.put_along_axis(weights, near, near_weights, axis=1)
    lattice = Lattice(
        rest, ring, spacing, near, weights, near_powers, weighted, powers, tuple(sorted(lost))
    )
    if not lattice.lost:
        return lattice
    return lattice._replace(intact=make_lattice(rest[lattice.remaining], ring[lattice.remaining]))


def find_rim(ring: np.ndarray) -> np.ndarray:
    """Find which pins (P,) are in the outermost rings, which contacts move least."""
    is_rim: np.ndarray = ring > ring.max() - RIM_RINGS
    return is_rim


def check_pin_numbers(without: Sequence[int], count: int) -> None:
    """Raise UserError if a number is of none of `count` pins."""
    if without and not 0 <= min(without) <= max(without) < count:
        numbers = ",".join(map(str, without))
        raise UserError(f"--without {numbers}: pins have numbers from 0 to {count - 1}")


def measure_spacing(rest: Float[np.ndarray, "P 2"]) -> float:
    """Return the median distance from a pin to the nearest other one, in the unit of `rest`."""
    return float(np.median(cKDTree(rest).query(rest, k=2)[0][:, 1]))


def _powers(x: np.ndarray, degree: int) -> np.ndarray:
    """Return the monomials (..., terms) of x (..., 2) up to a degree."""
    pairs = [(i, n - i) for n in range(degree + 1) for i in range(n + 1)]
    return np.stack([x[..., 0] ** i * x[..., 1] ** j for i, j in pairs], axis=-1)
