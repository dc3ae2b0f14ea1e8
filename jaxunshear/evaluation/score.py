"""Score the networks' outputs: one number per contact and metric, by pure functions of arrays.

Scores are (N,) by name: `ms_ssim/<kind>`, `swap/<cell>/<metric>`, `pins/<kind>` px,
`pose/<kind>/<quantity>` mm or deg, `read/<estimator>/<kind>/<quantity>` likewise, and
`difference/<kind>/<ms_ssim or quantity>`.
"""

from collections.abc import Container, Mapping
from typing import NamedTuple

import numpy as np
from jax import Array

from jaxunshear.config.networks import DISENTANGLED, UNSHEARING
from jaxunshear.config.targets import Targets
from jaxunshear.metrics import compute_pose_errors, count_scales, ms_ssim, mse, ssim

TRUE_KIND = "true"  # of the true values among poses
BASELINES = ("mean_tap", "nearest_tap", "translated")  # images made without a network
DIRECT_KIND = "sheared_learnt"  # poses by a PoseNet that learned from sheared images
SMOOTH = "smooth"  # label of contacts whose nearest edge has one direction
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


def score_images(images: Mapping[str, Array], cells: Mapping[str, Array]) -> dict[str, Array]:
    """Score the similarity of images with their tap, and of cells with their target: (B,) each.

    MS-SSIM has as many scales as fit the images, at most five. The function can be compiled.
    """
    scales = count_scales(images["tap"].shape[1])
    scores = {}
    for kind in list_kinds():
        if kind in images and kind != "tap":
            scores[f"ms_ssim/{kind}"] = ms_ssim(images[kind], images["tap"], scales)
    return scores | score_cells(cells, images)


def score_cells(
    cells: Mapping[str, Array], targets: Mapping[str, Array], other: Array | None = None
) -> dict[str, Array]:
    """Score images (B, S, S, 1) of cells against the targets "tap" and "sheared": (B,) each.

    A cell that got a code of another image is also compared with `other`, under the name
    `swap/<cell>/<metric> to the other`.
    """
    scales = count_scales(targets["tap"].shape[1])
    metrics = {"mse": mse, "ssim": ssim, "ms_ssim": lambda a, b: ms_ssim(a, b, scales)}
    scores = {}
    for cell, image in cells.items():
        for name in CELL_METRICS:
            scores[f"swap/{cell}/{name}"] = metrics[name](image, targets[get_cell_target(cell)])
            if other is not None and "another" in cell:
                scores[f"swap/{cell}/{name} to the other"] = metrics[name](image, other)
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

    Their means have far narrower intervals than the two means alone, since both networks are tested
    on the same contacts.
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

    For circular angles the mean direction takes the place of the median, for classes the most
    frequent one.
    """
    middle = {name: np.full_like(value, np.median(value)) for name, value in true.items()}
    for target in targets:
        if target.is_circular:
            angle = np.radians(true[target.name].astype(np.float64))
            middle[target.name][:] = np.degrees(
                np.arctan2(np.sin(angle).mean(), np.cos(angle).mean())
            )
        elif target.classes:
            counts = np.bincount(true[target.name].astype(int))
            middle[target.name][:] = np.argmax(counts)
    return {name: float(error.mean()) for name, error in compute_pose_errors(middle, true).items()}
