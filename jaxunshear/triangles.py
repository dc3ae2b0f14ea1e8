"""Linear interpolation between scattered points of a plane.

>>> corners, weights, _ = find_corners(Delaunay(points), places)
>>> (weights[..., None] * values[corners]).sum(axis=1)  # values (P, D) -> at the places (N, D)
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import Delaunay, cKDTree


class Corners(NamedTuple):
    """The points that a place lies between, and what they count there."""

    points: Int[np.ndarray, "N 3"]
    weights: Float[np.ndarray, "N 3"]
    is_outside: Bool[np.ndarray, "N"]


def find_corners(mesh: Delaunay, places: Float[np.ndarray, "N 2"]) -> Corners:
    """Find the corners of the triangle that each place is in; outside, the nearest point alone."""
    triangle = mesh.find_simplex(places)
    points, transform = mesh.simplices[triangle], mesh.transform[triangle]
    first = np.einsum("nij,nj->ni", transform[:, :2], places - transform[:, 2])
    weights = np.column_stack([first, 1 - first.sum(axis=-1)])
    is_outside = triangle < 0
    if is_outside.any():
        points[is_outside] = cKDTree(mesh.points).query(places[is_outside])[1][:, None]
        weights[is_outside] = [1, 0, 0]
    return Corners(points, weights, is_outside)
