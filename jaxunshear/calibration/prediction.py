"""Where the simulated pins of labelled contacts stand, as a smooth function of what is to be calibrated.

A contact is solved once for pins on a finer and wider lattice than the sensor's; how far its own pins move follows by
interpolation, so that their spacing and the camera can be fitted without a new contact.
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

PROBE_DEG = 5.0  # between its rings
PROBE_RINGS = 14  # to 70 degrees
Simulate = Callable[..., tuple[np.ndarray, np.ndarray]]  # as `simulate_displacements`


@dataclass(frozen=True)
class SensorValues:
    """What is calibrated. `surface_mm` is the nuisance of each group of images: where the object's top is in its labels."""

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


def _probe_spacing(sensor: Sensor) -> float:
    return sensor.dome_radius_mm * math.radians(PROBE_DEG)


def make_probe_sensor(sensor: Sensor, ratio: float) -> Sensor:
    """The same dome with pins everywhere, which have no size: they may not overlap."""
    spacing = _probe_spacing(sensor)
    return replace(
        sensor,
        name=f"{sensor.name}-probe",
        layout="rings",
        rings=PROBE_RINGS,
        pin_spacing_mm=spacing,
        pin_radius_mm=min(sensor.pin_radius_mm, 0.4 * spacing),
        gel_modulus_mpa=sensor.skin_modulus_mpa / ratio,
    )


@lru_cache(maxsize=64)
def compute_interpolation(sensor: Sensor) -> np.ndarray:
    """(P, Q): the probe's pins to the sensor's."""
    return compute_interpolation_at(sensor, compute_pin_lattice(sensor))


def compute_interpolation_at(sensor: Sensor, flat: np.ndarray) -> np.ndarray:
    """(P, Q): the probe's pins to places (P, 2) mm of arc from the apex; trigonometric around the rings and cubic across them."""
    rings = PROBE_RINGS
    across = np.linalg.norm(flat, axis=-1) / _probe_spacing(sensor)
    angle = np.arctan2(flat[:, 1], flat[:, 0])
    first = np.clip(np.floor(across).astype(int) - 1, 0, rings - 3)
    weights = np.zeros((len(flat), 1 + 3 * rings * (rings + 1)))
    for ring in range(rings + 1):
        pins = max(1, 6 * ring)
        start = 1 + 3 * ring * (ring - 1) if ring else 0
        others = first[:, None] + np.arange(4)
        used = (others == ring).any(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = np.where(
                others == ring, 1.0, (across[:, None] - others) / (ring - others)
            ).prod(axis=1)
        turn = angle[:, None] - 2 * np.pi * np.arange(pins) / pins
        weights[:, start : start + pins] = np.where(used, factor, 0.0)[:, None] * _periodic(
            pins, turn
        )
    return weights


def _periodic(count: int, turn: np.ndarray) -> np.ndarray:
    """Trigonometric interpolation between `count` even points of a circle, at `turn` rad from each."""
    if count == 1:
        return np.ones_like(turn)
    half = np.tan(turn / 2)
    at = np.abs(half) < 1e-9
    return np.where(at, 1.0, np.sin(count * turn / 2) / (count * np.where(at, 1.0, half)))


def simulate_displacements(
    sensor: Sensor,
    contacts: LabelledMotions,
    side: int,
    friction: float | np.ndarray,
    surface_mm: float,
    ratio: float,
) -> tuple[np.ndarray, np.ndarray]:
    """(N, Q, 3) mm of the probe's pins, and (N,) bool which contacts were reached and converged."""
    body = make_probe_sensor(sensor, ratio)
    paths = make_paths(contacts, body, surface_mm, side, friction)
    fine = is_within_reach(body, paths)
    moved, converged = np.zeros((len(paths), body.pins, 3), np.float32), np.zeros(len(paths), bool)
    if fine.any():
        solved, _ = follow(body, (EDGE_STIMULUS,), paths.take(np.flatnonzero(fine)))
        moved[fine] = solved.pins - compute_pin_tips(body).astype(np.float32)
        converged[fine] = solved.converged
    return moved, converged


def is_within_reach(sensor: Sensor, paths: Paths) -> np.ndarray:
    """(N,) bool: contacts that the sensor's contact rings cover at every way point."""
    tilt = np.linalg.norm(paths.points[..., TILT_X:], axis=-1)
    deepest = np.vectorize(lambda degrees: compute_max_depth_mm(sensor, degrees), otypes=[float])(
        tilt
    )
    return np.all(paths.points[..., DEPTH] <= deepest, axis=1)


def interpolate_displacements(weights: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """(N, P, 3): probe displacements (N, Q, 3) at the places of `compute_interpolation_at`'s weights (P, Q)."""
    return (
        (weights @ displacement.swapaxes(0, 1).reshape(displacement.shape[1], -1))
        .reshape(len(weights), -1, 3)
        .swapaxes(0, 1)
    )


def project_tips(values: SensorValues, sensor: Sensor, size: int, tips: np.ndarray) -> np.ndarray:
    """(..., 2) px from the middle of an image of `size`, of tips (..., 3) mm."""
    return (
        np.asarray(project(values.camera(size), jnp.asarray(tips), values.sensor(sensor)))
        - (size - 1) / 2
    )


def predict_positions(
    values: SensorValues, sensor: Sensor, size: int, moved: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Pins (N, P, 2) px of an image of `size` from its middle for probe displacements (N, Q, 3), and (P, 2) undisturbed ones."""
    own = values.sensor(sensor)
    tips = compute_pin_tips(own)
    rest = project_tips(values, sensor, size, tips)
    if moved is None:
        return rest[None], rest
    alike = replace(
        own, gel_modulus_mpa=sensor.gel_modulus_mpa
    )  # one entry of the cache for all stiffnesses
    return project_tips(
        values, sensor, size, tips + interpolate_displacements(compute_interpolation(alike), moved)
    ), rest
