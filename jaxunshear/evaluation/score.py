"""Score the networks' outputs: one number per contact and metric, by pure functions of arrays.

`Outputs` is all that the scores need to know of networks; `network_outputs.py` fills it.
"""

from collections.abc import Callable, Container, Mapping
from typing import NamedTuple

import numpy as np
from jax import Array

from jaxunshear.config.registry import DISENTANGLED, UNSHEARING
from jaxunshear.config.targets import Targets
from jaxunshear.metrics import compute_pose_errors, count_scales, ms_ssim, mse, ssim

BASELINES = ("mean_tap", "nearest_tap", "translated")  # images made without a network
DIRECT_KIND = "sheared_learnt"  # poses by a PoseNet that learned from sheared images
TARGET_KIND = "partner"  # of a recorded slide: what a perfect network would unshear it to
# appendix D: which decoder is given which codes
CELLS = ("DC(z_p)", "DC(z_s)", "DS(z_p,z_s)", "DS(z_p,z_p)")
CELL_METRICS = ("mse", "ssim", "ms_ssim")


class Outputs(NamedTuple):
    """Outputs of the networks for a batch."""

    images: dict[str, Array]  # (B, S, S, 1) in [0, 1] by kind, see `list_kinds`
    # (B, S, S, 1) by CELLS, or fewer without a shear code or with codes of two widths
    cells: dict[str, Array]
    # (B,) by kind, see `list_pose_kinds`, and target
    poses: Mapping[str, Mapping[str, np.ndarray | Array]]
    pins: Mapping[str, Array]  # (B, P, 2) px by kind, of networks over pins


def list_kinds() -> tuple[str, ...]:
    """List the kinds of images, with those of registered networks."""
    return ("tap", "sheared", *BASELINES, *UNSHEARING)


def list_pose_kinds() -> tuple[str, ...]:
    """List the kinds of contacts whose poses are predicted."""
    return ("tap", TARGET_KIND, "sheared", DIRECT_KIND, *BASELINES, *UNSHEARING)


def get_cell_target(cell: str) -> str:
    """Return which image the cell's decoder should reconstruct: "tap" or "sheared"."""
    return "tap" if cell.startswith("DC") else "sheared"


def make_cell_metrics(size: int) -> dict[str, Callable[[Array, Array], Array]]:
    """Make CELL_METRICS, functions of two batches of images of `size` px.

    MS-SSIM has as many scales as fit the images, at most five.
    """
    scales = count_scales(size)
    return {"mse": mse, "ssim": ssim, "ms_ssim": lambda a, b: ms_ssim(a, b, scales)}


def score_images(images: dict[str, Array], cells: dict[str, Array]) -> dict[str, Array]:
    """Score the similarity of images with their tap, and of cells with their target: (B,) each.

    Scores are named `ms_ssim/<kind>` and `swap/<cell>/<metric>`. The function can be compiled.
    """
    metrics = make_cell_metrics(images["tap"].shape[1])
    scores = {}
    for kind in list_kinds():
        if kind in images and kind != "tap":
            scores[f"ms_ssim/{kind}"] = metrics["ms_ssim"](images[kind], images["tap"])
    for cell, image in cells.items():
        target = images[get_cell_target(cell)]
        for metric in CELL_METRICS:
            scores[f"swap/{cell}/{metric}"] = metrics[metric](image, target)
    return scores


def score_poses(
    poses: Mapping[str, Mapping[str, np.ndarray]],
    true: Mapping[str, np.ndarray],
    table: str = "pose",
) -> dict[str, np.ndarray]:
    """Compute absolute pose errors (B,), named `<table>/<kind>/<quantity>`."""
    scores = {}
    for kind, predicted in poses.items():
        for quantity, error in compute_pose_errors(predicted, true).items():
            scores[f"{table}/{kind}/{quantity}"] = error
    return scores


def compute_differences(scores: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Subtract the scores of every other network from the disentangled one's, by contact: (N,).

    Differences are named `difference/<kind>/<ms_ssim or quantity>`. Their means have far narrower
    intervals than the two means alone, since both networks are tested on the same contacts.
    """
    differences = {}
    for name, score in scores.items():
        table, kind, *quantity = name.split("/")
        ours = scores.get("/".join([table, DISENTANGLED, *quantity]))
        if ours is not None and kind in (*UNSHEARING, DIRECT_KIND) and kind != DISENTANGLED:
            differences["/".join(["difference", kind, *(quantity or [table])])] = ours - score
    return differences


def choose_main_kind(kinds: Container[str]) -> str:
    """Choose the network that stands for a run: its last of UNSHEARING, or "sheared"."""
    return next((kind for kind in reversed(UNSHEARING) if kind in kinds), "sheared")


def compute_chance_errors(true: dict[str, np.ndarray], targets: Targets) -> dict[str, float]:
    """Compute the mean absolute error of predicting the median label for every contact.

    For circular angles the mean direction takes the place of the median.
    """
    middle = {name: np.full_like(value, np.median(value)) for name, value in true.items()}
    for target in targets:
        if target.is_circular:
            angle = np.radians(true[target.name].astype(np.float64))
            middle[target.name][:] = np.degrees(
                np.arctan2(np.sin(angle).mean(), np.cos(angle).mean())
            )
    return {name: float(error.mean()) for name, error in compute_pose_errors(middle, true).items()}
