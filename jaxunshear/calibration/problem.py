"""The least squares problem of a calibration: recorded against simulated rings of pins.

The mean radius and the mean shift of every ring count, contact by contact, each with the weight of
its pins.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

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
    Simulate,
    predict_positions,
    simulate_displacements,
)
from jaxunshear.config.sensor import Sensor
from jaxunshear.perception.lattice import compute_rings

RATIO_STEP = 6.0  # between the domes that stiffnesses are interpolated from
# Standard deviations of wide priors: of logarithms, except `surface_mm`. They keep parameters that
# the images leave open near their start.
PRIORS = {
    "mm_across": 1.0,
    "distance_mm": 0.7,
    "pin_spacing_mm": 0.2,
    "friction": 1.0,
    "skin_to_gel": 1.5,
    "surface_mm": 5.0,
}
SPACING_MARGIN = 0.98  # of a limit of the pins' spacing, so that slopes are taken within it
# residual of a contact without a solution: the fit must not gain by losing contacts
UNSOLVED_RESIDUAL_PX = 3.0


@dataclass(frozen=True)
class RecordedGroup:
    """Images of one camera and one day as a simulated camera sees them, and their contacts."""

    name: str
    observation: PinObservation
    contacts: LabelledMotions | None = None  # None if they are unknown
    side: int = 0

    def subsample(self, stride: int) -> "RecordedGroup":
        """Take one of `stride` images."""
        rows = np.arange(0, len(self.observation.pin_counts), stride)
        contacts = None if self.contacts is None else self.contacts.take(rows)
        return RecordedGroup(self.name, self.observation.take(rows), contacts, self.side)


class _CacheKey(NamedTuple):
    friction: float
    surface_mm: float
    ratio: float


class _DisplacementCache:
    """Displacements of the probe's pins in labelled contacts, simulated when they are needed."""

    def __init__(self, which: int, simulate: Simulate, advance: Callable[[int], None]) -> None:
        """Take a `simulate` of friction, surface and skin:gel, for group number `which`."""
        self.which, self._simulate, self.advance = which, simulate, advance
        self.nodes: list[float] = []
        self._cache: dict[_CacheKey, np.ndarray] = {}

    def simulate(self, values: SensorValues, ratio: float) -> np.ndarray:
        """Simulate (N, Q, 3) mm; NaN for contacts out of reach or without a solution."""
        surface_mm = values.surface_mm[self.which]
        key = _CacheKey(round(values.friction, 9), round(surface_mm, 9), round(ratio, 9))
        if key not in self._cache:
            displacement, converged = self._simulate(values.friction, surface_mm, ratio)
            self._cache[key] = np.where(converged[:, None, None], displacement, np.nan)
            self.advance(len(displacement))
        return self._cache[key]

    def interpolate(self, values: SensorValues) -> np.ndarray:
        """Interpolate between the nodes, by a quadratic in the logarithm of skin:gel."""
        total = np.zeros(())
        for i, node in enumerate(self.nodes):
            others = np.delete(self.nodes, i)
            weight = float(np.prod(np.log(values.skin_to_gel / others) / np.log(node / others)))
            if abs(weight) > 1e-9:
                total = total + weight * self.simulate(values, node)
        return total

    def extrapolate(self, values: SensorValues, base: SensorValues) -> np.ndarray:
        """Interpolate at `base`, and add the effect of a small change of friction or surface.

        The effect is about the same at all stiffnesses, so it is simulated at the nearest node.
        """
        node = min(self.nodes, key=lambda node: abs(np.log(node / base.skin_to_gel)))
        return self.interpolate(base) + (self.simulate(values, node) - self.simulate(base, node))


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


def _subtract_mean_shift(features: np.ndarray, rings: int) -> np.ndarray:
    """Subtract every ring's mean shift over the contacts (N, F): rest positions are unknown."""
    return np.concatenate([features[:, :rings], subtract_mean(features[:, rings:])], axis=1)


class Problem:
    """Residuals of groups as functions of a vector x of parameters.

    x has logarithms over the start of the names in `scalars`, then differences from the start of
    the surface of each labelled group.
    """

    def __init__(
        self,
        groups: list[RecordedGroup],
        sensor: Sensor,
        start: SensorValues,
        fixed: Collection[str],
        advance: Callable[[int], None],
        simulate: Simulate = simulate_displacements,
    ) -> None:
        self.groups, self.sensor, self.start = groups, sensor, start
        self.caches: dict[int, _DisplacementCache] = {}  # of labelled groups, by number
        has_slides = False
        for i, group in enumerate(groups):
            if group.contacts is not None:
                solve = partial(simulate, sensor, group.contacts, group.side)
                self.caches[i] = _DisplacementCache(i, solve, advance)
                has_slides |= bool(np.any(np.abs(group.contacts.slide) > 1e-6))
        self.recorded = [_compute_recorded_features(group.observation) for group in groups]
        names = ["mm_across", "distance_mm"]
        names += ["pin_spacing_mm", "skin_to_gel"] if self.caches else []
        names += ["friction"] if has_slides else []
        self.scalars = [name for name in names if name not in fixed]
        self.surfaces = list(self.caches)
        self.names = self.scalars + [f"surface_mm {groups[i].name}" for i in self.surfaces]
        self.is_nuisance = np.array([name not in self.scalars for name in self.names])
        self.prior = np.array([PRIORS[name.split()[0]] for name in self.names])
        self.steps = 0  # of RATIO_STEP, from the start to the middle one of three domes
        self.recentre(start)

    def to_values(self, x: np.ndarray) -> SensorValues:
        scalars = {
            name: float(getattr(self.start, name) * np.exp(step))
            for name, step in zip(self.scalars, x, strict=False)
        }
        surface_mm = list(self.start.surface_mm)
        for i, step in zip(self.surfaces, x[len(self.scalars) :], strict=True):
            surface_mm[i] += float(step)
        return replace(self.start, **scalars, surface_mm=tuple(surface_mm))

    def to_parameters(self, values: SensorValues) -> np.ndarray:
        """Invert `to_values`."""
        x = [np.log(getattr(values, name) / getattr(self.start, name)) for name in self.scalars]
        x += [values.surface_mm[i] - self.start.surface_mm[i] for i in self.surfaces]
        return np.array(x)

    def name_values(self, values: SensorValues) -> dict[str, float]:
        """Return the fitted values by `names`."""
        scalars = [getattr(values, name) for name in self.scalars]
        surfaces = [values.surface_mm[i] for i in self.surfaces]
        return dict(zip(self.names, scalars + surfaces, strict=True))

    def compute_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = -3 * self.prior, 3 * self.prior
        if "skin_to_gel" in self.names:
            k = self.names.index("skin_to_gel")
            low[k] = (self.steps - 1) * np.log(RATIO_STEP)
            high[k] = (self.steps + 1) * np.log(RATIO_STEP)
        if "pin_spacing_mm" in self.names:  # pins that overlap, or go past the rim, are no sensor
            k, sensor = self.names.index("pin_spacing_mm"), self.sensor
            least, most = 2 * sensor.pin_radius_mm, sensor.dome_radius_mm * np.pi / 2 / sensor.rings
            limits = np.array([least / SPACING_MARGIN, most * SPACING_MARGIN])
            ends = np.log(limits / self.start.pin_spacing_mm)
            low[k], high[k] = max(low[k], ends[0]), min(high[k], ends[1])
        return low, high

    def recentre(self, values: SensorValues) -> bool:
        """Change to other domes if the stiffness nears the last one; say whether it did."""
        place = np.log(values.skin_to_gel / self.start.skin_to_gel) / np.log(RATIO_STEP)
        changed = abs(place - self.steps) > 0.75
        self.steps = round(place) if changed else self.steps
        for cache in self.caches.values():
            cache.nodes = [
                self.start.skin_to_gel * RATIO_STEP ** (self.steps + i) for i in (-1, 0, 1)
            ]
        return changed

    def compute_residuals(self, values: SensorValues, which: int) -> np.ndarray:
        """Compute simulated less recorded features (N, F) of one group.

        They are zero if nothing is known, and UNSOLVED_RESIDUAL_PX in all for a contact without a
        solution.
        """
        difference = self._compute_difference(values, which)
        unsolved = np.isnan(difference).all(axis=1)
        difference = np.nan_to_num(_subtract_mean_shift(difference, self.sensor.rings))
        difference[unsolved, 0] = UNSOLVED_RESIDUAL_PX
        return difference

    def compute_all_residuals(self, values: SensorValues) -> np.ndarray:
        return np.concatenate([self.compute_residuals(values, i) for i in range(len(self.groups))])

    def _compute_difference(
        self, values: SensorValues, which: int, base: SensorValues | None = None
    ) -> np.ndarray:
        """Compute the difference of features (N, F) with their mean shifts.

        NaN if nothing is known or a contact has no solution. `base`: see
        `_DisplacementCache.extrapolate`.
        """
        cache = self.caches.get(which)
        if cache is None:
            return self._estimate_undisturbed_pins(self._compare_features(values, which, None))
        displacement = (
            cache.interpolate(values) if base is None else cache.extrapolate(values, base)
        )
        return self._compare_features(values, which, displacement)

    def _compare_features(
        self, values: SensorValues, which: int, displacement: np.ndarray | None
    ) -> np.ndarray:
        size = self.groups[which].observation.size
        positions, rest = predict_positions(values, self.sensor, size, displacement)
        expected = compute_ring_features(compute_rings(self.sensor), positions, rest, size)
        return expected - self.recorded[which]

    def _estimate_undisturbed_pins(self, difference: np.ndarray) -> np.ndarray:
        """Estimate the difference (N, F) of undisturbed pins from unlabelled images.

        A touch widens all rings by an unknown amount, so the narrowest tenth counts as undisturbed.
        """
        narrowest = np.nanpercentile(difference, 90, axis=0)
        difference = np.broadcast_to(narrowest, difference.shape).copy()
        difference[:, self.sensor.rings :] = 0
        return difference

    def make_resampler(self, values: SensorValues) -> Callable[[np.random.Generator], np.ndarray]:
        """Make a function that gives all residuals, with images of unlabelled groups drawn anew."""
        base, ends = self.compute_all_residuals(values), self._compute_row_ends()
        unlabelled = {
            i: self._compare_features(values, i, None)
            for i in range(len(self.groups))
            if i not in self.caches
        }

        def resample(generator: np.random.Generator) -> np.ndarray:
            residuals = base.copy()
            for i, difference in unlabelled.items():
                rows = generator.integers(len(difference), size=len(difference))
                undisturbed = self._estimate_undisturbed_pins(difference[rows])
                residuals[ends[i] : ends[i + 1]] = np.nan_to_num(undisturbed)
            return residuals

        return resample

    def _compute_row_ends(self) -> np.ndarray:
        """Compute at which rows of all residuals groups begin and end, (groups + 1,)."""
        return np.cumsum([0, *(len(recorded) for recorded in self.recorded)])

    def compute_jacobian(self, x: np.ndarray) -> np.ndarray:
        """Compute forward differences (N, F, K) of the residuals.

        They are zero if one of both contacts has no solution: its constant residual is no slope.
        """
        base_values = self.to_values(x)
        base = [self._compute_difference(base_values, i) for i in range(len(self.groups))]
        slopes = np.zeros((sum(map(len, base)), base[0].shape[1], len(x)))
        ends = self._compute_row_ends()
        for k, name in enumerate(self.names):
            kind = name.split()[0]
            step = 0.05 if kind in ("friction", "skin_to_gel", "surface_mm") else 0.01
            shifted = x.copy()
            shifted[k] += step
            values = self.to_values(shifted)
            near = base_values if kind in ("friction", "surface_mm") else None
            # a surface is of one group alone
            only = self.surfaces[k - len(self.scalars)] if self.is_nuisance[k] else None
            for i in range(len(self.groups)) if only is None else (only,):
                change = self._compute_difference(values, i, near) - base[i]
                change = np.nan_to_num(_subtract_mean_shift(change, self.sensor.rings))
                slopes[ends[i] : ends[i + 1], :, k] = change / step
        return slopes


def _compute_recorded_features(observation: PinObservation) -> np.ndarray:
    return compute_ring_features(
        observation.lattice.ring, observation.positions, observation.rest, observation.size
    )
