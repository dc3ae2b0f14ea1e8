"""What a calibration compares: rings of recorded pins with those of simulated ones, as residuals of what is to be found.

Every ring's mean radius and mean place count, contact by contact, each with the weight of its pins.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial

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
# Standard deviations of wide priors: of logarithms, but for `surface_mm`. They hold what the images leave open.
PRIORS = {
    "mm_across": 1.0,
    "distance_mm": 0.7,
    "pin_spacing_mm": 0.2,
    "friction": 1.0,
    "skin_to_gel": 1.5,
    "surface_mm": 5.0,
}
SPACING_MARGIN = 0.98  # of a limit of the pins' spacing, so that slopes are taken within it
UNSOLVED_RESIDUAL_PX = 3.0  # what a contact without a solution counts for: dropping it must not pay


@dataclass(frozen=True)
class RecordedGroup:
    """Images of one camera and one day, seen as a simulated camera sees them, with the contacts that made them if these are known."""

    name: str
    observation: PinObservation
    contacts: LabelledMotions | None = None
    side: int = 0

    def subsample(self, step: int) -> "RecordedGroup":
        """With one of `step` images."""
        rows = np.arange(0, len(self.observation.pin_counts), step)
        contacts = None if self.contacts is None else self.contacts.take(rows)
        return RecordedGroup(self.name, self.observation.take(rows), contacts, self.side)


class _DisplacementCache:
    """Displacements of the probe's pins of labelled contacts, solved when first asked for."""

    def __init__(self, which: int, solve: Simulate, advance: Callable[[int], None]) -> None:
        """`solve` for friction, surface and skin:gel."""
        self.which, self.solve, self.advance = which, solve, advance
        self.nodes: list[float] = []
        self.known: dict[tuple[float, float, float], np.ndarray] = {}

    def simulate(self, values: SensorValues, ratio: float) -> np.ndarray:
        """(N, Q, 3) mm; NaN for contacts out of reach or without a solution."""
        surface = values.surface_mm[self.which]
        key = (round(values.friction, 9), round(surface, 9), round(ratio, 9))
        if key not in self.known:
            moved, converged = self.solve(values.friction, surface, ratio)
            self.known[key] = np.where(converged[:, None, None], moved, np.nan)
            self.advance(len(moved))
        return self.known[key]

    def interpolate(self, values: SensorValues) -> np.ndarray:
        """Quadratic in the logarithm of skin:gel."""
        total = np.zeros(())
        for i, node in enumerate(self.nodes):
            weight = _lagrange(values, node, np.delete(self.nodes, i))
            if abs(weight) > 1e-9:
                total = total + weight * self.simulate(values, node)
        return total

    def extrapolate(self, values: SensorValues, base: SensorValues) -> np.ndarray:
        """The same for a small change of friction or surface: it is about the same at all stiffnesses."""
        node = min(self.nodes, key=lambda node: abs(np.log(node / base.skin_to_gel)))
        return self.interpolate(base) + (self.simulate(values, node) - self.simulate(base, node))


def _lagrange(values: SensorValues, node: float, others: np.ndarray) -> float:
    return float(np.prod(np.log(values.skin_to_gel / others) / np.log(node / others)))


def compute_ring_features(
    shell: np.ndarray, place: np.ndarray, rest: np.ndarray, size: int
) -> np.ndarray:
    """(N, F) px of 128: radii and mean motions of the rings, each weighing as its pins. `place` (N, P, 2), `rest` (P, 2) as in `PinObservation`."""
    pins = np.bincount(shell)
    weight = np.sqrt(pins / pins.sum()) * (128 / size)
    radii = compute_ring_radii(shell, place, rest) * weight[1:]
    across = compute_ring_shift(shell, place - rest) * weight
    return np.concatenate([radii, across.real, across.imag], axis=1)


def _less_mean_motion(difference: np.ndarray, rings: int) -> np.ndarray:
    """(N, F) with every ring's mean over the contacts taken from its motions: nobody knows where the undisturbed pins stand."""
    return np.concatenate([difference[:, :rings], subtract_mean(difference[:, rings:])], axis=1)


class Problem:
    def __init__(
        self,
        groups: list[RecordedGroup],
        sensor: Sensor,
        start: SensorValues,
        held: Collection[str],
        advance: Callable[[int], None],
        simulate: Simulate = simulate_displacements,
    ) -> None:
        self.groups, self.sensor, self.start = groups, sensor, start
        self.simulated = [
            None
            if group.contacts is None
            else _DisplacementCache(
                i, partial(simulate, sensor, group.contacts, group.side), advance
            )
            for i, group in enumerate(groups)
        ]
        self.recorded = [
            compute_ring_features(
                group.observation.lattice.ring,
                group.observation.positions,
                group.observation.rest,
                group.observation.size,
            )
            for group in groups
        ]
        labelled = any(group.contacts is not None for group in groups)
        slid = any(
            group.contacts is not None and np.any(np.abs(group.contacts.slide) > 1e-6)
            for group in groups
        )
        names = ["mm_across", "distance_mm"]
        names += ["pin_spacing_mm", "skin_to_gel"] if labelled else []
        names += ["friction"] if slid else []
        self.scalars = [name for name in names if name not in held]
        self.steps = 0  # of RATIO_STEP, from the start to the middle one of three domes
        self.recentre(start)
        self.surfaces = [i for i, group in enumerate(groups) if group.contacts is not None]
        self.names = self.scalars + [f"surface_mm {groups[i].name}" for i in self.surfaces]

    def values(self, x: np.ndarray) -> SensorValues:
        """Parameters as logarithms over the start, surfaces as differences from it."""
        scalars = {
            name: float(getattr(self.start, name) * np.exp(step))
            for name, step in zip(self.scalars, x, strict=False)
        }
        surface = list(self.start.surface_mm)
        for i, step in zip(self.surfaces, x[len(self.scalars) :], strict=True):
            surface[i] += float(step)
        return replace(self.start, **scalars, surface_mm=tuple(surface))

    def to_parameters(self, values: SensorValues) -> np.ndarray:
        """The inverse of `values`."""
        scalars = [
            np.log(getattr(values, name) / getattr(self.start, name)) for name in self.scalars
        ]
        return np.array(
            scalars + [values.surface_mm[i] - self.start.surface_mm[i] for i in self.surfaces]
        )

    def name_values(self, values: SensorValues) -> dict[str, float]:
        """What of the values is sought, by `names`."""
        surfaces = [values.surface_mm[i] for i in self.surfaces]
        found = [*(getattr(values, name) for name in self.scalars), *surfaces]
        return dict(zip(self.names, found, strict=True))

    def nuisance(self) -> np.ndarray:
        return np.array([name not in self.scalars for name in self.names])

    def prior(self) -> np.ndarray:
        return np.array([PRIORS[name.split()[0]] for name in self.names])

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = -3 * self.prior(), 3 * self.prior()
        if "skin_to_gel" in self.names:
            k = self.names.index("skin_to_gel")
            low[k], high[k] = ((self.steps + end) * np.log(RATIO_STEP) for end in (-1, 1))
        if "pin_spacing_mm" in self.names:  # pins that overlap, or go past the rim, are no sensor
            k, sensor = self.names.index("pin_spacing_mm"), self.sensor
            least, most = 2 * sensor.pin_radius_mm, sensor.dome_radius_mm * np.pi / 2 / sensor.rings
            ends = np.log(
                np.array([least / SPACING_MARGIN, most * SPACING_MARGIN])
                / self.start.pin_spacing_mm
            )
            low[k], high[k] = max(low[k], ends[0]), min(high[k], ends[1])
        return low, high

    def recentre(self, values: SensorValues) -> bool:
        """Takes other domes where the stiffness nears the last one; whether it did."""
        place = np.log(values.skin_to_gel / self.start.skin_to_gel) / np.log(RATIO_STEP)
        moved = abs(place - self.steps) > 0.75
        self.steps = round(place) if moved else self.steps
        for simulated in self.simulated:
            if simulated is not None:
                simulated.nodes = [
                    self.start.skin_to_gel * RATIO_STEP ** (self.steps + i) for i in (-1, 0, 1)
                ]
        return moved

    def residuals(self, values: SensorValues, which: int) -> np.ndarray:
        """(N, F) of one group, simulated less recorded; zero where nothing is known, UNSOLVED_PX in all for a contact without a
        solution."""
        difference = self._difference(values, which)
        unsolved = np.isnan(difference).all(axis=1)
        difference = np.nan_to_num(_less_mean_motion(difference, self.sensor.rings))
        difference[unsolved, 0] = UNSOLVED_RESIDUAL_PX
        return difference

    def _difference(
        self, values: SensorValues, which: int, near: SensorValues | None = None
    ) -> np.ndarray:
        """The same, but with motions as they are, and NaN where nothing is known or a contact has no solution. `near`: see
        `_Simulated.nearby`."""
        group, simulated = self.groups[which], self.simulated[which]
        moved = None
        if simulated is not None:
            moved = (
                simulated.interpolate(values)
                if near is None
                else simulated.extrapolate(values, near)
            )
        place, rest = predict_positions(values, self.sensor, group.observation.size, moved)
        expected = compute_ring_features(
            compute_rings(self.sensor), place, rest, group.observation.size
        )
        difference = expected - self.recorded[which]
        return difference if simulated is not None else self._estimate_undisturbed(difference)

    def _estimate_undisturbed(self, difference: np.ndarray) -> np.ndarray:
        """(N, F) of unlabelled images: a touch widens all rings, nobody knows how far, so the narrowest tenth is held to be undisturbed."""
        difference = np.broadcast_to(
            np.nanpercentile(difference, 90, axis=0), difference.shape
        ).copy()
        difference[:, self.sensor.rings :] = 0
        return difference

    def make_resampler(self, values: SensorValues) -> Callable[[np.random.Generator], np.ndarray]:
        """A function that gives `all(values)` with the rows of unlabelled groups from images drawn anew."""
        base, ends = self.compute_all_residuals(values), self._ends()
        apart = {}
        for i, group in enumerate(self.groups):
            if self.simulated[i] is None:
                place, rest = predict_positions(values, self.sensor, group.observation.size, None)
                apart[i] = (
                    compute_ring_features(
                        compute_rings(self.sensor), place, rest, group.observation.size
                    )
                    - self.recorded[i]
                )

        def redraw(generator: np.random.Generator) -> np.ndarray:
            drawn = base.copy()
            for i, difference in apart.items():
                again = difference[generator.integers(len(difference), size=len(difference))]
                drawn[ends[i] : ends[i + 1]] = np.nan_to_num(self._estimate_undisturbed(again))
            return drawn

        return redraw

    def _ends(self) -> np.ndarray:
        """(groups + 1,) rows of `all` where groups begin and end."""
        return np.cumsum([0, *(len(recorded) for recorded in self.recorded)])

    def compute_all_residuals(self, values: SensorValues) -> np.ndarray:
        return np.concatenate([self.residuals(values, i) for i in range(len(self.groups))])

    def compute_jacobian(self, x: np.ndarray) -> np.ndarray:
        """(N, F, K) forward differences; zero where one of both has no solution: what such a contact counts for is no slope."""
        here = self.values(x)
        base = [self._difference(here, i) for i in range(len(self.groups))]
        slopes = np.zeros((sum(map(len, base)), base[0].shape[1], len(x)))
        ends = self._ends()
        for k, name in enumerate(self.names):
            step = 0.05 if name.split()[0] in ("friction", "skin_to_gel", "surface_mm") else 0.01
            moved = x.copy()
            moved[k] += step
            values = self.values(moved)
            near = here if name.split()[0] in ("friction", "surface_mm") else None
            own = (
                [self.surfaces[k - len(self.scalars)]]
                if k >= len(self.scalars)
                else range(len(self.groups))
            )
            for i in own:
                rows = slice(ends[i], ends[i + 1])
                change = self._difference(values, i, near) - base[i]
                slopes[rows, :, k] = (
                    np.nan_to_num(_less_mean_motion(change, self.sensor.rings)) / step
                )
        return slopes
