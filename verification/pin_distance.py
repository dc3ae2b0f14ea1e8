"""Distances between two solutions for pins, in mm and in px of the default camera."""

from typing import NamedTuple

import numpy as np

from jaxunshear.config.sensor import Camera, Sensor
from jaxunshear.simulator.camera import project


class PinError(NamedTuple):
    """Errors over all pins of all contacts; px are those of the camera's 256-px frame."""

    rms_px: float
    p95_px: float
    max_px: float
    rms_mm: float
    p95_mm: float


def compute_pin_distance(sensor: Sensor, pins: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Compute the distances (..., P) in px between pins (..., P, 3) mm and `others`."""

    def project_px(tips: np.ndarray) -> np.ndarray:
        return np.asarray(project(Camera(), np.asarray(tips, np.float64), sensor))

    return np.linalg.norm(project_px(pins) - project_px(others), axis=-1)


def compute_pin_error(sensor: Sensor, pins: np.ndarray, others: np.ndarray) -> PinError:
    """Compute the error of pins (..., P, 3) mm against `others`; NaN if any is not finite."""
    px = compute_pin_distance(sensor, pins, others)
    mm = np.linalg.norm(np.asarray(pins, np.float64) - others, axis=-1)
    if not px.size:
        return PinError(*(0.0,) * 5)
    if not np.isfinite(px).all():
        return PinError(*(np.nan,) * 5)
    p95 = [float(np.percentile(error, 95)) for error in (px, mm)]
    rms = [float(np.sqrt(np.mean(error**2))) for error in (px, mm)]
    return PinError(rms[0], p95[0], float(px.max()), rms[1], p95[1])
