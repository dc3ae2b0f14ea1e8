"""Pose errors in the paper's two quantities and in the two that an edge does not leave open.

x and yaw are the paper's. Along a smooth edge they are ambiguous (a step along it changes what is asked but hardly what
is felt), so the signed distance to the edge and the local edge angle stand beside them.
"""

from collections.abc import Mapping

import numpy as np

QUANTITIES = ("x_mm", "yaw_deg", "edge_mm", "edge_deg")


def true_quantities(pose: np.ndarray, edge: np.ndarray) -> dict[str, np.ndarray]:
    """The four, each (B,), of poses (B, 4) [x_mm, y_mm, yaw_deg, depth_mm] and edges (B, 2) [edge_mm, edge_deg]."""
    return {"x_mm": pose[:, 0], "yaw_deg": pose[:, 2], "edge_mm": edge[:, 0], "edge_deg": edge[:, 1]}


def pose_errors(predicted: Mapping[str, np.ndarray], true: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Absolute errors by quantity, each (B,) float32; angles the short way round, so at most 180.

    Raises `ValueError` where a quantity is missing or lengths differ.
    """
    errors = {}
    for name in QUANTITIES:
        if name not in predicted or name not in true:
            raise ValueError(f"pose quantity {name!r} is missing")
        a, b = np.asarray(predicted[name], np.float64), np.asarray(true[name], np.float64)
        if a.shape != b.shape or a.ndim != 1:
            raise ValueError(f"{name}: shapes {a.shape} and {b.shape} are not one (B,)")
        difference = a - b
        if name.endswith("_deg"):
            difference = (difference + 180) % 360 - 180
        errors[name] = np.abs(difference).astype(np.float32)
    return errors
