"""Errors of poses by target (jaxunshear/config/targets.py), and of pins in images.

Similarity of images does not change if the lattice of pins is shifted by a full pitch; the distance
of centroids that are matched one to one does.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from jaxunshear.angles import Values, wrap_degrees
from jaxunshear.config.targets import is_class
from jaxunshear.perception.pin_detection import detect_pin_centres


def compute_error(name: str, difference: Values) -> Values:
    """Compute the absolute error of a target from differences (B,); of a wrong class it is 1.

    Angles go the short way round. The error of NaN is NaN.
    """
    if is_class(name):
        return (difference != 0) + 0 * difference
    return abs(wrap_degrees(difference) if name.endswith("_deg") else difference)


def compute_pose_errors(
    predicted: Mapping[str, np.ndarray], true: Mapping[str, np.ndarray]
) -> dict[str, Float32[np.ndarray, "B"]]:
    """Compute the absolute errors of `predicted`, in the order of the labels.

    Angles wrap, so their errors are at most 180. The error of a wrong class is 1. Raises
    `ValueError` if a label is missing or lengths differ.
    """
    if unknown := predicted.keys() - true.keys():
        raise ValueError(f"pose quantity {min(unknown)!r} is missing")
    errors = {}
    for name in true:  # not of `predicted`: a compiled function sorts its outputs by name
        if name not in predicted:
            continue
        a, b = np.asarray(predicted[name], np.float64), np.asarray(true[name], np.float64)
        if a.shape != b.shape or a.ndim != 1:
            raise ValueError(f"{name}: shapes {a.shape} and {b.shape} are not one (B,)")
        errors[name] = compute_error(name, b - a).astype(np.float32)
    return errors


class PinMatch(NamedTuple):
    """Detected pins that are matched to true ones, one to one."""

    error_px: np.ndarray  # (K,) distances of the matches
    missed: int  # true pins without a match
    extra: int  # detected pins without a match


def match_pins(
    detected: Float[np.ndarray, "N 2"], true: Float[np.ndarray, "P 2"], limit_px: float
) -> PinMatch:
    """Match detected to true pins, px, within `limit_px`, by the least sum of squares."""
    if len(detected) == 0 or len(true) == 0:
        return PinMatch(np.zeros(0), len(true), len(detected))
    distance = np.linalg.norm(np.asarray(detected)[:, None] - np.asarray(true)[None], axis=-1)
    # All distances beyond the limit cost the same: an outlier must not change the other matches.
    rows, columns = linear_sum_assignment(np.minimum(distance, 2 * limit_px) ** 2)
    error = distance[rows, columns]
    error = error[error <= limit_px]
    return PinMatch(error, len(true) - len(error), len(detected) - len(error))


def measure_pin_error(
    images: UInt8[np.ndarray, "B S S"], true_px: Float[np.ndarray, "B P 2"], limit_px: float
) -> dict[str, float]:
    """Measure the distances of the pins that are detected in images from true ones.

    `rms_px` is the root mean square distance of pins, px as (column, row), that match within
    `limit_px`, NaN if none does; `missed_per_image` and `extra_per_image` count those without a
    match. Pixels from half of full scale on are white.
    """
    matches = [
        match_pins(detect_pin_centres(image), true, limit_px)
        for image, true in zip(images, true_px, strict=True)
    ]
    squares = np.concatenate([match.error_px for match in matches]) ** 2
    return {
        "rms_px": float(np.sqrt(squares.mean())) if squares.size else float("nan"),
        "missed_per_image": float(np.mean([match.missed for match in matches])),
        "extra_per_image": float(np.mean([match.extra for match in matches])),
    }


def measure_pin_errors(
    images: Mapping[str, np.ndarray],
    tap_pins: np.ndarray,
    sheared_pins: np.ndarray,
    mm_per_px: float | None,
) -> dict[str, dict[str, float | None]]:
    """Measure pin errors, and missed and extra pins per image, by kind of image.

    Detected and true pins match within half the median pitch. A lattice shifted by a full pitch
    matches itself again except at its rim, so the error needs the numbers of missed and extra pins.
    `true_slide` is the distance of the true pins of slides and taps. A mm is one at the height of
    the apex pin: pins of the rim, nearer to the camera, move by less (`tactip331-fitted`: by a
    tenth less). Images (N, S, S) uint8 are by kind, true pins (N, P, 2) are (column, row), px.
    Without `mm_per_px` errors in mm are None.
    """
    pitches = [cKDTree(points).query(points, k=2)[0][:, 1] for points in tap_pins]
    limit = 0.5 * float(np.median(pitches))
    errors = {kind: measure_pin_error(stack, tap_pins, limit) for kind, stack in images.items()}
    squares = np.sum(np.square(sheared_pins.astype(np.float64) - tap_pins), axis=-1)
    errors["true_slide"] = {"rms_px": float(np.sqrt(squares.mean()))}
    rows: dict[str, dict[str, float | None]] = {}
    for kind, error in errors.items():
        rms_mm = None if mm_per_px is None else error["rms_px"] * mm_per_px
        rows[kind] = {"rms_px": error["rms_px"], "rms_mm": rms_mm, **error}
    return rows
