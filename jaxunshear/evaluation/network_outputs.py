"""Run the trained networks of a run as one function of a batch, without knowing data sets."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.config.registry import DISENTANGLED, POSENET, POSENET_SHEARED, UNSHEARING
from jaxunshear.config.targets import Targets
from jaxunshear.evaluation.baselines import make_baseline_images
from jaxunshear.evaluation.code_swaps import decode_cells
from jaxunshear.evaluation.score import DIRECT_KIND, Outputs, score_images
from jaxunshear.files import Json
from jaxunshear.models import pin_networks, posenet
from jaxunshear.models.registry import predict, unshear
from jaxunshear.models.weights import Net, Variables
from jaxunshear.perception.pin_drawing import draw_dots
from jaxunshear.training.checkpoint import load_best, read_net, read_targets
from jaxunshear.training.examples import PinLayout

Run = Callable[[np.ndarray, np.ndarray], tuple[Outputs, dict[str, Array]]]


def load_run(
    run_dir: Path,
    names: Sequence[str],
    taps: np.ndarray | None = None,
    pins: PinLayout | None = None,
) -> Run:
    """Load networks as one compiled function (tap, sheared) -> (outputs, image scores).

    Tap and sheared are images (B, S, S, 1) uint8 in {0, 255}; with `pins`, the networks are over
    pins, and take (B, P, 2) px instead. Reads the best checkpoints of the networks `names`, and no
    others. With training taps (M, S, S, 1) uint8 the outputs include the baselines.
    Raises `UserError` if a network is missing or cannot be read.
    """
    folders = {name: Path(run_dir) / name for name in names}
    nets = {name: read_net(folder) for name, folder in folders.items()}
    variables = {name: load_best(folder) for name, folder in folders.items()}
    targets = {name: read_targets(folder) for name, folder in folders.items()}
    if pins is not None:
        return partial(jax.jit(make_pin_run(nets, targets, pins)), variables)
    return partial(jax.jit(make_image_run(nets, targets)), variables, taps)


def make_image_run(
    nets: Mapping[str, Net], targets: Mapping[str, Targets]
) -> Callable[[Json, Array | None, Array, Array], tuple[Outputs, dict[str, Array]]]:
    """Make the function (variables, taps or None, tap, sheared) of networks over images.

    It is not compiled. `nets` and `targets` are by name of the network; images are uint8 in
    {0, 255}: taps (M, S, S, 1), tap and sheared (B, S, S, 1). Scores are (B,) each.
    """

    def run(
        variables: Variables, taps: Array | None, tap: Array, sheared: Array
    ) -> tuple[Outputs, dict[str, Array]]:
        tap, sheared = tap.astype(np.float32) / 255, sheared.astype(np.float32) / 255
        images, cells = {"tap": tap, "sheared": sheared}, {}
        if taps is not None:
            images |= make_baseline_images(taps, tap, sheared)
        for kind in UNSHEARING:
            if kind == DISENTANGLED and kind in nets:
                cells = decode_cells(nets[kind], variables[kind], sheared)
                images[kind] = cells["DC(z_p)"]
            elif kind in nets:
                images[kind] = unshear(nets[kind], variables[kind], sheared)
        poses = _predict_poses(nets, variables, targets, images)
        return Outputs(images, cells, poses, {}), score_images(images, cells)

    return run


def make_pin_run(
    nets: Mapping[str, Net], targets: Mapping[str, Targets], pins: PinLayout
) -> Callable[..., tuple[Outputs, dict[str, Array]]]:
    """Make the function (variables, tap pins, sheared pins) of networks over pins.

    It is not compiled, and pins are (B, P, 2) px each. With `detected_tap` PoseNet is given those
    pins of the tap, and all others are still compared with the tap pins. Images are the pins drawn
    as dots, so that similarities stand in the same tables as those of networks over images.
    """

    def run(
        variables: Variables, tap: Array, sheared: Array, detected_tap: Array | None = None
    ) -> tuple[Outputs, dict[str, Array]]:
        places = {"tap": tap if detected_tap is None else detected_tap, "sheared": sheared}
        cells = {}
        for kind in UNSHEARING:
            if kind not in nets:
                continue
            net, weights = nets[kind], variables[kind]
            z_p, z_s = pin_networks.encode(net, weights, sheared)
            places[kind] = pin_networks.decode_canonical(net, weights, z_p)
            if z_s is not None:
                reconstructed = pin_networks.decode_sheared(net, weights, z_p, z_s)
                cells = {"DC(z_p)": places[kind], "DS(z_p,z_s)": reconstructed}
        poses = _predict_poses(nets, variables, targets, places)
        images = _draw_pins(places | {"tap": tap}, pins)
        cell_images = _draw_pins(cells, pins)
        scores = score_images(images, cell_images)
        for kind, place in places.items():
            if kind != "tap":
                scores[f"pins/{kind}"] = _compute_rms_px(place, tap)
        return Outputs(images, cell_images, poses, places), scores

    return run


def _predict_poses(
    nets: Mapping[str, Net],
    variables: Variables,
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


def _draw_pins(places: Mapping[str, Array], pins: PinLayout) -> dict[str, Array]:
    return {kind: draw_dots(place, pins.radius_px, pins.size) for kind, place in places.items()}


def _compute_rms_px(pins: Array, target: Array) -> Array:
    """Compute the rms distance (B,) of pins (B, P, 2) px that both show; NaN if there is none."""
    square = jnp.sum(jnp.square(pins - target), -1)
    return jnp.sqrt(jnp.nanmean(square, -1))
