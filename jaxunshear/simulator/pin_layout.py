"""Where the pins of a sensor stand, in its frame."""

import numpy as np
from jaxtyping import Float

from jaxunshear.config.sensor import Sensor, check_sensor


def compute_pin_lattice(sensor: Sensor) -> Float[np.ndarray, "P 2"]:
    """Compute the pins' places on the flattened dome, in mm of arc from the apex.

    Raises `UserError` for a sensor that cannot be.
    """
    check_sensor(sensor)
    return sensor.place_pins()


def compute_pin_tips(sensor: Sensor) -> Float[np.ndarray, "P 3"]:
    """Compute the undeformed pin tips in mm of the sensor frame.

    Pins stand on the skin's inner face, along the normal. Raises `UserError` for a sensor that
    cannot be.
    """
    return compute_tips_at(sensor, compute_pin_lattice(sensor))


def compute_tips_at(sensor: Sensor, flat: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 3"]:
    """Compute the undeformed tips in mm of pins that stand anywhere, at `flat` mm of arc."""
    inner = sensor.dome_radius_mm - sensor.skin_mm - sensor.pin_length_mm
    return (
        sensor.dome_radius_mm * np.array([0, 0, 1.0])
        + _compute_outward_normals(sensor, flat) * inner
    )


def compute_pin_levers(sensor: Sensor) -> Float[np.ndarray, "P 3"]:
    """Compute the vector in mm from each pin's foot on the skin's inner face to its tip."""
    return -sensor.pin_length_mm * _compute_outward_normals(sensor, compute_pin_lattice(sensor))


def _compute_outward_normals(sensor: Sensor, flat: np.ndarray) -> np.ndarray:
    """Compute the outward unit normals (P, 3) of the dome at `flat` (P, 2) mm of arc."""
    arc = np.linalg.norm(flat, axis=-1)
    angle = arc / sensor.dome_radius_mm
    direction = np.divide(flat, arc[:, None], out=np.zeros_like(flat), where=arc[:, None] > 0)
    return np.concatenate([np.sin(angle)[:, None] * direction, -np.cos(angle)[:, None]], axis=-1)
