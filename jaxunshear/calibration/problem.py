"""The least squares problem of a calibration: recorded against simulated rings of pins.

The mean radius and the mean shift of every ring count, contact by contact, each with the weight of
its pins.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import numpy as np

from jaxunshear.calibration.labels import LabelledMotions
from jaxunshear.calibration.pin_statistics import (
    PinObservation,
    compute_ring_radii,
    compute_ring_shift,
    subtract_mean,
)
from jaxunshear.calibration.prediction import (
    SensorValues,
    project_positions,
    project_rest,
    simulate_displacements,
)
from jaxunshear.perception.lattice import compute_rings
from jaxunshear.simulator.pin_layout import compute_pin_lattice

RATIO_STEP = 6.0  # between the domes that stiffnesses are interpolated from
# Standard deviations of wide priors: of logarithms, except `surface_mm`. They keep parameters that
# the images leave open near their start.
PRIORS = {
    "mm_across": 1.0,
    "distance_mm": 0.7,
    "pin_spacing_mm": 0.2,
    "skin_to_gel": 1.5,
    "friction": 1.0,
    "surface_mm": 5.0,
}
SURFACE = "surface_mm"
# steps of the forward differences
STEPS = {"friction": 0.05, "skin_to_gel": 0.05, SURFACE: 0.05}
SMALL_STEP = 0.01  # of the others
SPACING_MARGIN = 0.98  # of a limit of the pins' spacing, so that slopes are taken within it
# residual of a contact without a solution: the fit must not gain by losing contacts
UNSOLVED_RESIDUAL_PX = 3.0


@dataclass(frozen=True)
class RecordedGroup:
    """Images of one camera and one day as a simulated camera sees them, and their contacts."""

    name: str
    observation: PinObservation
    contacts: LabelledMotions
    side: int = 0  # see `labels.make_paths`
    surface_mm: float = 0.0  # where the search for the object's top begins

    def subsample(self, stride: int) -> "RecordedGroup":
        """Take one of `stride` images."""
        rows = np.arange(0, len(self.contacts), stride)
        return replace(
            self, observation=self.observation.take(rows), contacts=self.contacts.take(rows)
        )


class _DisplacementCache:
    """Displacements of the probe's pins in a group's contacts, simulated when they are needed."""

    def __init__(self, group: RecordedGroup, index: int, advance: Callable[[int], None]) -> None:
        self.group, self.index, self.advance = group, index, advance
        self._cache: dict[str, np.ndarray] = {}

    def simulate(self, values: SensorValues, ratio: float) -> np.ndarray:
        """Simulate (N, Q, 3) mm at another ratio of skin to gel."""
        surface_mm = values.surface_mm[self.index]
        key = f"{values.friction:.9f} {surface_mm:.9f} {ratio:.9f}"
        if key not in self._cache:
            at_ratio = replace(values, skin_to_gel=ratio)
            contacts, side = self.group.contacts, self.group.side
            self._cache[key] = simulate_displacements(at_ratio, contacts, side, surface_mm)
            self.advance(len(contacts))
        return self._cache[key]

    def interpolate(self, values: SensorValues, nodes: np.ndarray) -> np.ndarray:
        """Interpolate between ratios, by a quadratic in the logarithm of the ratio."""
        total = np.zeros(())
        for i, node in enumerate(nodes):
            others = np.delete(nodes, i)
            weight = float(np.prod(np.log(values.skin_to_gel / others) / np.log(node / others)))
            if abs(weight) > 1e-9:
                total = total + weight * self.simulate(values, float(node))
        return total

    def extrapolate(
        self, values: SensorValues, base: SensorValues, nodes: np.ndarray
    ) -> np.ndarray:
        """Interpolate at `base`, and add the effect of a small change of friction or surface.

        The effect is about the same at all stiffnesses, so it is simulated at the nearest node.
        """
        node = float(min(nodes, key=lambda node: abs(np.log(node / base.skin_to_gel))))
        change = self.simulate(values, node) - self.simulate(base, node)
        return self.interpolate(base, nodes) + change


def compute_ring_features(
    ring: np.ndarray, positions: np.ndarray, rest: np.ndarray, size: int
) -> np.ndarray:
    """Compute radii and mean shifts of rings, weighted by their pins: (N, F) px of 128.

    `ring` (P,) is the ring of each pin; `positions` (N, P, 2) and `rest` (P, 2) are as in
    `PinObservation`.
    """
    pins = np.bincount(ring)
    weight = np.sqrt(pins / pins.sum()) * (128 / size)
    radii = compute_ring_radii(ring, positions, rest) * weight[1:]
    shift = compute_ring_shift(ring, positions - rest) * weight
    return np.concatenate([radii, shift.real, shift.imag], axis=1)


class FitProblem:
    """Residuals of groups as functions of a vector x (K,) of the parameters `names`.

    x has logarithms over the start of the names in `scalars`, then differences from the start of
    the surface of each group.
    """

    def __init__(
        self,
        groups: list[RecordedGroup],
        start: SensorValues,
        fixed: Collection[str],
        advance: Callable[[int], None],
    ) -> None:
        self.groups, self.start = groups, start
        self._caches = [_DisplacementCache(group, i, advance) for i, group in enumerate(groups)]
        self._recorded: list[np.ndarray] = []
        for observation in (group.observation for group in groups):
            rest, positions = observation.rest, observation.positions
            ring, size = observation.lattice.ring, observation.size
            self._recorded.append(compute_ring_features(ring, positions, rest, size))
        self._ends = np.cumsum([0, *map(len, self._recorded)])
        slides = np.concatenate([group.contacts.slide for group in groups])
        unknown = {SURFACE, *fixed, *(() if np.any(np.abs(slides) > 1e-6) else ("friction",))}
        self.scalars = [name for name in PRIORS if name not in unknown]
        self.names = self.scalars + [f"{SURFACE} {group.name}" for group in groups]
        self.is_scalar = np.arange(len(self.names)) < len(self.scalars)
        self.prior = np.array([PRIORS[name.split()[0]] for name in self.names])
        self._origin = self._collect(start)
        self.recentring = 0  # steps of RATIO_STEP, from the start to the middle of three domes

    def _collect(self, values: SensorValues) -> np.ndarray:
        return np.array([*(getattr(values, name) for name in self.scalars), *values.surface_mm])

    def to_physical(self, x: np.ndarray) -> np.ndarray:
        """Convert x to the values (K,) of `names`."""
        return np.where(self.is_scalar, self._origin * np.exp(x), self._origin + x)

    def to_values(self, x: np.ndarray) -> SensorValues:
        values = self.to_physical(x).tolist()
        scalars = dict(zip(self.scalars, values, strict=False))
        return replace(self.start, **scalars, surface_mm=tuple(values[len(self.scalars) :]))

    def to_parameters(self, values: SensorValues) -> np.ndarray:
        """Invert `to_values`."""
        values_array, scalars = self._collect(values), len(self.scalars)
        logarithms = np.log(values_array[:scalars] / self._origin[:scalars])
        return np.concatenate([logarithms, (values_array - self._origin)[scalars:]])

    @property
    def _nodes(self) -> np.ndarray:
        """The ratios of skin to gel (3,) that are simulated."""
        ratio, steps = self.start.skin_to_gel, self.recentring
        return np.array([ratio * RATIO_STEP ** (steps + i) for i in (-1, 0, 1)])

    def recentre(self, x: np.ndarray) -> bool:
        """Change to other domes if the stiffness nears the last one; say whether it did."""
        ratio = self.to_values(x).skin_to_gel
        place = np.log(ratio / self.start.skin_to_gel) / np.log(RATIO_STEP)
        changed = bool(abs(place - self.recentring) > 0.75)
        self.recentring = round(place) if changed else self.recentring
        return changed

    def compute_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = -3 * self.prior, 3 * self.prior
        if "skin_to_gel" in self.names:
            k = self.names.index("skin_to_gel")
            low[k] = (self.recentring - 1) * np.log(RATIO_STEP)
            high[k] = (self.recentring + 1) * np.log(RATIO_STEP)
        if "pin_spacing_mm" in self.names:  # pins that overlap, or go past the rim, are no sensor
            k, sensor = self.names.index("pin_spacing_mm"), self.start.base
            least, most = 2 * sensor.pin_radius_mm, sensor.dome_radius_mm * np.pi / 2 / sensor.rings
            limits = np.array([least / SPACING_MARGIN, most * SPACING_MARGIN])
            ends = np.log(limits / self.start.pin_spacing_mm)
            low[k], high[k] = max(low[k], ends[0]), min(high[k], ends[1])
        return low, high

    def compute_residuals(self, x: np.ndarray) -> np.ndarray:
        """Compute simulated less recorded features (N, F) of all groups.

        They are zero if nothing is known, and UNSOLVED_RESIDUAL_PX in all for a contact without a
        solution.
        """
        values, residuals = self.to_values(x), []
        for i in range(len(self.groups)):
            difference = self._compare(i, values)
            unsolved = np.isnan(difference).all(axis=1)
            residual = self._centre(difference)
            residual[unsolved, 0] = UNSOLVED_RESIDUAL_PX
            residuals.append(residual)
        return np.concatenate(residuals)

    def compute_jacobian(self, x: np.ndarray) -> np.ndarray:
        """Compute forward differences (N, F, K) of the residuals.

        They are zero if one of both contacts has no solution: its constant residual is no slope.
        """
        base_values = self.to_values(x)
        base = [self._compare(i, base_values) for i in range(len(self.groups))]
        slopes = np.zeros((self._ends[-1], base[0].shape[1], len(x)))
        for k, name in enumerate(self.names):
            kind = name.split()[0]
            step = STEPS.get(kind, SMALL_STEP)
            values = self.to_values(x + step * (np.arange(len(x)) == k))
            near = base_values if kind in ("friction", SURFACE) else None
            # a surface is of one group alone
            groups = range(len(self.groups)) if self.is_scalar[k] else [k - len(self.scalars)]
            for i in groups:
                change = self._centre(self._compare(i, values, near) - base[i])
                slopes[self._ends[i] : self._ends[i + 1], :, k] = change / step
        return slopes

    def _compare(
        self, index: int, values: SensorValues, base: SensorValues | None = None
    ) -> np.ndarray:
        """Compute the difference of features (N, F) with their mean shifts.

        NaN if nothing is known or a contact has no solution. `base`: see
        `_DisplacementCache.extrapolate`.
        """
        cache, size = self._caches[index], self.groups[index].observation.size
        displacement = (
            cache.interpolate(values, self._nodes)
            if base is None
            else cache.extrapolate(values, base, self._nodes)
        )
        flat = compute_pin_lattice(values.sensor)
        positions = project_positions(values, size, flat, displacement)
        rest = project_rest(values, size, flat)
        ring = compute_rings(values.base)
        return compute_ring_features(ring, positions, rest, size) - self._recorded[index]

    def _centre(self, difference: np.ndarray) -> np.ndarray:
        """Subtract every ring's mean shift (N, F), as rest positions are unknown; NaN becomes 0."""
        rings = self.start.base.rings
        shift = subtract_mean(difference[:, rings:])
        return np.nan_to_num(np.concatenate([difference[:, :rings], shift], axis=1))
