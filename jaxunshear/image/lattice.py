"""Where a sensor's pins stand in an image before they move, with what following them needs."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from jaxunshear.scene.sensor import Sensor

NEIGHBOURS = 18  # pins that tell where another one is
DEGREES = (2, 2, 2, 3, 3, 3, 4, 4)  # of the polynomials that a motion is refined by, one after the other


class Lattice(NamedTuple):
    place: np.ndarray  # (P, 2) px as (column, row), in the order of the sensor's lattice
    shell: np.ndarray  # (P,) 0 in the middle, the largest on the rim
    spacing: float  # px, usual distance between neighbours
    around: np.ndarray  # (P, P): weights of the nearest other pins
    powers: dict[int, np.ndarray]  # by degree, (P, terms) polynomials of the place

    @property
    def middle(self) -> np.ndarray:
        """(2,) px of the outermost shell, which a touch moves least."""
        return self.place[self.shell == self.shell.max()].mean(axis=0)


def shells(sensor: Sensor) -> np.ndarray:
    """(P,) index of the shell of each pin, 0 for the one in the middle."""
    return np.repeat(np.arange(sensor.rings + 1), [1] + [6 * k for k in range(1, sensor.rings + 1)])


def shells_of(place: np.ndarray) -> np.ndarray:
    """(P,) the same for pins in any order and layout: by their distance from the middle, in spacings."""
    off = np.linalg.norm(place - place.mean(axis=0), axis=-1)
    return np.round(off / _spacing(place)).astype(int)


def make_lattice(place: np.ndarray, shell: np.ndarray | None = None) -> Lattice:
    """A lattice from the places (P, 2) px of its pins."""
    offset = place - place.mean(axis=0)
    powers = {degree: _powers(offset / np.abs(offset).max(), degree) for degree in set(DEGREES)}
    shell = shells_of(place) if shell is None else shell
    return Lattice(place, shell, _spacing(place), _around(place), powers)


def _spacing(place: np.ndarray) -> float:
    return float(np.median(cKDTree(place).query(place, k=2)[0][:, 1]))


def _powers(x: np.ndarray, degree: int) -> np.ndarray:
    """Monomials (N, terms) of x (N, 2) up to a degree."""
    pairs = [(i, n - i) for n in range(degree + 1) for i in range(n + 1)]
    return np.stack([x[:, 0] ** i * x[:, 1] ** j for i, j in pairs], axis=-1)


def _around(place: np.ndarray) -> np.ndarray:
    """(P, P): a quadratic motion fitted to the nearest other pins, read at each pin."""
    spacing, weights = _spacing(place), np.zeros((len(place), len(place)))
    count = min(NEIGHBOURS + 1, len(place))
    for pin, near in enumerate(cKDTree(place).query(place, k=count)[1]):
        near = near[near != pin]
        offset = (place[near] - place[pin]) / spacing
        share = 1 / (1 + (offset**2).sum(-1))
        design = _powers(offset, 2)
        ridge = np.diag([0.0, 0.05, 0.05, 0.5, 0.5, 0.5])  # towards fewer terms, on the rim above all
        weights[pin, near] = np.linalg.solve(design.T @ (share[:, None] * design) + ridge, design.T * share)[0]
    return weights
