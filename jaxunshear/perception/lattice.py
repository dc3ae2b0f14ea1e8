"""The lattice of a sensor's pins in an image at rest, with what pin tracking needs of it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from jaxunshear.config.sensor import Sensor

NEIGHBOURS = 18  # pins that predict the position of another one
POLYNOMIAL_DEGREES = (2, 3, 4)  # of the polynomials that refine a motion, in turn


class Lattice(NamedTuple):
    """The rest positions of P pins, and their neighbours."""

    rest: np.ndarray  # (P, 2) px as (column, row), in the order of the sensor's lattice
    ring: np.ndarray  # (P,) 0 in the middle, the largest on the rim
    spacing: float  # px, usual distance between neighbours
    neighbours: np.ndarray  # (P, NEIGHBOURS) the nearest other pins, the nearest first
    neighbour_weights: np.ndarray  # (P, P): their weights
    powers: dict[int, np.ndarray]  # by degree, (P, terms) polynomials of the rest position

    @property
    def centre(self) -> Float[np.ndarray, "2"]:
        """The centre px of the outermost ring, which a contact moves least."""
        return self.rest[self.ring == self.ring.max()].mean(axis=0)

    def fill_missing(self, motion: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
        """Fill the missing rows of a motion from the nearest ones that are not missing."""
        visible = ~np.isnan(motion[:, 0])
        nearest = cKDTree(self.rest[visible]).query(self.rest)[1]
        guess = motion[visible][nearest]
        return np.where(visible[:, None], motion, self.neighbour_weights @ guess)

    def measure_offsets(self, motion: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P"]:
        """Measure how far each pin stands from where its neighbours' motion px puts it.

        Offsets are in units of the spacing; 0 for pins that are missing.
        """
        full = self.fill_missing(motion) if np.isnan(motion).any() else motion
        offset = np.linalg.norm(full - self.neighbour_weights @ full, axis=-1) / self.spacing
        return np.where(np.isnan(motion[:, 0]), 0, offset)


def compute_rings(sensor: Sensor) -> Int[np.ndarray, "P"]:
    """Return the ring of each pin of a sensor, 0 for the one in the middle."""
    if not sensor.has_rings:
        return estimate_rings(sensor.place_pins())
    return np.repeat(np.arange(sensor.rings + 1), [1] + [6 * k for k in range(1, sensor.rings + 1)])


def estimate_rings(rest: Float[np.ndarray, "P 2"]) -> Int[np.ndarray, "P"]:
    """Estimate the rings of pins in any layout from their distance to the middle, in spacings."""
    distance = np.linalg.norm(rest - rest.mean(axis=0), axis=-1)
    return np.round(distance / measure_spacing(rest)).astype(int)


def make_lattice(
    rest: Float[np.ndarray, "P 2"], ring: Int[np.ndarray, "P"] | None = None
) -> Lattice:
    """Make a lattice from the rest positions px of its pins; their rings are estimated if None."""
    offset, spacing = rest - rest.mean(axis=0), measure_spacing(rest)
    unit = offset / np.abs(offset).max()
    powers = {degree: _powers(unit, degree) for degree in POLYNOMIAL_DEGREES}
    ring = estimate_rings(rest) if ring is None else ring
    near = cKDTree(rest).query(rest, k=min(NEIGHBOURS + 1, len(rest)))[1][:, 1:]
    near_weights = compute_neighbour_weights(rest[near] - rest[:, None], spacing)
    weights = np.zeros((len(rest), len(rest)))
    np.put_along_axis(weights, near, near_weights, axis=1)
    return Lattice(rest, ring, spacing, near, weights, powers)


def measure_spacing(rest: Float[np.ndarray, "P 2"]) -> float:
    """Return the median distance from a pin to the nearest other one, in the unit of `rest`."""
    return float(np.median(cKDTree(rest).query(rest, k=2)[0][:, 1]))


def _powers(x: np.ndarray, degree: int) -> np.ndarray:
    """Return the monomials (..., terms) of x (..., 2) up to a degree."""
    pairs = [(i, n - i) for n in range(degree + 1) for i in range(n + 1)]
    return np.stack([x[..., 0] ** i * x[..., 1] ** j for i, j in pairs], axis=-1)


def compute_neighbour_weights(
    offset: Float[np.ndarray, "M N 2"],
    spacing: float,
    usable: Bool[np.ndarray, "M N"] | None = None,
) -> Float[np.ndarray, "M N"]:
    """Compute weights of neighbours at offsets px, by which their motions give a pin's motion.

    They fit a quadratic motion to the neighbours and read it at the pin. Neighbours that are not
    `usable` get no weight.
    """
    offset = offset / spacing
    share = 1 / (1 + (offset**2).sum(-1))
    if usable is not None:
        share = share * usable
    design = _powers(offset, 2)
    ridge = np.diag([1e-12, 0.05, 0.05, 0.5, 0.5, 0.5])  # towards fewer terms, mostly on the rim
    weighted = np.swapaxes(design * share[..., None], -1, -2)
    return np.linalg.solve(weighted @ design + ridge, weighted)[..., 0, :]
