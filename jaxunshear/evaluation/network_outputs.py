"""Run the trained networks of a run as one function of a batch, without knowing data sets."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.config.networks import DISENTANGLED, POSENET, POSENET_SHEARED, UNSHEARING
from jaxunshear.config.targets import Targets
from jaxunshear.data.sources import PinLayout
from jaxunshear.evaluation.baselines import make_baseline_images
from jaxunshear.evaluation.code_swaps import decode_cells
from jaxunshear.evaluation.score import CELLS, DIRECT_KIND, Outputs, score_images
from jaxunshear.models import posenet
from jaxunshear.models.modality import IMAGES, PINS, Modality
from jaxunshear.models.registry import predict, unshear
from jaxunshear.models.weights import Net, Variables
from jaxunshear.training.trained_network import load_network

CELLS_BY_MODALITY = {IMAGES.name: CELLS, PINS.name: ("DC(z_p)", "DS(z_p,z_s)")}

Scored = tuple[Outputs, dict[str, Array]]  # with scores of images, (B,) by name
# tap, sheared and perhaps a detected tap: what the data set stores of a batch
Run = Callable[..., Scored]


def load_run(
    run_dir: Path,
    names: Sequence[str],
    modality: Modality,
    pins: PinLayout | None = None,
    taps: np.ndarray | None = None,
) -> Run:
    """Load the best checkpoints of networks as one compiled function, see `make_run`.

    Raises `UserError` if a network is missing or cannot be read.
    """
    networks = {name: load_network(Path(run_dir) / name) for name in names}
    nets = {name: network.net for name, network in networks.items()}
    variables = {name: network.variables for name, network in networks.items()}
    targets = {name: network.targets for name, network in networks.items()}
    return partial(jax.jit(make_run(nets, targets, modality, pins)), variables, taps)


def make_run(
    nets: Mapping[str, Net],
    targets: Mapping[str, Targets],
    modality: Modality,
    pins: PinLayout | None = None,
) -> Callable[..., Scored]:
    """Make the function (variables, taps or None, tap, sheared) of networks by their name.

    It is not compiled. Tap and sheared are images (B, S, S, 1) uint8 in {0, 255}, or pins (B, P, 2)
    px, whose layout then is `pins`. With training taps (M, S, S, 1) uint8 the outputs include the
    baselines. A fifth argument, pins that were detected in the tap, is given to PoseNet in the
    place of the tap; all others are still compared with the tap. Images of pins are drawn as dots,
    so that similarities stand in the same tables as those of networks over images.
    """

    def run(
        variables: Mapping[str, Variables],
        taps: Array | None,
        tap: Array,
        sheared: Array,
        detected_tap: Array | None = None,
    ) -> Scored:
        tap, sheared = modality.scale(tap), modality.scale(sheared)
        outputs = {"tap": tap if detected_tap is None else detected_tap, "sheared": sheared}
        cells = {}
        if taps is not None:
            outputs |= make_baseline_images(taps, tap, sheared)
        for kind in UNSHEARING:
            if kind == DISENTANGLED and kind in nets:
                names = CELLS_BY_MODALITY[modality.name]
                cells = decode_cells(nets[kind], variables[kind], sheared, names)
                outputs[kind] = cells["DC(z_p)"]
                if modality is PINS and len(cells) == 1:
                    cells = {}  # its score is that of the pins
            elif kind in nets:
                outputs[kind] = unshear(nets[kind], variables[kind], sheared)
        poses = _predict_poses(nets, variables, targets, outputs)
        images = _draw(outputs | {"tap": tap}, modality, pins)
        cell_images = _draw(cells, modality, pins)
        scores = score_images(images, cell_images)
        if modality is IMAGES:
            return Outputs(images, cell_images, poses, {}), scores
        for kind, places in outputs.items():
            if kind != "tap":
                scores[f"pins/{kind}"] = _compute_rms_px(places, tap)
        return Outputs(images, cell_images, poses, outputs), scores

    return run


def _predict_poses(
    nets: Mapping[str, Net],
    variables: Mapping[str, Variables],
    targets: Mapping[str, Targets],
    inputs: Mapping[str, Array],
) -> dict[str, dict[str, Array]]:
    """Predict poses by kind: PoseNet from all inputs, the direct PoseNet from sheared ones."""

    def run(name: str, values: Array) -> dict[str, Array]:
        outputs = predict(nets[name], variables[name], values)
        return posenet.unscale_outputs(outputs, targets[name])

    poses = {}
    if POSENET in nets:
        poses = {kind: run(POSENET, values) for kind, values in inputs.items()}
    if POSENET_SHEARED in nets:
        poses[DIRECT_KIND] = run(POSENET_SHEARED, inputs["sheared"])
    return poses


def _draw(
    outputs: Mapping[str, Array], modality: Modality, pins: PinLayout | None
) -> dict[str, Array]:
    radius_px, size = (0.0, 0) if pins is None else (pins.radius_px, pins.size)
    return {kind: modality.draw(output, radius_px, size) for kind, output in outputs.items()}


def _compute_rms_px(pins: Array, target: Array) -> Array:
    """Compute the rms distance (B,) of pins (B, P, 2) px that both show; NaN if there is none."""
    square = jnp.sum(jnp.square(pins - target), -1)
    return jnp.sqrt(jnp.nanmean(square, -1))
