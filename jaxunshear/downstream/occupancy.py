"""Which skin lies over an object, determined from how the cells of the pins have grown: evidence, pin by pin.

Skin that bends over an edge is stretched most, and a little outside as much as far inside: the growth of one cell cannot part
these, how it changes from shell to shell of neighbours does. A logistic regression on both learns it from taps at known poses.

>>> occupancy = learn(lattice, place, growth, distance)         # of known taps
>>> evidence(occupancy, growth)                                 # (N, Q): above 0 over the object, below 0 beside it
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.sparse import csr_array
from scipy.sparse.csgraph import shortest_path
from scipy.spatial import Delaunay

from jaxunshear.image.lattice import Lattice

NEAR_MM = 6.0  # pins from the sensor's axis: farther out the dome curves away from what lies under it
SHELLS = 4  # of neighbours
EDGE_MM = 0.5  # skin this near to the edge counts as on it
CERTAIN = 3.0  # evidence beyond which no single pin counts
RIDGE = 1e-4


class Occupancy(NamedTuple):
    near: np.ndarray  # (P,) bool, the Q pins within NEAR_MM
    shells: np.ndarray  # (SHELLS, P, P) means over the neighbours 1, 2, ... steps away
    square: np.ndarray  # (P,) of the distance from the axis over NEAR_MM
    mean: np.ndarray  # (F,) of the features in the taps learnt from
    deviation: np.ndarray  # (F,)
    weights: np.ndarray  # (F,)
    level: float  # of the skin on the edge itself


def learn(lattice: Lattice, place: np.ndarray, growth: np.ndarray, distance: np.ndarray) -> Occupancy:
    """From taps with growth (N, P), NaN rows left out, whose pins lie (N, P) mm outside the object; place (P, 2) mm from the axis.

    Skin over the object and beside it count the same. The evidence of skin on the edge is brought to zero, as more of what is
    beside the object is certain than of what is over it.
    """
    followed = ~np.isnan(growth[:, 0])
    square, shells = np.sum(place**2, axis=-1) / NEAR_MM**2, _shells(lattice)
    near = square < 1
    features = _features(near, shells, square, growth[followed])
    features = features.reshape(-1, features.shape[-1])
    apart = distance[followed][:, near].ravel()
    mean, deviation = features.mean(axis=0), features.std(axis=0)
    mean[0], deviation[0] = 0, 1  # the constant
    features = (features - mean) / deviation
    sign = np.where(apart < 0, 1.0, -1.0)
    share = np.where(apart < 0, 0.5 / np.mean(apart < 0), 0.5 / np.mean(apart >= 0)) / len(apart)

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        off = -sign * (features @ weights)
        slope = -sign * share / (1 + np.exp(-off))
        return share @ np.logaddexp(0, off) + RIDGE * weights @ weights, features.T @ slope + 2 * RIDGE * weights

    weights = minimize(loss, np.zeros(features.shape[1]), jac=True, method="L-BFGS-B").x
    on_edge = np.clip(features @ weights, -CERTAIN, CERTAIN)[np.abs(apart) < EDGE_MM]
    return Occupancy(near, shells, square, mean, deviation, weights, float(on_edge.mean()))


def evidence(occupancy: Occupancy, growth: np.ndarray) -> np.ndarray:
    """(N, Q) of growth (N, P), for the pins near the axis: log-odds of lying over the object, the same on both sides at its edge."""
    features = _features(occupancy.near, occupancy.shells, occupancy.square, growth)
    features = (features - occupancy.mean) / occupancy.deviation
    return np.clip(features @ occupancy.weights, -CERTAIN, CERTAIN) - occupancy.level


def _features(near: np.ndarray, shells: np.ndarray, square: np.ndarray, growth: np.ndarray) -> np.ndarray:
    """(N, Q, F): growth of a cell and of its neighbours' shells, each also times its squared distance from the axis."""
    square = np.broadcast_to(square, growth.shape)
    grown = [growth, *(growth @ shell.T for shell in shells)]
    columns = [np.ones_like(growth), square, square**2, *grown, *(square * each for each in grown)]
    return np.stack(columns, -1)[:, near]


def _shells(lattice: Lattice) -> np.ndarray:
    start, neighbours = Delaunay(lattice.place).vertex_neighbor_vertices
    count = len(lattice.place)
    steps = shortest_path(
        csr_array((np.ones(len(neighbours)), neighbours, start), shape=(count, count)), unweighted=True
    )
    each = np.stack([steps == k for k in range(1, SHELLS + 1)])
    return each / np.maximum(each.sum(axis=-1, keepdims=True), 1)
