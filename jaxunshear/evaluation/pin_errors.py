"""Pin error of every kind of image against the true pins of its tap.

A lattice shifted by a full pitch matches itself again but for its rim, so missed and extra pins belong to the figure,
and `true_slide`, from known identities, says how far the pins of the sheared images really are from the tap's.
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
    """Root-mean-square distance of matched pins in px and mm, missed and extra pins an image, by kind of image. A mm is one at the
    height of the apex' pin: pins of the rim, nearer to the camera, move by less than it says (`tactip331-fitted`: a tenth). None of these
    where `mm_per_px` is not known.

    `images`: (N, S, S) uint8; pins: (N, P, 2) true (column, row) in px. Partners
    lie within half the tap's pitch. NaN where no pin found a partner.
    """
    limit = compute_half_pitch(tap_pins)
    found = {kind: measure_pin_error(stack, tap_pins, limit) for kind, stack in images.items()}
    squares = np.sum(np.square(sheared_pins.astype(np.float64) - tap_pins), axis=-1)
    found["true_slide"] = {"rms_px": float(np.sqrt(squares.mean()))}
    return {
        kind: {
            "rms_px": row["rms_px"],
            "rms_mm": None if mm_per_px is None else row["rms_px"] * mm_per_px,
            **row,
        }
        for kind, row in found.items()
    }


def compute_half_pitch(pins: np.ndarray) -> float:
    """Half of the median distance, px, of pins (N, P, 2) from the nearest neighbour in their image."""
    nearest = [cKDTree(points).query(points, k=2)[0][:, 1] for points in pins]
    return 0.5 * float(np.median(nearest))
