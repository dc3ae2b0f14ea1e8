"""Least squares of simulated on recorded pins: camera, pin spacing, friction and stiffness together.

What is compared is every ring's mean radius and mean place, contact by contact. Uncertainties come from resampling the images; a
parameter that these leave open keeps its start, held there by a wide prior, and is reported as not determined.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from jaxunshear.calibration.labels import Motions
from jaxunshear.calibration.prediction import Values, displacements, place_of
from jaxunshear.calibration.statistics import Seen, ring_motion, ring_radii, unit_vectors
from jaxunshear.calibration.tracking import shells
from jaxunshear.scene.sensor import Sensor

ROUNDS = 12
SETTLED = 2e-3  # of the cost: a round that gains less is the last
RATIO_STEP = 6.0  # between the domes that stiffnesses are interpolated from
OUTLIER_PX = 0.5  # of 128: beyond it a residual counts linearly (stick and slip in turn leave some pins anywhere)
# Standard deviations of wide priors: of logarithms, but for `surface_mm`. They hold what the images leave open.
PRIORS = {
    "mm_across": 1.0,
    "distance_mm": 0.7,
    "pin_spacing_mm": 0.2,
    "friction": 1.0,
    "skin_to_gel": 1.5,
    "surface_mm": 5.0,
}
PRIOR_PX = 0.15  # how much a prior weighs: the residual that one image's rings usually keep
DETERMINED = 0.4  # a 95% interval narrower than this share of the prior's is knowledge
BOOTSTRAPS = 400


@dataclass(frozen=True)
class Group:
    """Images of one camera and one day, seen as a simulated camera sees them, with the contacts that made them if these are known."""

    name: str
    seen: Seen
    contacts: Motions | None = None
    side: int = 0


class Fitted(NamedTuple):
    """`low`, `high`: 95 % bootstrap interval over images, by name; `determined`: whether the images tell."""

    values: Values
    low: dict[str, float]
    high: dict[str, float]
    determined: dict[str, bool]
    before_px: (
        float  # distance of recorded rings from simulated ones, rms over an image's pins, median image, px of 128
    )
    after_px: float
    dropped: int  # contacts that did not converge


class _Simulated:
    """Displacements of the probe's pins of labelled contacts, solved when first asked for."""

    def __init__(
        self, contacts: Motions, side: int, which: int, sensor: Sensor, advance: Callable[[int], None]
    ) -> None:
        self.contacts, self.side, self.which, self.sensor, self.advance = contacts, side, which, sensor, advance
        self.nodes: list[float] = []
        self.known: dict[tuple[float, float, float], np.ndarray] = {}
        self.converged = np.ones(len(contacts), bool)

    def at(self, values: Values, ratio: float) -> np.ndarray:
        surface = values.surface_mm[self.which]
        key = (round(values.friction, 9), round(surface, 9), round(ratio, 9))
        if key not in self.known:
            moved, converged = displacements(self.sensor, self.contacts, self.side, values.friction, surface, ratio)
            self.known[key] = moved
            self.converged &= converged
            self.advance(len(moved))
        return self.known[key]

    def between(self, values: Values) -> np.ndarray:
        """Quadratic in the logarithm of skin:gel."""
        total = np.zeros(())
        for i, node in enumerate(self.nodes):
            weight = _lagrange(values, node, np.delete(self.nodes, i))
            if abs(weight) > 1e-9:
                total = total + weight * self.at(values, node)
        return total

    def nearby(self, values: Values, base: Values) -> np.ndarray:
        """The same for a small change of friction or surface: it is about the same at all stiffnesses."""
        node = min(self.nodes, key=lambda node: abs(np.log(node / base.skin_to_gel)))
        return self.between(base) + (self.at(values, node) - self.at(base, node))


def _lagrange(values: Values, node: float, others: np.ndarray) -> float:
    return float(np.prod(np.log(values.skin_to_gel / others) / np.log(node / others)))


def features(seen_shell: np.ndarray, place: np.ndarray, direction: np.ndarray, size: int) -> np.ndarray:
    """(N, F) px of 128: radii and mean places of the rings, each weighing as its pins. `place` as in `Seen`."""
    pins = np.bincount(seen_shell)
    weight = np.sqrt(pins / pins.sum()) * (128 / size)
    radii = ring_radii(seen_shell, place, direction) * weight[1:]
    motion = ring_motion(seen_shell, place) * weight
    return np.concatenate([radii, motion.real, motion.imag], axis=1)


class _Problem:
    def __init__(
        self,
        groups: list[Group],
        sensor: Sensor,
        start: Values,
        held: Collection[str],
        advance: Callable[[int], None],
    ) -> None:
        self.groups, self.sensor, self.start = groups, sensor, start
        self.simulated = [
            None if group.contacts is None else _Simulated(group.contacts, group.side, i, sensor, advance)
            for i, group in enumerate(groups)
        ]
        self.recorded = [
            features(group.seen.lattice.shell, group.seen.place, group.seen.direction, group.seen.size)
            for group in groups
        ]
        labelled = any(group.contacts is not None for group in groups)
        slid = any(group.contacts is not None and np.any(np.abs(group.contacts.slide) > 1e-6) for group in groups)
        names = ["mm_across", "distance_mm"]
        names += ["pin_spacing_mm", "skin_to_gel"] if labelled else []
        names += ["friction"] if slid else []
        self.scalars = [name for name in names if name not in held]
        self.steps = 0  # of RATIO_STEP, from the start to the middle one of three domes
        self.recentre(start)
        self.surfaces = [i for i, group in enumerate(groups) if group.contacts is not None]
        self.names = self.scalars + [f"surface_mm {groups[i].name}" for i in self.surfaces]

    def values(self, x: np.ndarray) -> Values:
        """Parameters as logarithms over the start, surfaces as differences from it."""
        scalars = {
            name: float(getattr(self.start, name) * np.exp(step)) for name, step in zip(self.scalars, x, strict=False)
        }
        surface = list(self.start.surface_mm)
        for i, step in zip(self.surfaces, x[len(self.scalars) :], strict=True):
            surface[i] += float(step)
        return replace(self.start, **scalars, surface_mm=tuple(surface))

    def prior(self) -> np.ndarray:
        return np.array([PRIORS[name.split()[0]] for name in self.names])

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = -3 * self.prior(), 3 * self.prior()
        if "skin_to_gel" in self.names:
            k = self.names.index("skin_to_gel")
            low[k], high[k] = ((self.steps + end) * np.log(RATIO_STEP) for end in (-1, 1))
        return low, high

    def recentre(self, values: Values) -> bool:
        """Takes other domes where the stiffness nears the last one; whether it did."""
        place = np.log(values.skin_to_gel / self.start.skin_to_gel) / np.log(RATIO_STEP)
        moved = abs(place - self.steps) > 0.75
        self.steps = round(place) if moved else self.steps
        for simulated in self.simulated:
            if simulated is not None:
                simulated.nodes = [self.start.skin_to_gel * RATIO_STEP ** (self.steps + i) for i in (-1, 0, 1)]
        return moved

    def residuals(self, values: Values, which: int, near: Values | None = None) -> np.ndarray:
        """(N, F) of one group, simulated less recorded; zero where nothing is known. `near`: see `_Simulated.nearby`."""
        group, simulated = self.groups[which], self.simulated[which]
        moved = None
        if simulated is not None:
            moved = simulated.between(values) if near is None else simulated.nearby(values, near)
        place, rest = place_of(values, self.sensor, group.seen.size, moved)
        expected = features(shells(self.sensor), place, unit_vectors(rest), group.seen.size)
        difference = expected - self.recorded[which]
        if (
            simulated is None
        ):  # a touch widens all rings, nobody knows how far: the narrowest tenth is held to be undisturbed
            difference = np.broadcast_to(np.nanpercentile(difference, 90, axis=0), difference.shape).copy()
            difference[:, group.seen.lattice.shell.max() :] = 0
        else:
            difference[~simulated.converged] = 0
        return np.nan_to_num(difference)

    def all(self, values: Values) -> np.ndarray:
        return np.concatenate([self.residuals(values, i) for i in range(len(self.groups))])

    def slopes(self, x: np.ndarray, base: np.ndarray) -> np.ndarray:
        """(N, F, K) forward differences."""
        slopes = np.zeros((*base.shape, len(x)))
        ends = np.cumsum([0, *(len(recorded) for recorded in self.recorded)])
        for k, name in enumerate(self.names):
            step = 0.05 if name.split()[0] in ("friction", "skin_to_gel", "surface_mm") else 0.01
            moved = x.copy()
            moved[k] += step
            values, here = self.values(moved), self.values(x)
            near = here if name.split()[0] in ("friction", "surface_mm") else None
            own = [self.surfaces[k - len(self.scalars)]] if k >= len(self.scalars) else range(len(self.groups))
            for i in own:
                rows = slice(ends[i], ends[i + 1])
                slopes[rows, :, k] = (self.residuals(values, i, near) - base[rows]) / step
        return slopes


def fit(
    groups: list[Group],
    sensor: Sensor,
    start: Values,
    held: Collection[str] = (),
    advance: Callable[[int], None] = lambda contacts: None,
) -> Fitted:
    """Gauss-Newton with damping on all groups at once; what `held` names keeps its start.

    `start.surface_mm` has an entry for every group. `advance` is told how many contacts were solved.
    """
    problem = _Problem(groups, sensor, start, held, advance)
    x, prior = np.zeros(len(problem.names)), problem.prior()
    base = problem.all(start)
    before, cost, damping = _error(base), _cost(base, x / prior), 1e-3
    slopes = problem.slopes(x, base)
    for _ in range(ROUNDS):
        weight, old = _weights(base), cost
        while damping < 1e3:
            step = _solve(slopes, base, weight, x, prior, damping)
            proposed = np.clip(x + np.clip(step, -0.7, 0.7), *problem.bounds())
            tried = problem.all(problem.values(proposed))
            damping *= 10
            if _cost(tried, proposed / prior) < cost:
                x, base, cost, damping = proposed, tried, _cost(tried, proposed / prior), damping / 100
                break
        elsewhere = problem.recentre(problem.values(x))
        if elsewhere:
            base = problem.all(problem.values(x))
            cost, damping = _cost(base, x / prior), 1e-3
        slopes = problem.slopes(x, base)
        if not elsewhere and old - cost < SETTLED * old:
            break
    spread = _bootstrap(slopes, base, _weights(base), x, prior)
    return _told(problem, x, spread, before, _error(base))


def _weights(residual: np.ndarray) -> np.ndarray:
    """Of pseudo-Huber's loss, one for each image."""
    size = np.sqrt(np.sum(residual**2, axis=1))
    return 1 / np.sqrt(1 + (size / OUTLIER_PX) ** 2)


def _cost(residual: np.ndarray, prior: np.ndarray) -> float:
    size = np.sum(residual**2, axis=1) / OUTLIER_PX**2
    return float(np.sum(2 * OUTLIER_PX**2 * (np.sqrt(1 + size) - 1)) + PRIOR_PX**2 * np.sum(prior**2))


def _error(residual: np.ndarray) -> float:
    """Root mean square over an image's pins (to which the features' weights add up), the median over images."""
    return float(np.median(np.sqrt(np.sum(residual**2, axis=1))))


def _solve(slopes, residual, weight, x, prior, damping) -> np.ndarray:
    normal = np.einsum("nfk,n,nfl->kl", slopes, weight, slopes) + np.diag(PRIOR_PX**2 / prior**2)
    slope = np.einsum("nfk,n,nf->k", slopes, weight, residual) + PRIOR_PX**2 * x / prior**2
    return -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slope)


def _bootstrap(slopes, residual, weight, x, prior) -> np.ndarray:
    """(BOOTSTRAPS, K) minimisers of the linearised problem with images drawn again."""
    generator = np.random.default_rng(0)
    count = len(residual)
    draws = generator.multinomial(count, np.full(count, 1 / count), BOOTSTRAPS)
    return np.array([x + _solve(slopes, residual, weight * draw, x, prior, 0.0) for draw in draws])


def _told(problem: _Problem, x: np.ndarray, spread: np.ndarray, before: float, after: float) -> Fitted:
    ends = np.percentile(spread, [2.5, 97.5], axis=0)
    ends = ends - np.median(spread, axis=0) + x  # the draws scatter about their own middle; the fit is what is reported
    told = {}
    for k, name in enumerate(problem.names):
        start = getattr(problem.start, name) if k < len(problem.scalars) else None
        told[name] = [
            float(start * np.exp(e)) if start is not None else float(problem.start.surface_mm[_group(problem, k)] + e)
            for e in ends[:, k]
        ]
    width = (ends[1] - ends[0]) / (2 * 1.96 * problem.prior())
    return Fitted(
        problem.values(x),
        {name: pair[0] for name, pair in told.items()},
        {name: pair[1] for name, pair in told.items()},
        {name: bool(w < DETERMINED) for name, w in zip(problem.names, width, strict=True)},
        before,
        after,
        sum(int((~part.converged).sum()) for part in problem.simulated if part is not None),
    )


def _group(problem: _Problem, k: int) -> int:
    return problem.surfaces[k - len(problem.scalars)]
