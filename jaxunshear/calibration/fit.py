"""Fit camera, pin spacing, friction and stiffness to recorded rings, by least squares.

Uncertainties come from resampling the images. A parameter that the images leave open stays at its
start, because of a wide prior, and is reported as not determined.

Then the radii of pins and housing are fitted, until rendered pins are as large, and rendered images
as white, as the recorded ones.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.calibration.pin_statistics import measure_pin_diameters
from jaxunshear.calibration.prediction import SensorValues, SolvedContacts
from jaxunshear.calibration.problem import UNSOLVED_RESIDUAL_PX, FitProblem, RecordedGroup
from jaxunshear.config.sensor import Camera, Nuisance, Preprocess, Sensor
from jaxunshear.perception.pin_detection import detect_pin_centres
from jaxunshear.perception.preprocess import binarise
from jaxunshear.simulator.camera import compute_outer_fraction, render_frame

ROUNDS = 12
MIN_COST_GAIN = 2e-3  # a round that gains a smaller share of the cost is the last
FIRST_DAMPING, MAX_DAMPING = 1e-3, 1e3
MAX_STEP = 0.7
# px of 128: a larger residual counts linearly (stick and slip in turn leave some pins anywhere)
OUTLIER_PX = 0.5
PRIOR_PX = 0.15  # weight of a prior: the residual that one image's rings usually keep
MAX_INTERVAL_SHARE = 0.4  # a parameter is determined if its interval is so much of the prior's
BOOTSTRAPS = 400
FRAME_PX = 256  # least size of a camera frame before it is resized
SIZE_IMAGES = 16  # images from which the size of pins and housing is fitted
RADIUS_STEPS = 3
HOUSING_ROUNDS = 3  # the threshold follows the local mean, so white is not only the ring's area


class Interval(NamedTuple):
    """A 95 % interval over images."""

    low: float
    high: float
    determined: bool  # whether the images determine the parameter


class FitResult(NamedTuple):
    """Fitted values, with an interval by name of `FitProblem.names`."""

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
    problem = FitProblem(groups, start, fixed, advance)
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


def _minimise(problem: FitProblem, x: np.ndarray) -> _Minimum:
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


def render_images(camera: Camera, sensor: Sensor, tips: np.ndarray, seed: int = 0) -> np.ndarray:
    """Render binary images (N, S, S) uint8 of pin tips (N, P, 3) mm.

    Disturbances are the default ones. S is the camera's `frame_px`.
    """
    keys = jax.random.split(jax.random.key(seed), len(tips))
    frame_camera = replace(camera, frame_px=max(FRAME_PX, camera.frame_px))

    @jax.jit
    def render(tips: jax.Array, keys: jax.Array) -> jax.Array:
        grey = jax.vmap(partial(render_frame, frame_camera, sensor, Nuisance()))(
            jnp.asarray(tips, jnp.float32), keys
        )
        return binarise(Preprocess(size=camera.frame_px), grey)

    return np.concatenate(
        [np.asarray(render(tips[i : i + 1], keys[i : i + 1])) for i in range(len(tips))]
    )


def fit_appearance(
    groups: list[RecordedGroup], values: SensorValues, solved: Sequence[SolvedContacts]
) -> SensorValues:
    """Fit the radii of pins and housing to the recorded images, by the solved contacts' images."""
    tips = []
    for each in solved:
        usable = each.tips[each.converged] if each.converged.any() else each.tips
        tips.append(usable[:: -(-len(usable) // SIZE_IMAGES)])
    radius = _fit_pin_radius(groups, values, tips)
    values = replace(values, base=replace(values.base, pin_radius_mm=radius))
    return replace(values, housing=_fit_housing(groups, values, tips))


def _fit_pin_radius(
    groups: list[RecordedGroup], values: SensorValues, tips: Sequence[np.ndarray]
) -> float:
    """Fit the pin radius mm at which rendered pins have the mean diameter of the recorded ones."""
    sensor = values.sensor
    diameters = [np.nanmean(np.nanmean(group.observation.diameter, axis=1)) for group in groups]

    def compute_size_ratio(radius: float) -> float:
        """Compute the mean ratio of rendered to recorded pin diameters."""
        ratios = []
        for group, group_tips, diameter in zip(groups, tips, diameters, strict=True):
            images = render_images(
                values.camera(group.observation.size),
                replace(sensor, pin_radius_mm=radius),
                group_tips,
            )
            rendered = [np.nanmean(measure_pin_diameters(i, detect_pin_centres(i))) for i in images]
            ratios.append(np.mean(rendered) / diameter)
        return float(np.mean(ratios))

    most = 0.49 * sensor.pin_spacing_mm
    trials = [(sensor.pin_radius_mm, compute_size_ratio(sensor.pin_radius_mm))]
    slope = 1 / sensor.pin_radius_mm
    for _ in range(RADIUS_STEPS):
        radius, ratio = trials[-1]
        trial = float(np.clip(radius - (ratio - 1) / slope, 0.2 * radius, min(most, 3 * radius)))
        if abs(trial / radius - 1) < 2e-3:
            break
        trials.append((trial, compute_size_ratio(trial)))
        slope = max((trials[-1][1] - ratio) / (trial - radius), 0.3 / trial)
    return min(trials, key=lambda pair: abs(pair[1] - 1))[0]


def _fit_housing(
    groups: list[RecordedGroup], values: SensorValues, tips: Sequence[np.ndarray]
) -> float:
    """Fit `Camera.housing` so that rendered images are as white as the recorded ones.

    It is the housing's inner radius over that of the outermost pins. The white beside the pins is a
    ring from there to the mask, so its area gives the radius.
    """
    housing = values.housing
    for _ in range(HOUSING_ROUNDS):
        excess = []
        for group, group_tips in zip(groups, tips, strict=True):
            camera = replace(values, housing=housing).camera(group.observation.size)
            images = render_images(camera, values.sensor, group_tips)
            ring = np.pi * compute_outer_fraction(camera, values.sensor) ** 2
            excess.append((np.mean(images > 127) - np.mean(group.observation.white_share)) / ring)
        housing = float(np.sqrt(housing**2 + np.mean(excess)))
    return housing
