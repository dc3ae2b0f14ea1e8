"""Pin error of every kind of image against the true pins of its tap.

A lattice shifted by a full pitch matches itself again but for its rim, so missed and extra pins belong to the figure,
and `true_slide`, from known identities, says how far the pins of the sheared images really are from the tap's.
"""

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from jaxunshear.metrics.pins import pin_error


def pin_errors(
    images: Mapping[str, np.ndarray], tap_pins: np.ndarray, sheared_pins: np.ndarray, mm_per_px: float
) -> dict[str, dict[str, float]]:
    """Root-mean-square distance of matched pins in px and mm, missed and extra pins an image, by kind of image. A mm is one at the
    height of the apex' pin: pins of the rim, nearer to the camera, move by less than it says (`tactip331-fitted`: a tenth).

    `images`: (N, S, S) uint8, binarised here at half of full scale; pins: (N, P, 2) true (column, row) in px. Partners
    lie within half the tap's pitch. NaN where no pin found a partner.
    """
    limit = half_pitch(tap_pins)
    found = {}
    for kind, stack in images.items():
        error = pin_error(np.where(stack >= 128, 255, 0).astype(np.uint8), tap_pins, mm_per_px, limit)
        found[kind] = {
            "rms_px": float(error.rms_px),
            "rms_mm": float(error.rms_mm),
            "missed_per_image": float(error.missed),
            "extra_per_image": float(error.extra),
        }
    squares = np.sum(np.square(sheared_pins.astype(np.float64) - tap_pins), axis=-1)
    slide = float(np.sqrt(squares.mean()))
    found["true_slide"] = {"rms_px": slide, "rms_mm": slide * mm_per_px}
    return found


def half_pitch(pins: np.ndarray) -> float:
    """Half of the median distance, px, of pins (N, P, 2) from the nearest neighbour in their image."""
    nearest = [cKDTree(points).query(points, k=2)[0][:, 1] for points in pins]
    return 0.5 * float(np.median(nearest))
