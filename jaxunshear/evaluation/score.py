"""From the networks' outputs to one number an image, a metric at a time: pure functions of arrays.

`Outputs` is all that evaluation needs to know of networks; who fills it is `networks.py`.
"""

from collections.abc import Callable, Container, Mapping
from typing import NamedTuple

import numpy as np
from jax import Array

from jaxunshear.config.registry import DISENTANGLED, UNSHEARING
from jaxunshear.config.targets import Targets
from jaxunshear.metrics import compute_pose_errors, count_scales, ms_ssim, mse, ssim

BASELINES = ("mean_tap", "nearest_tap", "translated")  # images made without a network
DIRECT_KIND = "sheared_learnt"  # what a PoseNet that learnt from sheared images reads from them
KINDS = ("tap", "sheared", *BASELINES, *UNSHEARING)
TARGET_KIND = "partner"  # of a recorded slide: what a perfect network would unshear it to
POSE_KINDS = ("tap", TARGET_KIND, "sheared", DIRECT_KIND, *BASELINES, *UNSHEARING)
CELLS = (
    "DC(z_p)",
    "DC(z_s)",
    "DS(z_p,z_s)",
    "DS(z_p,z_p)",
)  # appendix D: which decoder is fed which codes
CELL_METRICS = ("mse", "ssim", "ms_ssim")


class Outputs(NamedTuple):
    """What the networks make of a batch: images (B, S, S, 1) float in [0, 1], and poses by quantity, each (B,)."""

    images: dict[str, Array]  # by kind, those of KINDS that the run has
    cells: dict[
        str, Array
    ]  # by cell: CELLS, or fewer where the network has no shear code or codes of two widths
    poses: Mapping[
        str, Mapping[str, np.ndarray | Array]
    ]  # by kind, those of POSE_KINDS that the run has
    pins: Mapping[str, Array]  # (B, P, 2) px by kind, of networks over pins


def get_cell_target(cell: str) -> str:
    """What the cell's decoder ought to draw: "tap" or "sheared"."""
    return "tap" if cell.startswith("DC") else "sheared"


def make_cell_metrics(size: int) -> dict[str, Callable[[Array, Array], Array]]:
    """CELL_METRICS as functions of two batches of images of `size` px; MS-SSIM with as many scales as these carry, at most five."""
    scales = count_scales(size)
    return {"mse": mse, "ssim": ssim, "ms_ssim": lambda a, b: ms_ssim(a, b, scales)}


def score_images(images: dict[str, Array], cells: dict[str, Array]) -> dict[str, Array]:
    """Similarity of every kind but the tap with its tap, and of each cell with its target, each (B,). Can be jitted.

    Names: `ms_ssim/<kind>`, `swap/<cell>/<metric>`. As many MS-SSIM scales as the size carries, at most five.
    """
    metrics = make_cell_metrics(images["tap"].shape[1])
    kinds = [kind for kind in KINDS if kind in images and kind != "tap"]
    scores = {f"ms_ssim/{kind}": metrics["ms_ssim"](images[kind], images["tap"]) for kind in kinds}
    for cell, drawn in cells.items():
        for metric in CELL_METRICS:
            scores[f"swap/{cell}/{metric}"] = metrics[metric](drawn, images[get_cell_target(cell)])
    return scores


def score_poses(
    poses: Mapping[str, Mapping[str, np.ndarray]],
    true: Mapping[str, np.ndarray],
    table: str = "pose",
) -> dict[str, np.ndarray]:
    """Absolute pose errors, each (B,), named `<table>/<kind>/<quantity>`."""
    scores = {}
    for kind, predicted in poses.items():
        for quantity, error in compute_pose_errors(predicted, true).items():
            scores[f"{table}/{kind}/{quantity}"] = error
    return scores


def compute_differences(scores: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Disentangled less each other network, contact by contact, (N,): `difference/<kind>/<ms_ssim or quantity>`.

    Their means have far narrower intervals than the two means apart: both saw the same contacts.
    """
    found = {}
    for name, score in scores.items():
        table, kind, *quantity = name.split("/")
        ours = scores.get("/".join([table, DISENTANGLED, *quantity]))
        if ours is not None and kind in (*UNSHEARING, DIRECT_KIND) and kind != DISENTANGLED:
            found["/".join(["difference", kind, *(quantity or [table])])] = ours - score
    return found


def choose_main_kind(kinds: Container[str]) -> str:
    """The network whose images stand for a run: the disentangled one, or the best known of those there are."""
    return next((kind for kind in reversed(UNSHEARING) if kind in kinds), "sheared")


def compute_chance_errors(true: dict[str, np.ndarray], targets: Targets) -> dict[str, float]:
    """Mean absolute error of one answer to every image, the best that needs no image: the middle of the labels."""
    middle = {name: np.full_like(value, np.median(value)) for name, value in true.items()}
    for target in targets:
        if target.is_circular:
            angle = np.radians(true[target.name].astype(np.float64))
            middle[target.name][:] = np.degrees(
                np.arctan2(np.sin(angle).mean(), np.cos(angle).mean())
            )
    return {name: float(error.mean()) for name, error in compute_pose_errors(middle, true).items()}
