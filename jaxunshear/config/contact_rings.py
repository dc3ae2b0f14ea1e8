"""Where on a sensor's face a contact is solved, and how deep it may go.

A contact is solved at points on rings, evenly spaced along the face from the apex.
"""

import math

import numpy as np

from jaxunshear.config.sensor import Pad, Sensor

RING_MM = 1.0  # spacing along the surface
COVERED_ANGLE_DEG = 60.0
# A node can touch if the undeformed dome there lies below this share of the depth, because the skin
# yields before the rest arrives. With it, one of 128 slides over all shapes had to be solved again,
# and pins differ from those with many more nodes by 0.04 px rms.
REACHED_SHARE = 0.7
# rings beside the apex: larger faces get wider spacing, small ones narrower
MIN_RINGS, MAX_RINGS = 8, 21
PRESSED_SHARE = 1 / 3  # of a pad's thickness: deeper contacts are not simulated


def compute_ring_spacing(sensor: Sensor) -> float:
    """Compute the arc between neighbouring rings in mm."""
    covered = _compute_covered_mm(sensor)
    # a sensor of benchmarks has a spacing of its own
    spacing = getattr(sensor, "ring_mm", max(RING_MM, covered / MAX_RINGS))
    spacing = min(spacing, covered / MIN_RINGS)
    # the hats of the last ring end at a pad's rim
    return covered / round(covered / spacing) if sensor.is_flat else spacing


def compute_ring_arcs(sensor: Sensor) -> np.ndarray:
    """Compute the arc from the apex to each ring in mm, (rings,); the apex is the first."""
    spacing = compute_ring_spacing(sensor)
    last = round(_compute_covered_mm(sensor) / spacing)
    return spacing * np.arange(last + 1 - sensor.is_flat)


def _compute_covered_mm(sensor: Sensor) -> float:
    """Compute the arc from the apex over which contacts are solved."""
    if sensor.is_flat:
        return sensor.rim_mm
    return sensor.dome_radius_mm * math.radians(COVERED_ANGLE_DEG)


def compute_contact_angle(sensor: Sensor) -> float:
    """Compute the tilt in degrees from which on no contact can be simulated.

    On a dome it is the angle from the apex to the last ring. The rim of a pad is then pressed by
    `PRESSED_SHARE` of its thickness before its middle is touched.
    """
    if isinstance(sensor, Pad):
        return math.degrees(math.asin(PRESSED_SHARE * sensor.pad_mm / sensor.pad_radius_mm))
    return math.degrees(float(compute_ring_arcs(sensor)[-1]) / sensor.dome_radius_mm)


def compute_max_depth_mm(sensor: Sensor, tilt_deg: float = 0.0) -> float:
    """Compute the depth at which the tilted undeformed sphere would touch at its last ring.

    For a pad it is the depth of the middle at which the rim is pressed by `PRESSED_SHARE` of the
    thickness; beyond `compute_contact_angle` it is negative.
    """
    if isinstance(sensor, Pad):
        lowered = sensor.pad_radius_mm * math.sin(math.radians(min(abs(tilt_deg), 90.0)))
        return PRESSED_SHARE * sensor.pad_mm - lowered
    covered = max(compute_contact_angle(sensor) - abs(tilt_deg), 0.0)
    return sensor.dome_radius_mm * (1 - math.cos(math.radians(covered)))


def compute_max_contact_depth_mm(sensor: Sensor, tilt_deg: float = 0.0) -> float:
    """Compute the depth of the deepest contact that is simulated.

    The skin yields, so tilted contacts of a dome may go deeper than the undeformed sphere could.
    """
    if sensor.is_flat:
        return compute_max_depth_mm(sensor, tilt_deg)
    return min(compute_max_depth_mm(sensor), compute_max_depth_mm(sensor, tilt_deg) / REACHED_SHARE)


def compute_reach_mm(sensor: Sensor, depth_mm: float) -> float:
    """Compute how far from its axis the undeformed face still lies below `depth_mm`."""
    if sensor.is_flat:
        return sensor.rim_mm
    return math.sqrt(max(2 * sensor.dome_radius_mm * depth_mm - depth_mm**2, 0.0))
