"""Calibrated values of the sensor, and simulated pins of contacts as smooth functions of them.

calibration = read_calibration(Path("runs/calibration/calibration.json"))

A contact is solved once, for the pins of a probe: a lattice that is finer and wider than the
sensor's. The motion of the sensor's own pins is interpolated from it. So the spacing of the pins
and the camera can be fitted without a new simulation.
"""

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxunshear.calibration.labels import EDGE_STIMULUS, LabelledMotions, make_paths
from jaxunshear.config.contact_rings import compute_max_depth_mm
from jaxunshear.config.sensor import (
    FITTED_CAMERA,
    FITTED_FRICTION,
    TACTIP_331_FITTED,
    Camera,
    Sensor,
    check_sensor,
)
from jaxunshear.errors import UserError
from jaxunshear.files import Json, read_object
from jaxunshear.simulator.camera import project
from jaxunshear.simulator.paths import DEPTH, TILT_X, Paths
from jaxunshear.simulator.pin_layout import compute_pin_tips, compute_tips_at
from jaxunshear.simulator.simulate import follow

PROBE_DEG = 5.0  # between the probe's rings
PROBE_RINGS = 14  # to 70 degrees
MAX_ANGLE_DEG = 68.0  # from the apex; pins that appear farther out are placed there
POSITION_ROUNDS = 3  # in which rest positions follow from the mean of the touched pins


@dataclass(frozen=True)
class SensorValues:
    """The values that are calibrated, and the sensor `base` that has all others.

    `surface_mm` is a nuisance of each group of images: the height of the object's top in its
    labels.
    """

    base: Sensor
    mm_across: float
    distance_mm: float
    pin_spacing_mm: float
    friction: float
    skin_to_gel: float  # ratio of the moduli
    surface_mm: tuple[float, ...] = ()
    housing: float = Camera.housing

    def camera(self, frame_px: int) -> Camera:
        return Camera(frame_px, self.mm_across, self.distance_mm, self.housing)

    @property
    def sensor(self) -> Sensor:
        return replace(
            self.base,
            pin_spacing_mm=self.pin_spacing_mm,
            gel_modulus_mpa=self.base.skin_modulus_mpa / self.skin_to_gel,
        )


def make_values(sensor: Sensor, camera: Camera, friction: float) -> SensorValues:
    return SensorValues(
        sensor,
        camera.mm_across,
        camera.distance_mm,
        sensor.pin_spacing_mm,
        friction,
        sensor.skin_modulus_mpa / sensor.gel_modulus_mpa,
        housing=camera.housing,
    )


@dataclass(frozen=True)
class Calibration:
    """A calibrated simulator.

    `image_names` are the images that it was fitted to, below the folder of all recordings; None
    for those of the preset.
    """

    name: str
    sensor: Sensor
    camera: Camera
    friction: float
    image_names: tuple[str, ...] | None = None

    @property
    def values(self) -> SensorValues:
        return make_values(self.sensor, self.camera, self.friction)

    @property
    def preset(self) -> Json:
        """Fields of `Sensor` and `Camera` and the friction, as `read_calibration` reads them."""
        return {
            "sensor": asdict(self.sensor),
            "camera": asdict(self.camera),
            "friction": self.friction,
        }


DEFAULT_CALIBRATION = Calibration(
    f"preset {TACTIP_331_FITTED.name}", TACTIP_331_FITTED, FITTED_CAMERA, FITTED_FRICTION
)


def read_calibration(file: Path) -> Calibration:
    """Read a `calibration.json` of `jaxunshear calibrate`. Raises `UserError` if it is none."""
    content = read_object(file)
    try:
        preset = content["preset"]
        sensor, camera = Sensor(**preset["sensor"]), Camera(**preset["camera"])
        friction = float(preset["friction"])
        image_names = tuple(str(name) for name in content.get("image_names", ()))
        check_sensor(sensor)
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"--calibration {file}: {type(error).__name__} {error}: "
            "give a calibration.json of `jaxunshear calibrate --out`"
        ) from None
    return Calibration(f"calibration {file.name}", sensor, camera, friction, image_names)


def _compute_probe_spacing(sensor: Sensor) -> float:
    return sensor.dome_radius_mm * math.radians(PROBE_DEG)


def make_probe_sensor(sensor: Sensor) -> Sensor:
    """Make a dome like the sensor's with the pins of the probe."""
    spacing = _compute_probe_spacing(sensor)
    return replace(
        sensor,
        name=f"{sensor.name}-probe",
        layout="rings",
        rings=PROBE_RINGS,
        pin_spacing_mm=spacing,
        pin_radius_mm=min(sensor.pin_radius_mm, 0.4 * spacing),  # pins may not overlap
    )


def compute_interpolation(sensor: Sensor, flat: np.ndarray) -> np.ndarray:
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


class SolvedContacts(NamedTuple):
    """The pins of N simulated contacts."""

    tips: np.ndarray  # (N, P, 3) mm, undisturbed in contacts that are out of reach
    converged: np.ndarray  # (N,) bool


def solve_contacts(sensor: Sensor, paths: Paths) -> SolvedContacts:
    """Simulate the contacts that are within reach of the sensor, with an edge."""
    tips = np.repeat(compute_pin_tips(sensor)[None], len(paths), axis=0)
    converged = np.zeros(len(paths), bool)
    reachable = np.flatnonzero(is_within_reach(sensor, paths))
    if len(reachable):
        solved, _ = follow(sensor, (EDGE_STIMULUS,), paths.take(reachable))
        tips[reachable], converged[reachable] = solved.pins, solved.converged
    return SolvedContacts(tips, converged)


def simulate_displacements(
    values: SensorValues,
    contacts: LabelledMotions,
    side: int,
    surface_mm: float = 0.0,
    friction: np.ndarray | None = None,
) -> np.ndarray:
    """Simulate the displacements (N, Q, 3) mm of the probe's pins.

    NaN for contacts that are out of reach or did not converge. `friction` (N,) replaces that of the
    values.
    """
    probe = make_probe_sensor(values.sensor)
    paths = make_paths(
        contacts, probe, surface_mm, side, values.friction if friction is None else friction
    )
    tips, converged = solve_contacts(probe, paths)
    displacement = tips.astype(np.float32) - compute_pin_tips(probe).astype(np.float32)
    return np.where(converged[:, None, None], displacement, np.nan)


def find_solutions(displacement: np.ndarray) -> np.ndarray:
    """Find the contacts (N,) bool whose displacement (N, Q, 3) is known."""
    return np.isfinite(displacement[:, 0, 0])


def is_within_reach(sensor: Sensor, paths: Paths) -> np.ndarray:
    """Mark the contacts (N,) that the sensor's contact rings cover at every way point."""
    tilt = np.linalg.norm(paths.points[..., TILT_X:], axis=-1)
    compute_depths = np.vectorize(
        lambda degrees: compute_max_depth_mm(sensor, degrees), otypes=[float]
    )
    return np.all(paths.points[..., DEPTH] <= compute_depths(tilt), axis=1)


def project_tips(values: SensorValues, size: int, tips: np.ndarray) -> np.ndarray:
    """Project tips (..., 3) mm to (..., 2) px from the middle of an image of `size`."""
    pixels = project(values.camera(size), jnp.asarray(tips), values.sensor)
    return np.asarray(pixels) - (size - 1) / 2


def project_rest(values: SensorValues, size: int, flat: np.ndarray) -> np.ndarray:
    """Project undisturbed pins at `flat` (P, 2) mm of arc to (P, 2) px from the middle."""
    return project_tips(values, size, compute_tips_at(values.sensor, flat))


def project_positions(
    values: SensorValues, size: int, flat: np.ndarray, displacement: np.ndarray
) -> np.ndarray:
    """Project pins at `flat` (P, 2) mm of arc to (N, P, 2) px from the middle of the image.

    `displacement` (N, Q, 3) mm is that of the probe's pins.
    """
    weights = compute_interpolation(values.base, flat)
    by_pin = displacement.swapaxes(0, 1).reshape(displacement.shape[1], -1)
    shift = (weights @ by_pin).reshape(len(flat), -1, 3).swapaxes(0, 1)
    return project_tips(values, size, compute_tips_at(values.sensor, flat) + shift)


def locate_pins(values: SensorValues, size: int, rest: np.ndarray) -> np.ndarray:
    """Locate pins on the dome (P, 2), mm of arc from the apex.

    `rest` (P, 2) are their untouched positions, px from the middle of the image.
    """
    angle = np.radians(np.linspace(0, MAX_ANGLE_DEG, 500))
    line = np.stack([angle * values.base.dome_radius_mm, np.zeros_like(angle)], -1)
    radius = np.linalg.norm(rest, axis=-1)
    arc = np.interp(radius, project_rest(values, size, line)[:, 0], line[:, 0])
    return rest * np.divide(arc, radius, out=np.zeros_like(arc), where=radius > 0)[:, None]


def fit_positions(
    values: SensorValues, size: int, recorded: np.ndarray, displacement: np.ndarray
) -> np.ndarray:
    """Fit positions on the dome (P, 2) mm of arc to pins recorded at (N, P, 2) px.

    The phases of real rings differ from those of the layout. The simulated contacts say how far the
    pins' mean over the contacts is from their rest position.
    """
    mean = np.nanmean(recorded, axis=0)
    flat = locate_pins(values, size, mean)
    for _ in range(POSITION_ROUNDS):
        simulated = project_positions(values, size, flat, displacement)
        moved = np.mean(simulated, axis=0) - project_rest(values, size, flat)
        flat = locate_pins(values, size, mean - moved)
    return flat


def compute_mm_per_px(values: SensorValues, size: int, flat: np.ndarray) -> np.ndarray:
    """Compute the scale (P,) at the height of each untouched pin."""
    height, apex = compute_tips_at(values.sensor, flat)[:, 2], compute_pin_tips(values.sensor)[0, 2]
    return values.mm_across / size * (values.distance_mm - height) / (values.distance_mm - apex)
