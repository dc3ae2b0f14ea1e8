"""Contact geometry from pins: by the paper's Voronoi cells, or by the inverse of the skin.

>>> ways = make_height_estimators(lattice, known)                             # by name, from taps of known indentation
>>> heights = ways["inverse"](motion)                          # (N, P) mm, from motions (N, P, 2) px
>>> interpolate_surface(lattice.place, heights[0], 64)                     # (64, 64) smooth heights over the pins
>>> interpolate_heights(lattice.place + motion[0], heights[0], places)     # the same surface at (M, 2) places

`areas`    the area of each pin's Voronoi cell in the image (paper section 4.2; Cramphorn et al. 2018)
`inverse`  a linear map of all pins' motion: cells hold only how the skin is stretched, but pins also
           show where it moved and how it turned. Skin and gel are linear to about 3 mm.

A rim cell has no neighbours outside, and its Voronoi cell would be open. A ring of ghosts, one beyond
each rim pin and moving with it, closes these cells, at rest and in touch alike.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator
from scipy.spatial import Voronoi, cKDTree
from sklearn.linear_model import Ridge

from jaxunshear.data.simulated_contacts import SimulatedContacts
from jaxunshear.errors import UserError
from jaxunshear.perception.identity_repair import fill_missing
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_tracking import measure_motions

AREAS, INVERSE = HEIGHT_METHODS = ("areas", "inverse")
NOISE_SPACINGS = 0.06  # spacings by which a pin's coordinates may be off: 0.3 px at 128 px
MIN_INDENTATION_MM = 0.2  # images of the untouched sensor of 128 px give up to 0.1


class HeightEstimator(NamedTuple):
    estimate: Callable[[np.ndarray], np.ndarray]  # motions (N, P, 2) px of all pins -> (N, P)
    mm_per_unit: float  # a unit of height

    def __call__(self, motion: np.ndarray) -> np.ndarray:
        return self.mm_per_unit * self.estimate(motion)


def make_height_estimators(
    lattice: Lattice, known: SimulatedContacts
) -> dict[str, HeightEstimator]:
    """Return both ways by name, each with its factor to mm from taps of known indentation."""
    motion = measure_tap_motions(lattice, known)
    followed = ~np.isnan(motion[:, 0, 0])
    motion, true = motion[followed], known.indentation_mm[followed]
    usual = compute_cell_areas(lattice, np.zeros_like(lattice.rest)).mean()
    inverse = fit_inverse(lattice, motion, true)
    heights: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        AREAS: lambda moved: (
            np.stack([compute_cell_areas(lattice, each) for each in moved]) / usual - 1
        ),
        INVERSE: lambda moved: estimate_indentation(inverse, moved),
    }
    return {
        name: HeightEstimator(each, _factor(each(motion), true)) for name, each in heights.items()
    }


def _factor(heights: np.ndarray, true: np.ndarray) -> float:
    return float(np.sum(true * heights) / np.sum(heights**2))


def measure_tap_motions(lattice: Lattice, known: SimulatedContacts) -> np.ndarray:
    """Follow the pins of taps: motions (N, P, 2) px.

    Raises `UserError` if hardly any tap shows its pins well enough.
    """
    motion = measure_motions(lattice, known.tap)
    sure = np.mean(~np.isnan(motion[:, 0, 0]))
    if sure < 0.5:
        raise UserError(
            f"pins are identified in only {100 * sure:.0f} % of simulated taps of {known.tap.shape[1]} px: "
            "use a model of larger images (128 px or more)"
        )
    return motion


def fit_inverse(lattice: Lattice, motion: np.ndarray, indentation: np.ndarray) -> np.ndarray:
    """Fit the (2P, P) mm/px that turn pin motions into indentation, by ridge regression.

    The taps have motions (N, P, 2) px and indentations (N, P) mm. The ridge is as if the pins were
    off by NOISE.
    """
    ridge = Ridge(len(motion) * (NOISE_SPACINGS * lattice.spacing) ** 2, fit_intercept=False)
    return ridge.fit(motion.reshape(len(motion), -1), indentation).coef_.T


def estimate_indentation(inverse: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Turn motions (N, P, 2) px into indentation (N, P) mm.

    All of a contact's is zero if no skin is pressed in by FELT_MM: nothing is touched.
    """
    found = motion.reshape(len(motion), len(inverse)) @ inverse
    return np.where(found.max(axis=-1, keepdims=True, initial=0) < MIN_INDENTATION_MM, 0.0, found)


def compute_relative_growth(lattice: Lattice, motion: np.ndarray) -> np.ndarray:
    """(..., P) area of each pin's cell over that of the undeformed sensor, less one; motion (..., P, 2) px, NaN for pins not seen."""
    rest = compute_cell_areas(lattice, np.zeros_like(lattice.rest))
    each = motion.reshape(-1, *motion.shape[-2:])
    return np.reshape(
        [compute_cell_areas(lattice, fill_missing(lattice, one)) / rest - 1 for one in each],
        motion.shape[:-1],
    )


def compute_cell_areas(lattice: Lattice, motion: np.ndarray) -> np.ndarray:
    """(P,) px^2, areas of the Voronoi cells of the pins moved by (P, 2) px."""
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


def interpolate_surface(place: np.ndarray, heights: np.ndarray, cells: int) -> np.ndarray:
    """(cells, cells) heights on a square grid over the pins (P, 2), rows along y: cubic (Clough-Tocher), NaN beyond the rim."""
    low, high = place.min(axis=0), place.max(axis=0)
    x, y = (np.linspace(low[i], high[i], cells) for i in (0, 1))
    return CloughTocher2DInterpolator(place, heights)(*np.meshgrid(x, y))


def interpolate_heights(place: np.ndarray, heights: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Heights (M, ...) at points (M, 2), of the cubic surface through (P, ...) at `place` (P, 2); beyond the rim of the nearest."""
    found = CloughTocher2DInterpolator(place, heights)(where)
    beyond = np.flatnonzero(np.isnan(found.reshape(len(where), -1)[:, 0]))
    found[beyond] = heights[cKDTree(place).query(where[beyond])[1]]
    return found
