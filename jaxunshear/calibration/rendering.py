"""Simulated contacts of a calibration as images, and what is fitted to these images.

The pin radius makes the rendered pins as large as the recorded ones. The housing's radius makes the
rendered images as white as the recorded ones.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.calibration.pin_statistics import measure_pin_diameters
from jaxunshear.calibration.prediction import SensorValues
from jaxunshear.calibration.problem import RecordedGroup
from jaxunshear.config.sensor import Camera, Nuisance, Preprocess, Sensor
from jaxunshear.perception.pin_detection import find_pins
from jaxunshear.perception.preprocess import binarise
from jaxunshear.simulator.camera import compute_outer_fraction, render_frame

FRAME_PX = 256  # least size of a camera frame before it is resized
SIZE_IMAGES = 16  # images from which the size of pins and housing is fitted
RADIUS_STEPS = 3
HOUSING_ROUNDS = 3  # the threshold follows the local mean, so white is not only the ring's area


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


def _sample(tips: np.ndarray) -> np.ndarray:
    return tips[:: -(-len(tips) // SIZE_IMAGES)]


def fit_pin_radius(
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
                _sample(group_tips),
            )
            rendered = [np.nanmean(measure_pin_diameters(i, find_pins(i))) for i in images]
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


def fit_housing(
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
            images = render_images(camera, values.sensor, _sample(group_tips))
            ring = np.pi * compute_outer_fraction(camera, values.sensor) ** 2
            excess.append((np.mean(images > 127) - np.mean(group.observation.white_share)) / ring)
        housing = float(np.sqrt(housing**2 + np.mean(excess)))
    return housing
