"""Where a sensor's contact rings stand, and how deep a contact they cover. Imports neither JAX nor SciPy.

Rings are evenly spaced along the dome's surface, from the apex to about 60 degrees from it.
"""

import math
from dataclasses import asdict, dataclass

import numpy as np

from jaxunshear.config.sensor import Sensor

RING_MM = 1.0  # apart, along the surface
COVERED_ANGLE_DEG = 60.0
# A node can touch if the undeformed dome there lies below this share of the depth: the skin yields before the rest arrives.
# Of 128 slides over all shapes one had to be solved again, and pins differ from those with many more nodes by 0.04 px rms.
REACHED_SHARE = 0.7
FEWEST, MOST = 8, 21  # rings beside the apex: larger domes get wider rings, small ones narrower


@dataclass(frozen=True)
class RingSpacedSensor(Sensor):
    """A sensor whose contact rings stand further apart, or closer, than its size asks for."""

    ring_mm: float = RING_MM


def set_ring_spacing(sensor: Sensor, ring_mm: float) -> Sensor:
    """The same sensor on rings of that spacing, under a name of its own."""
    if ring_mm == compute_ring_spacing(sensor):
        return sensor
    return RingSpacedSensor(
        **asdict(sensor) | {"name": f"{sensor.name}-{ring_mm:g}mm"}, ring_mm=ring_mm
    )


def compute_ring_spacing(sensor: Sensor) -> float:
    """Arc between neighbouring rings in mm."""
    covered = sensor.dome_radius_mm * math.radians(COVERED_ANGLE_DEG)
    wanted = (
        sensor.ring_mm if isinstance(sensor, RingSpacedSensor) else max(RING_MM, covered / MOST)
    )
    return min(wanted, covered / FEWEST)


def compute_ring_arcs(sensor: Sensor) -> np.ndarray:
    """Arc from the apex to each ring in mm, (rings,); the apex is the first."""
    spacing = compute_ring_spacing(sensor)
    last = round(sensor.dome_radius_mm * math.radians(COVERED_ANGLE_DEG) / spacing)
    return spacing * np.arange(last + 1)


def compute_contact_angle(sensor: Sensor) -> float:
    """Degrees from the apex to the last ring."""
    return math.degrees(float(compute_ring_arcs(sensor)[-1]) / sensor.dome_radius_mm)


def compute_max_depth_mm(sensor: Sensor, tilt_deg: float = 0.0) -> float:
    """The depth at which the undeformed sphere's circle of contact, tilted, reaches the last ring."""
    covered = max(compute_contact_angle(sensor) - abs(tilt_deg), 0.0)
    return sensor.dome_radius_mm * (1 - math.cos(math.radians(covered)))


def compute_max_contact_depth_mm(sensor: Sensor, tilt_deg: float = 0.0) -> float:
    """The deepest contact that is simulated; tilted ones may go on to where the skin, which yields, reaches the last ring."""
    return min(compute_max_depth_mm(sensor), compute_max_depth_mm(sensor, tilt_deg) / REACHED_SHARE)


def compute_reach_mm(sensor: Sensor, depth_mm: float) -> float:
    """Lateral reach of the undeformed dome below `depth_mm`."""
    return math.sqrt(max(2 * sensor.dome_radius_mm * depth_mm - depth_mm**2, 0.0))
