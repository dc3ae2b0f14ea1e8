"""Pose errors by target (jaxunshear/config/targets.py). Angles wrap: their errors go the short way round."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32

from jaxunshear.angles import wrap_degrees


def compute_pose_errors(
    predicted: Mapping[str, np.ndarray], true: Mapping[str, np.ndarray]
) -> dict[str, Float32[np.ndarray, "B"]]:
    """Absolute errors of all that is `predicted`, in the order of the labels; angles the short way round, so at most 180.

    Raises `ValueError` where a label is missing or lengths differ.
    """
    unknown = [name for name in predicted if name not in true]
    if unknown:
        raise ValueError(f"pose quantity {unknown[0]!r} is missing")
    errors = {}
    for name in (
        name for name in true if name in predicted
    ):  # what comes out of a jitted function is sorted by name
        a, b = np.asarray(predicted[name], np.float64), np.asarray(true[name], np.float64)
        if a.shape != b.shape or a.ndim != 1:
            raise ValueError(f"{name}: shapes {a.shape} and {b.shape} are not one (B,)")
        difference = b - a
        if name.endswith("_deg"):
            difference = wrap_degrees(difference)
        errors[name] = np.abs(difference).astype(np.float32)
    return errors
