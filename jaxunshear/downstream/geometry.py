"""Contact geometry from pins (paper section 4.2; Cramphorn et al. 2018): each pin's Voronoi cell grows where the skin is pressed in.

>>> heights = relative_growth(lattice, track.motion)           # (P,) growth of each cell's area over the undeformed one
>>> surface(lattice.place, heights, 64)                        # (64, 64) smooth heights over the pins
>>> read_at(lattice.place + track.motion, heights, places)     # the same surface where the pins are, at places (M, 2)

A rim cell has no neighbours outside, and its Voronoi cell would be open. A ring of ghosts, one beyond each rim pin and moving with it,
closes these cells, at rest and in touch alike; so an undeformed sensor is exactly flat.
"""

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator
from scipy.spatial import Delaunay, Voronoi, cKDTree

from jaxunshear.image.growing import filled
from jaxunshear.image.lattice import Lattice


def relative_growth(lattice: Lattice, motion: np.ndarray) -> np.ndarray:
    """(..., P) area of each pin's cell over that of the undeformed sensor, less one; motion (..., P, 2) px, NaN for pins not seen."""
    rest = cell_areas(lattice, np.zeros_like(lattice.place))
    each = motion.reshape(-1, *motion.shape[-2:])
    return np.reshape([cell_areas(lattice, filled(lattice, one)) / rest - 1 for one in each], motion.shape[:-1])


def cell_areas(lattice: Lattice, motion: np.ndarray) -> np.ndarray:
    """(P,) px^2, areas of the Voronoi cells of the pins moved by (P, 2) px."""
    rim = np.flatnonzero(lattice.shell == lattice.shell.max())
    outward = lattice.place[rim] - lattice.middle
    outward = outward / np.linalg.norm(outward, axis=-1, keepdims=True)
    ghosts = lattice.place[rim] + lattice.spacing * outward + motion[rim]
    points = np.concatenate([lattice.place + motion, ghosts])
    cells = Voronoi(points)
    ends = np.array(cells.ridge_vertices)
    closed = (ends >= 0).all(axis=-1)  # an open side lies between two ghosts
    pairs, ends = cells.ridge_points[closed], ends[closed]
    width = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=-1)
    side = np.linalg.norm(cells.vertices[ends[:, 0]] - cells.vertices[ends[:, 1]], axis=-1)
    # every side makes a triangle with each of its two pins, of half their distance in height
    return np.bincount(pairs.ravel(), np.repeat(width * side / 4, 2), len(points))[: len(motion)]


def smoothed(lattice: Lattice, heights: np.ndarray) -> np.ndarray:
    """Heights (..., P) averaged over each pin and its neighbours: half a pixel of noise in a pin is a tenth of its cell."""
    start, neighbours = Delaunay(lattice.place).vertex_neighbor_vertices
    count = np.diff(start)
    around = np.add.reduceat(heights[..., neighbours], start[:-1], axis=-1)
    return (heights + around) / (1 + count)


def surface(place: np.ndarray, heights: np.ndarray, cells: int) -> np.ndarray:
    """(cells, cells) heights on a square grid over the pins (P, 2), rows along y: cubic (Clough-Tocher), NaN beyond the rim."""
    low, high = place.min(axis=0), place.max(axis=0)
    x, y = (np.linspace(low[i], high[i], cells) for i in (0, 1))
    return CloughTocher2DInterpolator(place, heights)(*np.meshgrid(x, y))


def read_at(place: np.ndarray, heights: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Heights (M, ...) at points (M, 2), of the cubic surface through (P, ...) at `place` (P, 2); beyond the rim of the nearest."""
    found = CloughTocher2DInterpolator(place, heights)(where)
    beyond = np.flatnonzero(np.isnan(found.reshape(len(where), -1)[:, 0]))
    found[beyond] = heights[cKDTree(place).query(where[beyond])[1]]
    return found
