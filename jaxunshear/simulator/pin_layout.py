"""Where the pins of a sensor stand, in its frame; lengths along its face are arcs from the apex."""

import numpy as np
from jaxtyping import Float

from jaxunshear.config.sensor import Sensor, check_sensor


def compute_pin_lattice(sensor: Sensor) -> Float[np.ndarray, "P 2"]:
    """Compute the pins' places on the flattened face, in mm of arc from the apex.

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
    return _place_beneath_face(sensor, flat, sensor.skin_mm + sensor.pin_length_mm)


def compute_face_points(sensor: Sensor) -> Float[np.ndarray, "P 3"]:
    """Compute the points in mm of the undeformed outer face above the pins."""
    return _place_beneath_face(sensor, compute_pin_lattice(sensor), 0.0)


def _place_beneath_face(sensor: Sensor, flat: np.ndarray, below_mm: float) -> np.ndarray:
    """Place points (P, 3) `below_mm` beneath the face, at `flat` (P, 2) mm of arc."""
    if sensor.is_flat:
        return np.insert(flat, 2, below_mm, axis=-1)
    centre = np.array([0, 0, sensor.dome_radius_mm])
    return centre + compute_outward_normals(sensor, flat) * (sensor.dome_radius_mm - below_mm)


def compute_pin_levers(sensor: Sensor) -> Float[np.ndarray, "P 3"]:
    """Compute the vector in mm from each pin's foot on the skin's inner face to its tip."""
    return -sensor.pin_length_mm * compute_outward_normals(sensor, compute_pin_lattice(sensor))


def compute_outward_normals(
    sensor: Sensor, flat: Float[np.ndarray, "P 2"]
) -> Float[np.ndarray, "P 3"]:
    """Compute the outward unit normals of the face at `flat` mm of arc."""
    if sensor.is_flat:
        return np.tile([0, 0, -1.0], (len(flat), 1))
    arc = np.linalg.norm(flat, axis=-1)
    angle = arc / sensor.dome_radius_mm
    direction = np.divide(flat, arc[:, None], out=np.zeros_like(flat), where=arc[:, None] > 0)
    return np.concatenate([np.sin(angle)[:, None] * direction, -np.cos(angle)[:, None]], axis=-1)


def flatten_places(sensor: Sensor, places: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2"]:
    """Compute the arcs in mm of places on the undeformed face."""
    if sensor.is_flat:
        return places[:, :2]
    across = np.linalg.norm(places[:, :2], axis=-1)
    arc = sensor.dome_radius_mm * np.arctan2(across, sensor.dome_radius_mm - places[:, 2])
    return places[:, :2] * (arc / np.maximum(across, 1e-12))[:, None]
