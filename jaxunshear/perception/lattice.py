"""Where a sensor's pins stand in an image before they move, with what following them needs."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from jaxunshear.config.sensor import Sensor

NEIGHBOURS = 18  # pins that give the place of another one
POLYNOMIAL_DEGREES = (
    2,
    3,
    4,
)  # of the polynomials that a motion is refined by, one after the other


class Lattice(NamedTuple):
    rest: np.ndarray  # (P, 2) px as (column, row), in the order of the sensor's lattice
    ring: np.ndarray  # (P,) 0 in the middle, the largest on the rim
    spacing: float  # px, usual distance between neighbours
    neighbours: np.ndarray  # (P, NEIGHBOURS) the nearest other pins, the nearest first
    neighbour_weights: np.ndarray  # (P, P): their weights
    powers: dict[int, np.ndarray]  # by degree, (P, terms) polynomials of the place

    @property
    def centre(self) -> Float[np.ndarray, "2"]:
        """In px, of the outermost shell, which a touch moves least."""
        return self.rest[self.ring == self.ring.max()].mean(axis=0)


def compute_rings(sensor: Sensor) -> Int[np.ndarray, "P"]:
    """Index of the shell of each pin, 0 for the one in the middle."""
    return np.repeat(np.arange(sensor.rings + 1), [1] + [6 * k for k in range(1, sensor.rings + 1)])


def estimate_rings(place: Float[np.ndarray, "P 2"]) -> Int[np.ndarray, "P"]:
    """The same for pins in any order and layout: by their distance from the middle, in spacings."""
    off = np.linalg.norm(place - place.mean(axis=0), axis=-1)
    return np.round(off / measure_spacing(place)).astype(int)


def make_lattice(
    place: Float[np.ndarray, "P 2"], shell: Int[np.ndarray, "P"] | None = None
) -> Lattice:
    """A lattice from the places px of its pins."""
    offset = place - place.mean(axis=0)
    powers = {
        degree: _powers(offset / np.abs(offset).max(), degree) for degree in POLYNOMIAL_DEGREES
    }
    shell = estimate_rings(place) if shell is None else shell
    near = cKDTree(place).query(place, k=min(NEIGHBOURS + 1, len(place)))[1][:, 1:]
    around = np.zeros((len(place), len(place)))
    np.put_along_axis(
        around,
        near,
        compute_neighbour_weights(place[near] - place[:, None], measure_spacing(place)),
        axis=1,
    )
    return Lattice(place, shell, measure_spacing(place), near, around, powers)


def measure_spacing(place: Float[np.ndarray, "P 2"]) -> float:
    """The usual distance between neighbours: the median from a pin to the nearest other one, in the unit of their places."""
    return float(np.median(cKDTree(place).query(place, k=2)[0][:, 1]))


def _powers(x: np.ndarray, degree: int) -> np.ndarray:
    """Monomials (..., terms) of x (..., 2) up to a degree."""
    pairs = [(i, n - i) for n in range(degree + 1) for i in range(n + 1)]
    return np.stack([x[..., 0] ** i * x[..., 1] ** j for i, j in pairs], axis=-1)


def compute_neighbour_weights(
    offset: Float[np.ndarray, "M N 2"], spacing: float, known: Bool[np.ndarray, "M N"] | None = None
) -> Float[np.ndarray, "M N"]:
    """Weights of other pins at offsets px: of a quadratic motion fitted to theirs, read at the pin itself.

    Those not `known` have none.
    """
    offset = offset / spacing
    share = 1 / (1 + (offset**2).sum(-1))
    if known is not None:
        share = share * known
    design = _powers(offset, 2)
    ridge = np.diag([1e-12, 0.05, 0.05, 0.5, 0.5, 0.5])  # towards fewer terms, on the rim above all
    weighted = np.swapaxes(design * share[..., None], -1, -2)
    return np.linalg.solve(weighted @ design + ridge, weighted)[..., 0, :]
