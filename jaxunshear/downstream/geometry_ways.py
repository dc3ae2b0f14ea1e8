"""Ways from pins to the geometry of a contact, side by side; heights in mm by a factor fitted to taps whose indentation is known.

areas       the area of each pin's Voronoi cell, as it is in the image: the paper's figure
change      the same over the area that the pin's cell has untouched, less one: what the paper's text says of it
growth      that, averaged over neighbours and put where the pin rests: a shift of all pins does not show
compliance  the likeliest indentation under forces that nothing is known of (`inverse.of_compliance`)
inverse     least squares over the known taps (`inverse.learnt`)
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxunshear.dataset.fresh import FreshContacts
from jaxunshear.downstream.geometry import cell_areas, relative_growth, smoothed
from jaxunshear.downstream.inverse import indentation_of, learnt, of_compliance
from jaxunshear.errors import UserError
from jaxunshear.image.lattice import Lattice
from jaxunshear.image.tracking import motions_of
from jaxunshear.settings.experiment import Experiment, simulated_of

AREAS, CHANGE, GROWTH, COMPLIANCE, INVERSE = WAYS = ("areas", "change", "growth", "compliance", "inverse")


class Way(NamedTuple):
    heights: Callable[[np.ndarray], np.ndarray]  # motions (N, P, 2) px of all pins -> (N, P)
    mm: float  # a unit of height

    def __call__(self, motion: np.ndarray) -> np.ndarray:
        return self.mm * self.heights(motion)


def known_motions(lattice: Lattice, known: FreshContacts) -> np.ndarray:
    """`motions_of` taps. Raises `UserError` where hardly any shows its pins well enough."""
    motion = motions_of(lattice, known.tap)
    sure = np.mean(~np.isnan(motion[:, 0, 0]))
    if sure < 0.5:
        raise UserError(
            f"pins are identified in only {100 * sure:.0f} % of simulated taps of {known.tap.shape[1]} px: "
            "use a model of larger images (128 px or more)"
        )
    return motion


def ways_of(experiment: Experiment, lattice: Lattice, known: FreshContacts) -> dict[str, Way]:
    """All ways by name, with factors from taps whose indentation is known."""
    paired, _ = simulated_of(experiment, "geometry")
    motion = known_motions(lattice, known)
    followed = ~np.isnan(motion[:, 0, 0])
    motion, true = motion[followed], known.indentation_mm[followed]
    usual = cell_areas(lattice, np.zeros_like(lattice.place)).mean()
    physical = of_compliance(experiment.sensor, paired.camera, paired.preprocess)
    fitted = learnt(lattice, motion, true)
    heights: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        AREAS: lambda moved: np.stack([cell_areas(lattice, each) for each in moved]) / usual - 1,
        CHANGE: lambda moved: relative_growth(lattice, moved),
        GROWTH: lambda moved: smoothed(lattice, relative_growth(lattice, moved)),
        COMPLIANCE: lambda moved: indentation_of(physical, moved),
        INVERSE: lambda moved: indentation_of(fitted, moved),
    }
    return {name: Way(each, _factor(each(motion), true)) for name, each in heights.items()}


def _factor(heights: np.ndarray, true: np.ndarray) -> float:
    return float(np.sum(true * heights) / np.sum(heights**2))
