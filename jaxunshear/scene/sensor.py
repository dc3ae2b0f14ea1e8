"""The soft optical tactile sensor: a gel dome under a skin, with pins watched by a camera.

Sensor frame: origin at the apex of the undeformed dome, z from the apex towards the camera, x and y lateral; mm.
"""

from dataclasses import dataclass

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
SENSORS = {sensor.name: sensor for sensor in (TACTIP_331, TACTIP_127)}


def sensor_named(name: str) -> Sensor:
    if name not in SENSORS:
        raise UserError(f"sensor '{name}' is unknown: use one of {', '.join(SENSORS)}")
    return SENSORS[name]


def pin_lattice(sensor: Sensor) -> np.ndarray:
    """Pins of the flattened dome, (P, 2) in mm of arc from the apex; ring by ring, each counter-clockwise from +x."""
    points = [np.zeros((1, 2))]
    for ring in range(1, sensor.rings + 1):
        turn = np.arange(6 * ring) / (6 * ring)
        if sensor.layout == "rings":
            angle = 2 * np.pi * turn
            points.append(ring * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
        elif sensor.layout == "hexagonal":
            corners = np.stack([np.cos(np.arange(7) * np.pi / 3), np.sin(np.arange(7) * np.pi / 3)], axis=-1)
            side, along = np.divmod(6 * turn, 1.0)
            side = side.astype(int)
            points.append(ring * (corners[side] * (1 - along)[:, None] + corners[side + 1] * along[:, None]))
        else:
            raise UserError(f"sensor.layout '{sensor.layout}' is unknown: use 'rings' or 'hexagonal'")
    return sensor.pin_spacing_mm * np.concatenate(points)


def pin_tips(sensor: Sensor) -> np.ndarray:
    """Undeformed pin tips, (P, 3) in mm in the sensor frame: they stand on the skin's inner face, along the normal."""
    flat = pin_lattice(sensor)
    arc = np.linalg.norm(flat, axis=-1)
    reach = sensor.dome_radius_mm * np.pi / 2
    if arc.max() >= reach:
        raise UserError(
            f"sensor '{sensor.name}': rings x pin_spacing_mm = {arc.max():g} mm goes past the dome's rim at {reach:.1f} mm"
        )
    angle = arc / sensor.dome_radius_mm
    direction = np.divide(flat, arc[:, None], out=np.zeros_like(flat), where=arc[:, None] > 0)
    radius = sensor.dome_radius_mm - sensor.skin_mm - sensor.pin_length_mm
    lateral = radius * np.sin(angle)[:, None] * direction
    return np.concatenate([lateral, (sensor.dome_radius_mm - radius * np.cos(angle))[:, None]], axis=-1)
