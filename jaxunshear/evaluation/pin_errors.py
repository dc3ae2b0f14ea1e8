"""Pin error of every kind of image against the true pins of its tap.

A lattice shifted by a full pitch matches itself again except at its rim, so the error needs the
numbers of missed and extra pins. `true_slide` comes from the pins' identities: the distance between
the true pins of slides and taps.
"""

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from jaxunshear.metrics.pin_error import measure_pin_error


def measure_pin_errors(
    images: Mapping[str, np.ndarray],
    tap_pins: np.ndarray,
    sheared_pins: np.ndarray,
    mm_per_px: float | None,
) -> dict[str, dict[str, float | None]]:
    """Measure pin errors, and missed and extra pins per image, by kind of image.

    Detected and true pins match within half the tap's pitch; the error is NaN if none match. A mm
    is one at the height of the apex pin: pins of the rim, nearer to the camera, move by less
    (`tactip331-fitted`: by a tenth less).

    Args:
        images: (N, S, S) uint8 by kind.
        tap_pins: (N, P, 2) true (column, row), px.
        sheared_pins: (N, P, 2) likewise.
        mm_per_px: None if unknown; errors in mm are then None, too.
    """
    limit = compute_half_pitch(tap_pins)
    errors = {kind: measure_pin_error(stack, tap_pins, limit) for kind, stack in images.items()}
    squares = np.sum(np.square(sheared_pins.astype(np.float64) - tap_pins), axis=-1)
    errors["true_slide"] = {"rms_px": float(np.sqrt(squares.mean()))}
    rows: dict[str, dict[str, float | None]] = {}
    for kind, error in errors.items():
        rms_mm = None if mm_per_px is None else error["rms_px"] * mm_per_px
        rows[kind] = {"rms_px": error["rms_px"], "rms_mm": rms_mm, **error}
    return rows


def compute_half_pitch(pins: np.ndarray) -> float:
    """Compute half of the median distance, px, of pins (N, P, 2) from their nearest neighbour."""
    nearest = [cKDTree(points).query(points, k=2)[0][:, 1] for points in pins]
    return 0.5 * float(np.median(nearest))
