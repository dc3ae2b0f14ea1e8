"""The trained networks of a run as one function of a batch of images; knows the models, nothing of data sets."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxunshear.dataset.settings import Ranges
from jaxunshear.evaluation.cells import draw_cells
from jaxunshear.evaluation.score import Outputs, image_scores
from jaxunshear.model import posenet, unshearnet
from jaxunshear.training.checkpoint import load_best, read_net

FOLDERS = ("disentangled", "entangled", "posenet")


def load(run_dir: Path, ranges: Ranges) -> Callable[[np.ndarray, np.ndarray], tuple[Outputs, dict[str, Array]]]:
    """A function (tap, sheared) -> (outputs, image scores), both images (B, S, S, 1) uint8 in {0, 255}; jitted as one.

    Reads the best checkpoints of `disentangled`, `entangled` and `posenet` in `run_dir`; `ranges` are those of the
    poses that PoseNet was trained on. Raises `UserError` where one is missing or cannot be read.
    """
    folders = {name: Path(run_dir) / name for name in FOLDERS}
    nets: dict[str, Any] = {name: read_net(folder) for name, folder in folders.items()}
    variables = {name: load_best(folder) for name, folder in folders.items()}

    @jax.jit
    def run(variables: dict[str, Any], tap: Array, sheared: Array):
        images = {"tap": tap.astype(np.float32) / 255, "sheared": sheared.astype(np.float32) / 255}
        images["entangled"] = unshearnet.unshear(nets["entangled"], variables["entangled"], images["sheared"])
        cells = draw_cells(nets["disentangled"], variables["disentangled"], images["sheared"])
        images["disentangled"] = cells["DC(z_p)"]
        answers = {kind: posenet.predict(nets["posenet"], variables["posenet"], x) for kind, x in images.items()}
        poses = {kind: posenet.pose_from_outputs(answer, ranges) for kind, answer in answers.items()}
        return Outputs(images, cells, poses), image_scores(images, cells)

    return partial(run, variables)
