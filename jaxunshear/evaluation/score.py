"""From the networks' outputs to one number an image, a metric at a time: pure functions of arrays.

`Outputs` is all that evaluation needs to know of networks; who fills it is `networks.py`.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jax import Array

from jaxunshear.metrics import ms_ssim, mse, pose_errors, scales_that_fit, ssim

UNSHEARED = ("entangled", "disentangled")
KINDS = ("tap", "sheared", *UNSHEARED)
CELLS = {  # appendix D: which decoder is fed which codes, and what it should draw
    "DC(z_p)": "tap",
    "DC(z_s)": "tap",
    "DS(z_p,z_s)": "sheared",
    "DS(z_p,z_p)": "sheared",
}
CELL_METRICS = ("mse", "ssim", "ms_ssim")


class Outputs(NamedTuple):
    """What the networks make of a batch: images (B, S, S, 1) float in [0, 1], and poses by quantity, each (B,)."""

    images: dict[str, Array]  # by kind: KINDS
    cells: dict[str, Array]  # by cell: CELLS, or fewer where the network has no shear code or codes of two widths
    poses: Mapping[str, Mapping[str, np.ndarray | Array]]  # by kind


def image_scores(images: dict[str, Array], cells: dict[str, Array]) -> dict[str, Array]:
    """Similarity of every kind but the tap with its tap, and of each cell with its target, each (B,). Can be jitted.

    Names: `ms_ssim/<kind>`, `swap/<cell>/<metric>`. As many MS-SSIM scales as the size carries, at most five.
    """
    scales = scales_that_fit(images["tap"].shape[1])
    metrics = {"mse": mse, "ssim": ssim, "ms_ssim": lambda a, b: ms_ssim(a, b, scales)}
    scores = {f"ms_ssim/{kind}": metrics["ms_ssim"](images[kind], images["tap"]) for kind in KINDS if kind != "tap"}
    for cell, drawn in cells.items():
        for metric in CELL_METRICS:
            scores[f"swap/{cell}/{metric}"] = metrics[metric](drawn, images[CELLS[cell]])
    return scores


def pose_scores(poses: Mapping[str, Mapping[str, np.ndarray]], true: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Absolute pose errors, each (B,), named `pose/<kind>/<quantity>`."""
    scores = {}
    for kind, predicted in poses.items():
        for quantity, error in pose_errors(predicted, true).items():
            scores[f"pose/{kind}/{quantity}"] = error
    return scores


def chance(true: dict[str, np.ndarray]) -> dict[str, float]:
    """Mean absolute error of one answer to every image, the best that needs no image: the middle of the labels."""
    middle = {name: np.full_like(value, np.median(value)) for name, value in true.items()}
    angle = np.radians(true["edge_deg"].astype(np.float64))
    middle["edge_deg"][:] = np.degrees(np.arctan2(np.sin(angle).mean(), np.cos(angle).mean()))
    return {name: float(error.mean()) for name, error in pose_errors(middle, true).items()}
