"""Least squares of simulated on recorded rings: camera, pin spacing, friction and stiffness together.

Uncertainties come from resampling the images; a parameter that these leave open keeps its start, held there by a wide prior, and is
reported as not determined.
"""

from collections.abc import Callable, Collection
from typing import NamedTuple

import numpy as np

from jaxunshear.calibration.prediction import SensorValues
from jaxunshear.calibration.problem import UNSOLVED_RESIDUAL_PX, Problem, RecordedGroup
from jaxunshear.config.sensor import Sensor

ROUNDS = 12
MIN_COST_GAIN = 2e-3  # of the cost: a round that gains less is the last
OUTLIER_PX = 0.5  # of 128: beyond it a residual counts linearly (stick and slip in turn leave some pins anywhere)
PRIOR_PX = 0.15  # how much a prior weighs: the residual that one image's rings usually keep
MAX_INTERVAL_SHARE = 0.4  # a 95% interval narrower than this share of the prior's is knowledge
BOOTSTRAPS = 400


class FitResult(NamedTuple):
    """`low`, `high`: 95 % bootstrap interval over images, by name; `determined`: whether the images determine it."""

    values: SensorValues
    low: dict[str, float]
    high: dict[str, float]
    determined: dict[str, bool]
    before_px: (
        float  # from recorded to simulated rings, rms over an image's pins, median image, px of 128
    )
    after_px: float
    dropped: int  # contacts that did not converge


def fit(
    groups: list[RecordedGroup],
    sensor: Sensor,
    start: SensorValues,
    fixed: Collection[str] = (),
    advance: Callable[[int], None] = lambda contacts: None,
    begin: SensorValues | None = None,
) -> FitResult:
    """Gauss-Newton with damping on all groups at once; what `fixed` names keeps its start.

    `start`, where the priors stand, has an entry of `surface_mm` for every group; the search may `begin` elsewhere. `advance` is
    called with how many contacts were solved.
    """
    problem = Problem(groups, sensor, start, fixed, advance)
    prior = problem.prior()
    x = problem.to_parameters(begin or start)
    before = _error(
        problem.compute_all_residuals(problem.values(np.where(problem.nuisance(), x, 0.0)))
    )
    while problem.recentre(problem.values(x)):
        pass
    base = problem.compute_all_residuals(problem.values(x))
    cost, damping = _cost(base, x / prior), 1e-3
    slopes = problem.compute_jacobian(x)
    for _ in range(ROUNDS):
        weight, old = _weights(base), cost
        while damping < 1e3:
            step = _solve(slopes, base, weight, x, prior, damping)
            proposed = np.clip(x + np.clip(step, -0.7, 0.7), *problem.bounds())
            tried = problem.compute_all_residuals(problem.values(proposed))
            damping *= 10
            if _cost(tried, proposed / prior) < cost:
                x, base, cost, damping = (
                    proposed,
                    tried,
                    _cost(tried, proposed / prior),
                    damping / 100,
                )
                break
        elsewhere = problem.recentre(problem.values(x))
        if elsewhere:
            base = problem.compute_all_residuals(problem.values(x))
            cost, damping = _cost(base, x / prior), 1e-3
        slopes = problem.compute_jacobian(x)
        if not elsewhere and old - cost < MIN_COST_GAIN * old:
            break
    spread = _bootstrap(slopes, problem.make_resampler(problem.values(x)), _weights(base), x, prior)
    return _build_result(problem, x, spread, before, base)


def _weights(residual: np.ndarray) -> np.ndarray:
    """Of pseudo-Huber's loss, one for each image."""
    size = np.sqrt(np.sum(residual**2, axis=1))
    return 1 / np.sqrt(1 + (size / OUTLIER_PX) ** 2)


def _cost(residual: np.ndarray, prior: np.ndarray) -> float:
    size = np.sum(residual**2, axis=1) / OUTLIER_PX**2
    return float(
        np.sum(2 * OUTLIER_PX**2 * (np.sqrt(1 + size) - 1)) + PRIOR_PX**2 * np.sum(prior**2)
    )


def _error(residual: np.ndarray) -> float:
    """Root mean square over an image's pins (to which the features' weights add up), the median over images."""
    return float(np.median(np.sqrt(np.sum(residual**2, axis=1))))


def _solve(
    slopes: np.ndarray,
    residual: np.ndarray,
    weight: np.ndarray,
    x: np.ndarray,
    prior: np.ndarray,
    damping: float,
) -> np.ndarray:
    normal = np.einsum("nfk,n,nfl->kl", slopes, weight, slopes) + np.diag(PRIOR_PX**2 / prior**2)
    slope = np.einsum("nfk,n,nf->k", slopes, weight, residual) + PRIOR_PX**2 * x / prior**2
    return -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slope)


def _bootstrap(
    slopes: np.ndarray,
    redraw: Callable[[np.random.Generator], np.ndarray],
    weight: np.ndarray,
    x: np.ndarray,
    prior: np.ndarray,
) -> np.ndarray:
    """(BOOTSTRAPS, K) minimisers of the linearised problem with images drawn again, and with them the places (K,) that the priors
    hold parameters at: else one that the images say nothing of would not move, and pass for exactly known. `redraw`: see
    `Problem.make_resampler`."""
    generator = np.random.default_rng(0)
    count = len(weight)
    draws = generator.multinomial(count, np.full(count, 1 / count), BOOTSTRAPS)
    places = prior * generator.standard_normal((BOOTSTRAPS, len(x)))
    return np.array(
        [
            x + _solve(slopes, redraw(generator), weight * draw, x - place, prior, 0.0)
            for draw, place in zip(draws, places, strict=True)
        ]
    )


def _build_result(
    problem: Problem, x: np.ndarray, spread: np.ndarray, before: float, residual: np.ndarray
) -> FitResult:
    ends = np.percentile(spread, [2.5, 97.5], axis=0)
    ends = (
        ends - np.median(spread, axis=0) + x
    )  # the draws scatter about their own middle; the fit is what is reported
    low, high = (problem.name_values(problem.values(end)) for end in ends)
    width = (ends[1] - ends[0]) / (2 * 1.96 * problem.prior())
    return FitResult(
        problem.values(x),
        low,
        high,
        {name: bool(w < MAX_INTERVAL_SHARE) for name, w in zip(problem.names, width, strict=True)},
        before,
        _error(residual),
        int(np.sum(residual[:, 0] == UNSOLVED_RESIDUAL_PX)),
    )
