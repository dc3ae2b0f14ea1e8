"""The soft optical tactile sensor: a gel dome under a skin, with pins watched by a camera.

Sensor frame: origin at the apex of the undeformed dome, z from the apex towards the camera, x and y lateral; mm.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from jaxunshear.errors import UserError


@dataclass(frozen=True)
class Sensor:
    """A TacTip (Ward-Cherrier et al. 2018, Soft Robotics 5(2)).

    The paper's "40 mm radius" is the diameter given elsewhere for the same dome, hence `dome_radius_mm = 20`. The moduli
    are those of Tango Black+ (Shore A 27, about 1 MPa) and a soft silicone gel; only their ratio moves a pin.
    """

    name: str = "tactip331"
    layout: str = "rings"  # "rings": 1 + 6 + 12 + ... pins; "hexagonal": a triangular lattice cut to a hexagon
    rings: int = 10
    pin_spacing_mm: float = 1.5  # between neighbouring rings, along the dome
    pin_radius_mm: float = 0.45
    pin_length_mm: float = 1.0  # from the skin's inner face to the white tip
    dome_radius_mm: float = 20.0
    skin_mm: float = 1.0
    skin_modulus_mpa: float = 1.0
    gel_modulus_mpa: float = 0.1
    skin_poisson: float = 0.49
    gel_poisson: float = 0.49

    @property
    def pins(self) -> int:
        return 1 + 3 * self.rings * (self.rings + 1)


TACTIP_331 = Sensor()
TACTIP_127 = Sensor(name="tactip127", layout="hexagonal", rings=6, pin_spacing_mm=2.4, pin_radius_mm=0.6)
# Pins that end where they stand: they show where the skin moves, but not how it turns.
TACTIP_331_FLUSH = replace(TACTIP_331, name="tactip331-flush", pin_length_mm=0.0)
# Fitted by `jaxunshear calibrate` to 200 contacts of a real TacTip with an edge (docs/results/calibrate_edge_2d.json).
TACTIP_331_FITTED = replace(
    TACTIP_331, name="tactip331-fitted", pin_spacing_mm=2.18, pin_radius_mm=0.511, gel_modulus_mpa=0.00702
)
FITTED_FRICTION = 0.386  # of that skin on that edge
LAYOUTS = ("rings", "hexagonal")
SENSORS = {sensor.name: sensor for sensor in (TACTIP_331, TACTIP_127, TACTIP_331_FLUSH, TACTIP_331_FITTED)}


def sensor_named(name: str) -> Sensor:
    if name not in SENSORS:
        raise UserError(f"sensor '{name}' is unknown: use one of {', '.join(SENSORS)}")
    return SENSORS[name]


def sensor_rules(sensor: Sensor) -> Iterator[tuple[bool, str, str]]:
    """(holds, field, what is wrong and what to do instead); later rules may rely on earlier ones."""
    yield sensor.layout in LAYOUTS, "layout", f"use one of {', '.join(LAYOUTS)}"
    yield 1 <= sensor.rings <= 50, "rings", "use 1 to 50"
    for field in (
        "pin_spacing_mm",
        "pin_radius_mm",
        "dome_radius_mm",
        "skin_mm",
        "skin_modulus_mpa",
        "gel_modulus_mpa",
    ):
        yield 0 < getattr(sensor, field) < math.inf, field, "must be above zero, and finite"
    yield 0 <= sensor.pin_length_mm < math.inf, "pin_length_mm", "must not be below zero, and finite"
    for field in ("skin_poisson", "gel_poisson"):
        yield 0 <= getattr(sensor, field) < 0.5, field, "use 0 up to, but not, 0.5 (exactly incompressible)"
    yield (
        2 * sensor.pin_radius_mm < sensor.pin_spacing_mm,
        "pin_radius_mm",
        f"pins {sensor.pin_spacing_mm:g} mm apart would overlap: use less than half of that",
    )
    yield (
        sensor.skin_mm + sensor.pin_length_mm < sensor.dome_radius_mm,
        "dome_radius_mm",
        "must exceed skin_mm + pin_length_mm",
    )
    rim = sensor.dome_radius_mm * math.pi / 2
    yield (
        sensor.rings * sensor.pin_spacing_mm < rim,
        "rings",
        f"{sensor.pin_spacing_mm:g} mm apart, they go past the dome's rim at {rim:.1f} mm: use fewer or closer rings",
    )


def check_sensor(sensor: Sensor) -> None:
    """Raises `UserError` that names the first field that cannot be."""
    for holds, field, remedy in sensor_rules(sensor):
        if not holds:
            raise UserError(f"sensor '{sensor.name}': {field} = {getattr(sensor, field)}: {remedy}")


def pin_lattice(sensor: Sensor) -> np.ndarray:
    """Pins of the flattened dome, (P, 2) in mm of arc from the apex; ring by ring, each counter-clockwise from +x."""
    points = [np.zeros((1, 2))]
    for ring in range(1, sensor.rings + 1):
        turn = np.arange(6 * ring) / (6 * ring)
        if sensor.layout == "rings":
            angle = 2 * np.pi * turn
            points.append(ring * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
        else:
            corners = np.stack([np.cos(np.arange(7) * np.pi / 3), np.sin(np.arange(7) * np.pi / 3)], axis=-1)
            side, along = np.divmod(6 * turn, 1.0)
            side = side.astype(int)
            points.append(ring * (corners[side] * (1 - along)[:, None] + corners[side + 1] * along[:, None]))
    return sensor.pin_spacing_mm * np.concatenate(points)


def pin_tips(sensor: Sensor) -> np.ndarray:
    """Undeformed pin tips, (P, 3) in mm in the sensor frame: they stand on the skin's inner face, along the normal.

    Raises `UserError` for a sensor that cannot be.
    """
    check_sensor(sensor)
    return sensor.dome_radius_mm * np.array([0, 0, 1.0]) + _outwards(sensor) * (
        sensor.dome_radius_mm - sensor.skin_mm - sensor.pin_length_mm
    )


def pin_levers(sensor: Sensor) -> np.ndarray:
    """(P, 3) mm from where each pin stands on the skin's inner face to its tip: along the normal, inwards."""
    return -sensor.pin_length_mm * _outwards(sensor)


def _outwards(sensor: Sensor) -> np.ndarray:
    """Outward unit normals of the dome above the pins, (P, 3)."""
    flat = pin_lattice(sensor)
    arc = np.linalg.norm(flat, axis=-1)
    angle = arc / sensor.dome_radius_mm
    direction = np.divide(flat, arc[:, None], out=np.zeros_like(flat), where=arc[:, None] > 0)
    return np.concatenate([np.sin(angle)[:, None] * direction, -np.cos(angle)[:, None]], axis=-1)
