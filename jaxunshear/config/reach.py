"""Where a sensor's contact rings lie, and how deep a contact they cover.

Rings are evenly spaced along the dome's surface, from the apex to about 60 degrees from it. This
module imports neither JAX nor SciPy, because the command line needs it at once.
"""

import math
from dataclasses import asdict, dataclass

import numpy as np

from jaxunshear.config.sensor import Sensor

RING_MM = 1.0  # spacing along the surface
COVERED_ANGLE_DEG = 60.0
# A node can touch if the undeformed dome there lies below this share of the depth, because the skin
# yields before the rest arrives. With it, one of 128 slides over all shapes had to be solved again,
# and pins differ from those with many more nodes by 0.04 px rms.
REACHED_SHARE = 0.7
# rings beside the apex: larger domes get wider spacing, small ones narrower
MIN_RINGS, MAX_RINGS = 8, 21


@dataclass(frozen=True)
class RingSpacedSensor(Sensor):
    """A sensor whose contact rings have a spacing that does not follow from its size."""

    ring_mm: float = RING_MM


def set_ring_spacing(sensor: Sensor, ring_mm: float) -> Sensor:
    """Return the sensor with rings of this spacing, which its name then says."""
    if ring_mm == compute_ring_spacing(sensor):
        return sensor
    return RingSpacedSensor(
        **asdict(sensor) | {"name": f"{sensor.name}-{ring_mm:g}mm"}, ring_mm=ring_mm
    )


def compute_ring_spacing(sensor: Sensor) -> float:
    """Compute the arc between neighbouring rings in mm."""
    covered = sensor.dome_radius_mm * math.radians(COVERED_ANGLE_DEG)
    usual = max(RING_MM, covered / MAX_RINGS)
    spacing = sensor.ring_mm if isinstance(sensor, RingSpacedSensor) else usual
    return min(spacing, covered / MIN_RINGS)


def compute_ring_arcs(sensor: Sensor) -> np.ndarray:
    """Compute the arc from the apex to each ring in mm, (rings,); the apex is the first."""
    spacing = compute_ring_spacing(sensor)
    last = round(sensor.dome_radius_mm * math.radians(COVERED_ANGLE_DEG) / spacing)
    return spacing * np.arange(last + 1)


def compute_contact_angle(sensor: Sensor) -> float:
    """Compute the angle from the apex to the last ring in degrees."""
    return math.degrees(float(compute_ring_arcs(sensor)[-1]) / sensor.dome_radius_mm)


def compute_max_depth_mm(sensor: Sensor, tilt_deg: float = 0.0) -> float:
    """Compute the depth at which the tilted undeformed sphere would touch at its last ring."""
    covered = max(compute_contact_angle(sensor) - abs(tilt_deg), 0.0)
    return sensor.dome_radius_mm * (1 - math.cos(math.radians(covered)))


def compute_max_contact_depth_mm(sensor: Sensor, tilt_deg: float = 0.0) -> float:
    """Compute the depth of the deepest contact that is simulated.

    The skin yields, so tilted contacts may go deeper than the undeformed sphere could.
    """
    return min(compute_max_depth_mm(sensor), compute_max_depth_mm(sensor, tilt_deg) / REACHED_SHARE)


def compute_reach_mm(sensor: Sensor, depth_mm: float) -> float:
    """Compute how far from its axis the undeformed dome still lies below `depth_mm`."""
    return math.sqrt(max(2 * sensor.dome_radius_mm * depth_mm - depth_mm**2, 0.0))
