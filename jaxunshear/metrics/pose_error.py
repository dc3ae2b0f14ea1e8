"""Pose errors by target (jaxunshear/config/targets.py)."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32

from jaxunshear.angles import wrap_degrees


def compute_pose_errors(
    predicted: Mapping[str, np.ndarray], true: Mapping[str, np.ndarray]
) -> dict[str, Float32[np.ndarray, "B"]]:
    """Compute the absolute errors of `predicted`, in the order of the labels.

    Angles wrap, so their errors are at most 180. Raises `ValueError` if a label is missing or
    lengths differ.
    """
    unknown = [name for name in predicted if name not in true]
    if unknown:
        raise ValueError(f"pose quantity {unknown[0]!r} is missing")
    errors = {}
    for name in true:  # not of `predicted`: a compiled function sorts its outputs by name
        if name not in predicted:
            continue
        a, b = np.asarray(predicted[name], np.float64), np.asarray(true[name], np.float64)
        if a.shape != b.shape or a.ndim != 1:
            raise ValueError(f"{name}: shapes {a.shape} and {b.shape} are not one (B,)")
        difference = b - a
        if name.endswith("_deg"):
            difference = wrap_degrees(difference)
        errors[name] = np.abs(difference).astype(np.float32)
    return errors
