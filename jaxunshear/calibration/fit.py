"""Fit camera, pin spacing, friction and stiffness to recorded rings, by least squares.

Uncertainties come from resampling the images. A parameter that the images leave open stays at its
start, because of a wide prior, and is reported as not determined.
"""

from collections.abc import Callable, Collection
from typing import NamedTuple

import numpy as np

from jaxunshear.calibration.prediction import SensorValues
from jaxunshear.calibration.problem import UNSOLVED_RESIDUAL_PX, Problem, RecordedGroup

ROUNDS = 12
MIN_COST_GAIN = 2e-3  # a round that gains a smaller share of the cost is the last
FIRST_DAMPING, MAX_DAMPING = 1e-3, 1e3
MAX_STEP = 0.7
# px of 128: a larger residual counts linearly (stick and slip in turn leave some pins anywhere)
OUTLIER_PX = 0.5
PRIOR_PX = 0.15  # weight of a prior: the residual that one image's rings usually keep
MAX_INTERVAL_SHARE = 0.4  # a parameter is determined if its interval is so much of the prior's
BOOTSTRAPS = 400


class Interval(NamedTuple):
    """A 95 % interval over images."""

    low: float
    high: float
    determined: bool  # whether the images determine the parameter


class FitResult(NamedTuple):
    """Fitted values, with an interval by name of `Problem.names`."""

    values: SensorValues
    intervals: dict[str, Interval]
    # between recorded and simulated rings, px of 128: rms over an image's pins, median over images
    before_px: float
    after_px: float
    dropped: int  # contacts that did not converge


class _Minimum(NamedTuple):
    x: np.ndarray  # (K,)
    residual: np.ndarray  # (N, F)
    slopes: np.ndarray  # (N, F, K)


def fit(
    groups: list[RecordedGroup],
    start: SensorValues,
    fixed: Collection[str] = (),
    advance: Callable[[int], None] = lambda contacts: None,
    begin: SensorValues | None = None,
) -> FitResult:
    """Fit all groups at once by damped Gauss-Newton.

    Args:
        start: The centre of the priors, with an entry of `surface_mm` for every group.
        fixed: Names of parameters that keep their start.
        advance: Is called with numbers of simulated contacts.
        begin: Where the search begins, if not at `start`.
    """
    problem = Problem(groups, start, fixed, advance)
    x = problem.to_parameters(begin or start)
    before_px = _compute_error(problem.compute_residuals(np.where(problem.is_scalar, 0.0, x)))
    minimum = _minimise(problem, x)
    spread = _bootstrap(minimum, _compute_weights(minimum.residual), problem.prior)
    ends = np.percentile(spread, [2.5, 97.5], axis=0)
    # the draws scatter about their own median; the interval belongs around the fit
    ends = ends - np.median(spread, axis=0) + minimum.x
    is_determined = ends[1] - ends[0] < MAX_INTERVAL_SHARE * 2 * 1.96 * problem.prior
    columns = (*map(problem.to_physical, ends), is_determined)
    rows = map(Interval, *(column.tolist() for column in columns))
    return FitResult(
        problem.to_values(minimum.x),
        dict(zip(problem.names, rows, strict=True)),
        before_px,
        _compute_error(minimum.residual),
        int(np.sum(minimum.residual[:, 0] == UNSOLVED_RESIDUAL_PX)),
    )


def _minimise(problem: Problem, x: np.ndarray) -> _Minimum:
    prior = problem.prior
    while problem.recentre(x):
        pass
    residual = problem.compute_residuals(x)
    cost, damping = _compute_cost(residual, x / prior), FIRST_DAMPING
    slopes = problem.compute_jacobian(x)
    for _ in range(ROUNDS):
        weight, old_cost = _compute_weights(residual), cost
        while damping < MAX_DAMPING:
            step = _compute_step(slopes, residual, weight, x, prior, damping)
            trial = np.clip(x + np.clip(step, -MAX_STEP, MAX_STEP), *problem.compute_bounds())
            trial_residual = problem.compute_residuals(trial)
            trial_cost = _compute_cost(trial_residual, trial / prior)
            damping *= 10
            if trial_cost < cost:
                x, residual, cost, damping = trial, trial_residual, trial_cost, damping / 100
                break
        recentred = problem.recentre(x)
        if recentred:
            residual = problem.compute_residuals(x)
            cost, damping = _compute_cost(residual, x / prior), FIRST_DAMPING
        slopes = problem.compute_jacobian(x)
        if not recentred and old_cost - cost < MIN_COST_GAIN * old_cost:
            break
    return _Minimum(x, residual, slopes)


def _compute_weights(residual: np.ndarray) -> np.ndarray:
    """Compute the weight of each image in pseudo-Huber's loss, (N,)."""
    size = np.sqrt(np.sum(residual**2, axis=1))
    return 1 / np.sqrt(1 + (size / OUTLIER_PX) ** 2)


def _compute_cost(residual: np.ndarray, prior_steps: np.ndarray) -> float:
    """Compute pseudo-Huber's loss of the images, and of the priors' standard deviations."""
    size = np.sum(residual**2, axis=1) / OUTLIER_PX**2
    return float(
        np.sum(2 * OUTLIER_PX**2 * (np.sqrt(1 + size) - 1)) + PRIOR_PX**2 * np.sum(prior_steps**2)
    )


def _compute_error(residual: np.ndarray) -> float:
    """Compute the median over images of the rms over an image's pins.

    The features' weights add up to the pins.
    """
    return float(np.median(np.sqrt(np.sum(residual**2, axis=1))))


def _compute_step(
    slopes: np.ndarray,
    residual: np.ndarray,
    weight: np.ndarray,
    x: np.ndarray,
    prior: np.ndarray,
    damping: float,
) -> np.ndarray:
    normal = np.einsum("nfk,n,nfl->kl", slopes, weight, slopes) + np.diag(PRIOR_PX**2 / prior**2)
    gradient = np.einsum("nfk,n,nf->k", slopes, weight, residual) + PRIOR_PX**2 * x / prior**2
    return -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)


def _bootstrap(minimum: _Minimum, weight: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Minimise the linearised problem for resampled images, (BOOTSTRAPS, K).

    The centres of the priors are drawn again, too. Otherwise a parameter that the images do not
    determine would not move, and would appear to be exactly determined.
    """
    x, residual, slopes = minimum
    generator, count = np.random.default_rng(0), len(weight)
    draws = generator.multinomial(count, np.full(count, 1 / count), BOOTSTRAPS)
    centres = prior * generator.standard_normal((BOOTSTRAPS, len(x)))
    minima = []
    for draw, centre in zip(draws, centres, strict=True):
        minima.append(x + _compute_step(slopes, residual, weight * draw, x - centre, prior, 0.0))
    return np.array(minima)
