"""Simulated images of calibrated contacts, and the pin radius that makes their pins as large as the recorded ones."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.calibration.labels import EDGE_STIMULUS, make_paths
from jaxunshear.calibration.pin_statistics import measure_pin_diameters
from jaxunshear.calibration.prediction import SensorValues, is_within_reach
from jaxunshear.calibration.problem import RecordedGroup
from jaxunshear.config.image import Camera, Nuisance, Preprocess
from jaxunshear.config.sensor import Sensor
from jaxunshear.perception.pin_detection import find_pins
from jaxunshear.perception.preprocess import binarise
from jaxunshear.simulator.camera import compute_outer_fraction, render_frame
from jaxunshear.simulator.paths import Paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.simulate import follow

FRAME_PX = 256  # at least: what a camera sees before it is made smaller
SIZE_IMAGES = 16  # determine the size of pins and housing
RADIUS_STEPS = 3
HOUSING_ROUNDS = 3  # the threshold follows the local mean, so that the ring's area is not all
UNKNOWN_DEPTHS = (
    0.03,
    0.15,
)  # over the dome's radius, of flat taps that stand in for unlabelled images


def simulate_tips(
    group: RecordedGroup, sensor: Sensor, values: SensorValues, which: int
) -> tuple[np.ndarray, np.ndarray]:
    """Pin tips (N, P, 3) mm of a group's contacts, or of flat taps where these are unknown; and (N,) bool: converged."""
    if group.contacts is not None:
        paths = make_paths(
            group.contacts, sensor, values.surface_mm[which], group.side, values.friction
        )
    else:
        count = len(group.observation.pin_counts)
        points = np.zeros((count, 2, 6))
        points[..., 0] = -25.0
        points[:, 1, 3] = sensor.dome_radius_mm * np.linspace(*UNKNOWN_DEPTHS, count)
        paths = Paths(np.zeros(count, int), np.full(count, values.friction), points)
    fine = is_within_reach(sensor, paths)
    solved, _ = follow(sensor, (EDGE_STIMULUS,), paths.take(np.flatnonzero(fine)))
    tips, converged = (
        np.repeat(compute_pin_tips(sensor)[None], len(paths), axis=0),
        np.zeros(len(paths), bool),
    )
    tips[fine], converged[fine] = solved.pins, solved.converged
    return tips, converged


def render_images(camera: Camera, sensor: Sensor, tips: np.ndarray, seed: int = 0) -> np.ndarray:
    """Binary images (N, S, S) uint8 of pin tips (N, P, 3) mm, with the default disturbances; S is the camera's `frame_px`."""
    keys = jax.random.split(jax.random.key(seed), len(tips))
    before = replace(camera, frame_px=max(FRAME_PX, camera.frame_px))

    @jax.jit
    def draw(tips: jax.Array, keys: jax.Array) -> jax.Array:
        grey = jax.vmap(partial(render_frame, before, sensor, Nuisance()))(
            jnp.asarray(tips, jnp.float32), keys
        )
        return binarise(Preprocess(size=camera.frame_px), grey)

    return np.concatenate(
        [np.asarray(draw(tips[i : i + 1], keys[i : i + 1])) for i in range(len(tips))]
    )


def _some(tips: np.ndarray) -> np.ndarray:
    return tips[:: -(-len(tips) // SIZE_IMAGES)]


def fit_pin_radius(
    groups: list[RecordedGroup], sensor: Sensor, values: SensorValues, tips: list[np.ndarray]
) -> tuple[float, float, float]:
    """(radius, low, high) mm: the pins of rendered images have the recorded ones' mean diameter; 95 % over images."""
    recorded, scatter = [], []
    for group in groups:
        each = np.nanmean(group.observation.diameter, axis=1)
        recorded.append(np.nanmean(each))
        scatter.append(np.nanstd(each) / np.sqrt(max(1, len(each))) / np.nanmean(each))

    def larger(radius: float) -> float:
        """By what factor the rendered pins are larger than the recorded ones."""
        ratios = []
        for group, tip, wanted in zip(groups, tips, recorded, strict=True):
            images = render_images(
                values.camera(group.observation.size),
                replace(sensor, pin_radius_mm=radius),
                _some(tip),
            )
            ratios.append(
                np.mean([np.nanmean(measure_pin_diameters(i, find_pins(i))) for i in images])
                / wanted
            )
        return float(np.mean(ratios))

    most = 0.49 * sensor.pin_spacing_mm
    known = [(sensor.pin_radius_mm, larger(sensor.pin_radius_mm))]
    slope = 1 / sensor.pin_radius_mm
    for _ in range(RADIUS_STEPS):
        radius, factor = known[-1]
        trial = float(np.clip(radius - (factor - 1) / slope, 0.2 * radius, min(most, 3 * radius)))
        if abs(trial / radius - 1) < 2e-3:
            break
        known.append((trial, larger(trial)))
        slope = max((known[-1][1] - factor) / (trial - radius), 0.3 / trial)
    best = min(known, key=lambda pair: abs(pair[1] - 1))[0]
    error = 1.96 * float(np.sqrt(np.sum(np.square(scatter)))) / len(scatter) / slope
    return best, best - error, best + error


def fit_housing(
    groups: list[RecordedGroup], sensor: Sensor, values: SensorValues, tips: list[np.ndarray]
) -> float:
    """The housing's inner radius over the outermost pins' (`Camera.housing`) that makes images as white as the recorded ones.

    What is white beside the pins is a ring from there to the mask, so that its area gives the radius.
    """
    housing = values.housing
    for _ in range(HOUSING_ROUNDS):
        excess = []
        for group, tip in zip(groups, tips, strict=True):
            camera = replace(values, housing=housing).camera(group.observation.size)
            images = render_images(camera, sensor, _some(tip))
            ring = np.pi * compute_outer_fraction(camera, sensor) ** 2
            excess.append((np.mean(images > 127) - np.mean(group.observation.white_share)) / ring)
        housing = float(np.sqrt(housing**2 + np.mean(excess)))
    return housing
