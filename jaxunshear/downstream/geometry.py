"""Contact geometry from pins, by Voronoi cells or by an inverse model of the skin.

>>> estimators = make_height_estimators(lattice, taps)    # by name, from taps of known indentation
>>> heights = estimators["inverse"](motion)               # (N, P) mm, from motions (N, P, 2) px
>>> interpolate_surface(lattice.rest, heights[0], 64)     # (64, 64) smooth heights over the pins
>>> interpolate_heights(lattice.rest + motion[0], heights[0], points)     # at points (M, 2)

`areas`    the area of each pin's Voronoi cell in the image (paper section 4.2;
           Cramphorn et al. 2018)
`inverse`  a linear map of all pins' motion. Cells contain only how the skin is stretched; pins also
           show where it moved and how it rotated. Skin and gel are linear to about 3 mm.

A rim pin has no neighbours outside, so its Voronoi cell would be open. A ring of ghost points, one
beyond each rim pin and moving with it, closes these cells, at rest and in contact alike.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator
from scipy.spatial import Voronoi, cKDTree
from sklearn.linear_model import Ridge

from jaxunshear.data.simulation import SimulatedContacts
from jaxunshear.errors import UserError
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_tracking import measure_motions

AREAS, INVERSE = HEIGHT_METHODS = ("areas", "inverse")
NOISE_SPACINGS = 0.06  # error of a pin's coordinates in spacings: 0.3 px at 128 px
MIN_INDENTATION_MM = 0.2  # images of the untouched sensor of 128 px give up to 0.1


class HeightEstimator(NamedTuple):
    estimate: Callable[[np.ndarray], np.ndarray]  # motions (N, P, 2) px of all pins -> (N, P)
    mm_per_unit: float  # a unit of height

    def __call__(self, motion: np.ndarray) -> np.ndarray:
        return self.mm_per_unit * self.estimate(motion)


def make_height_estimators(lattice: Lattice, taps: SimulatedContacts) -> dict[str, HeightEstimator]:
    """Make both estimators by name, scaled to mm by taps of known indentation."""
    motion = measure_tap_motions(lattice, taps)
    followed = ~np.isnan(motion[:, 0, 0])
    motion, indentation = motion[followed], taps.indentation_mm[followed]
    usual_area = compute_cell_areas(lattice, np.zeros_like(lattice.rest)).mean()
    inverse = fit_inverse(lattice, motion, indentation)

    def estimate_by_areas(motion: np.ndarray) -> np.ndarray:
        return np.stack([compute_cell_areas(lattice, each) for each in motion]) / usual_area - 1

    def estimate_by_inverse(motion: np.ndarray) -> np.ndarray:
        return estimate_indentation(inverse, motion)

    estimators = {}
    for name, estimate in ((AREAS, estimate_by_areas), (INVERSE, estimate_by_inverse)):
        heights = estimate(motion)
        mm_per_unit = float(np.sum(indentation * heights) / np.sum(heights**2))
        estimators[name] = HeightEstimator(estimate, mm_per_unit)
    return estimators


def measure_tap_motions(lattice: Lattice, taps: SimulatedContacts) -> np.ndarray:
    """Follow the pins of taps: motions (N, P, 2) px.

    Raises `UserError` if hardly any tap shows its pins well enough.
    """
    motion = measure_motions(lattice, taps.tap)
    share = np.mean(~np.isnan(motion[:, 0, 0]))
    if share < 0.5:
        raise UserError(
            f"pins are identified in only {100 * share:.0f} % of simulated taps "
            f"of {taps.tap.shape[1]} px: use a model of larger images (128 px or more)"
        )
    return motion


def fit_inverse(lattice: Lattice, motion: np.ndarray, indentation: np.ndarray) -> np.ndarray:
    """Fit the (2P, P) mm/px that turn pin motions into indentation, by ridge regression.

    The taps have motions (N, P, 2) px and indentations (N, P) mm. The ridge stands for errors of
    NOISE_SPACINGS in the pins' coordinates.
    """
    ridge = Ridge(len(motion) * (NOISE_SPACINGS * lattice.spacing) ** 2, fit_intercept=False)
    return ridge.fit(motion.reshape(len(motion), -1), indentation).coef_.T


def estimate_indentation(inverse: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Turn motions (N, P, 2) px into indentation (N, P) mm.

    It is zero for all pins of a contact if none reaches MIN_INDENTATION_MM: nothing is touched.
    """
    indentation = motion.reshape(len(motion), len(inverse)) @ inverse
    deepest = indentation.max(axis=-1, keepdims=True, initial=0)
    return np.where(deepest < MIN_INDENTATION_MM, 0.0, indentation)


def compute_relative_growth(lattice: Lattice, motion: np.ndarray) -> np.ndarray:
    """Compute the growth (..., P) of each pin's cell as a share of its area at rest.

    `motion` (..., P, 2) px, NaN for pins that were not detected.
    """
    rest_areas = compute_cell_areas(lattice, np.zeros_like(lattice.rest))
    growth = []
    for contact in motion.reshape(-1, *motion.shape[-2:]):
        areas = compute_cell_areas(lattice, lattice.fill_missing(contact))
        growth.append(areas / rest_areas - 1)
    return np.reshape(growth, motion.shape[:-1])


def compute_cell_areas(lattice: Lattice, motion: np.ndarray) -> np.ndarray:
    """Compute the areas (P,) px^2 of the Voronoi cells of the pins moved by (P, 2) px."""
    rim = np.flatnonzero(lattice.ring == lattice.ring.max())
    outward = lattice.rest[rim] - lattice.centre
    outward = outward / np.linalg.norm(outward, axis=-1, keepdims=True)
    ghosts = lattice.rest[rim] + lattice.spacing * outward + motion[rim]
    points = np.concatenate([lattice.rest + motion, ghosts])
    cells = Voronoi(points)
    ends = np.array(cells.ridge_vertices)
    closed = (ends >= 0).all(axis=-1)  # an open side lies between two ghosts
    pairs, ends = cells.ridge_points[closed], ends[closed]
    width = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=-1)
    side = np.linalg.norm(cells.vertices[ends[:, 0]] - cells.vertices[ends[:, 1]], axis=-1)
    # every side makes a triangle with each of its two pins, of half their distance in height
    return np.bincount(pairs.ravel(), np.repeat(width * side / 4, 2), len(points))[: len(motion)]


def interpolate_surface(positions: np.ndarray, heights: np.ndarray, cells: int) -> np.ndarray:
    """Interpolate heights (cells, cells) on a square grid over the pins (P, 2), rows along y.

    The surface is cubic (Clough-Tocher), and NaN beyond the rim.
    """
    low, high = positions.min(axis=0), positions.max(axis=0)
    x, y = np.linspace(low[0], high[0], cells), np.linspace(low[1], high[1], cells)
    return CloughTocher2DInterpolator(positions, heights)(*np.meshgrid(x, y))


def interpolate_heights(
    positions: np.ndarray, heights: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Interpolate heights (P, ...) of pins at `positions` (P, 2) to points (M, 2).

    The surface is cubic; beyond the rim the nearest pin's height counts.
    """
    values = CloughTocher2DInterpolator(positions, heights)(points)
    beyond = np.flatnonzero(np.isnan(values.reshape(len(points), -1)[:, 0]))
    values[beyond] = heights[cKDTree(positions).query(points[beyond])[1]]
    return values
