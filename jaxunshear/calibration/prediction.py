"""Simulated pins of labelled contacts, as smooth functions of the calibrated values.

A contact is solved once, for the pins of a probe: a lattice that is finer and wider than the
sensor's. The motion of the sensor's own pins is interpolated from it. So the spacing of the pins
and the camera can be fitted without a new simulation.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import jax.numpy as jnp
import numpy as np

from jaxunshear.calibration.labels import EDGE_STIMULUS, LabelledMotions, make_paths
from jaxunshear.config.image import Camera
from jaxunshear.config.reach import compute_max_depth_mm
from jaxunshear.config.sensor import Sensor
from jaxunshear.simulator.camera import project
from jaxunshear.simulator.paths import DEPTH, TILT_X, Paths
from jaxunshear.simulator.pin_layout import compute_pin_lattice, compute_pin_tips
from jaxunshear.simulator.simulate import follow

PROBE_DEG = 5.0  # between the probe's rings
PROBE_RINGS = 14  # to 70 degrees
Simulate = Callable[..., tuple[np.ndarray, np.ndarray]]  # as `simulate_displacements`


@dataclass(frozen=True)
class SensorValues:
    """The values that are calibrated.

    `surface_mm` is a nuisance of each group of images: the height of the object's top in its
    labels.
    """

    mm_across: float
    distance_mm: float
    pin_spacing_mm: float
    friction: float
    skin_to_gel: float
    surface_mm: tuple[float, ...] = ()
    housing: float = Camera.housing

    def camera(self, frame_px: int) -> Camera:
        return Camera(frame_px, self.mm_across, self.distance_mm, self.housing)

    def sensor(self, sensor: Sensor) -> Sensor:
        return replace(
            sensor,
            pin_spacing_mm=self.pin_spacing_mm,
            gel_modulus_mpa=sensor.skin_modulus_mpa / self.skin_to_gel,
        )


def compute_modulus_ratio(sensor: Sensor) -> float:
    return sensor.skin_modulus_mpa / sensor.gel_modulus_mpa


def _compute_probe_spacing(sensor: Sensor) -> float:
    return sensor.dome_radius_mm * math.radians(PROBE_DEG)


def make_probe_sensor(sensor: Sensor, ratio: float) -> Sensor:
    """Make a dome like the sensor's with the pins of the probe, and a ratio of skin to gel."""
    spacing = _compute_probe_spacing(sensor)
    return replace(
        sensor,
        name=f"{sensor.name}-probe",
        layout="rings",
        rings=PROBE_RINGS,
        pin_spacing_mm=spacing,
        pin_radius_mm=min(sensor.pin_radius_mm, 0.4 * spacing),  # pins may not overlap
        gel_modulus_mpa=sensor.skin_modulus_mpa / ratio,
    )


@lru_cache(maxsize=64)
def compute_interpolation(sensor: Sensor) -> np.ndarray:
    """Compute weights (P, Q) from the probe's pins to the sensor's."""
    return compute_interpolation_at(sensor, compute_pin_lattice(sensor))


def compute_interpolation_at(sensor: Sensor, flat: np.ndarray) -> np.ndarray:
    """Compute weights (P, Q) from the probe's pins to positions (P, 2).

    Positions are in mm of arc from the apex. The weights are trigonometric around the rings and
    cubic across them.
    """
    rings = PROBE_RINGS
    across = np.linalg.norm(flat, axis=-1) / _compute_probe_spacing(sensor)
    angle = np.arctan2(flat[:, 1], flat[:, 0])
    first = np.clip(np.floor(across).astype(int) - 1, 0, rings - 3)
    weights = np.zeros((len(flat), 1 + 3 * rings * (rings + 1)))
    for ring in range(rings + 1):
        pins = max(1, 6 * ring)
        start = 1 + 3 * ring * (ring - 1) if ring else 0
        others = first[:, None] + np.arange(4)
        used = (others == ring).any(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            factors = np.where(others == ring, 1.0, (across[:, None] - others) / (ring - others))
        factor = np.where(used, factors.prod(axis=1), 0.0)
        turn = angle[:, None] - 2 * np.pi * np.arange(pins) / pins
        weights[:, start : start + pins] = factor[:, None] * _interpolate_circle(pins, turn)
    return weights


def _interpolate_circle(count: int, turn: np.ndarray) -> np.ndarray:
    """Compute trigonometric weights of `count` even points of a circle.

    The interpolated point is `turn` rad from each.
    """
    if count == 1:
        return np.ones_like(turn)
    half = np.tan(turn / 2)
    on_point = np.abs(half) < 1e-9
    safe = np.where(on_point, 1.0, half)
    return np.where(on_point, 1.0, np.sin(count * turn / 2) / (count * safe))


def simulate_displacements(
    sensor: Sensor,
    contacts: LabelledMotions,
    side: int,
    friction: float | np.ndarray,
    surface_mm: float,
    ratio: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate the displacements (N, Q, 3) mm of the probe's pins.

    Also returns which contacts (N,) were within reach and converged.
    """
    probe = make_probe_sensor(sensor, ratio)
    paths = make_paths(contacts, probe, surface_mm, side, friction)
    reachable = is_within_reach(probe, paths)
    displacement = np.zeros((len(paths), probe.pins, 3), np.float32)
    converged = np.zeros(len(paths), bool)
    if reachable.any():
        solved, _ = follow(probe, (EDGE_STIMULUS,), paths.take(np.flatnonzero(reachable)))
        displacement[reachable] = solved.pins - compute_pin_tips(probe).astype(np.float32)
        converged[reachable] = solved.converged
    return displacement, converged


def is_within_reach(sensor: Sensor, paths: Paths) -> np.ndarray:
    """Mark the contacts (N,) that the sensor's contact rings cover at every way point."""
    tilt = np.linalg.norm(paths.points[..., TILT_X:], axis=-1)
    compute_depths = np.vectorize(
        lambda degrees: compute_max_depth_mm(sensor, degrees), otypes=[float]
    )
    return np.all(paths.points[..., DEPTH] <= compute_depths(tilt), axis=1)


def interpolate_displacements(weights: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Interpolate the probe's displacements (N, Q, 3) to (N, P, 3).

    `weights` (P, Q) are those of `compute_interpolation_at`.
    """
    by_pin = displacement.swapaxes(0, 1).reshape(displacement.shape[1], -1)
    return (weights @ by_pin).reshape(len(weights), -1, 3).swapaxes(0, 1)


def project_tips(values: SensorValues, sensor: Sensor, size: int, tips: np.ndarray) -> np.ndarray:
    """Project tips (..., 3) mm to (..., 2) px from the middle of an image of `size`."""
    pixels = project(values.camera(size), jnp.asarray(tips), values.sensor(sensor))
    return np.asarray(pixels) - (size - 1) / 2


def predict_positions(
    values: SensorValues, sensor: Sensor, size: int, displacement: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Predict the pins (N, P, 2), and their rest positions (P, 2).

    They are in px from the middle of an image of `size`. `displacement` (N, Q, 3) mm is that of the
    probe's pins; None for one undisturbed image.
    """
    fitted = values.sensor(sensor)
    tips = compute_pin_tips(fitted)
    rest = project_tips(values, sensor, size, tips)
    if displacement is None:
        return rest[None], rest
    # the weights do not depend on the stiffness, so one entry of the cache is enough
    cached = replace(fitted, gel_modulus_mpa=sensor.gel_modulus_mpa)
    shift = interpolate_displacements(compute_interpolation(cached), displacement)
    return project_tips(values, sensor, size, tips + shift), rest
