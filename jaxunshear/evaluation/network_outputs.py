"""The trained networks of a run as one function of a batch of images; knows the models, nothing of data sets."""

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
from jaxunshear.models.dispatch import unshear
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
    """A function (tap, sheared) -> (outputs, image scores), both images (B, S, S, 1) uint8 in {0, 255}; jitted as one.

    Reads the best checkpoints of the networks `names` in `run_dir` and no others, and what poses each has learnt. With training taps
    (M, S, S, 1) uint8 the baselines are there too. Networks over `pins` take pins (B, P, 2) px in the place of images.
    Raises `UserError` where a network is missing or cannot be read.
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
    """The function (variables, taps or None, tap, sheared) of these networks (settings and pose targets by name), not yet jitted.

    Images are uint8 in {0, 255}: taps (M, S, S, 1), tap and sheared (B, S, S, 1). Scores are (B,) each.
    """

    def run(
        variables: Variables, taps: Array | None, tap: Array, sheared: Array
    ) -> tuple[Outputs, dict[str, Array]]:
        tap, sheared = tap.astype(np.float32) / 255, sheared.astype(np.float32) / 255
        images, cells, poses = {"tap": tap, "sheared": sheared}, {}, {}
        if taps is not None:
            images |= make_baseline_images(taps, tap, sheared)
        for kind in UNSHEARING:
            if kind == DISENTANGLED and kind in nets:
                cells = decode_cells(nets[kind], variables[kind], sheared)
                images[kind] = cells["DC(z_p)"]
            elif kind in nets:
                images[kind] = unshear(nets[kind], variables[kind], sheared)
        if POSENET in nets:
            answers = {
                kind: posenet.predict(nets[POSENET], variables[POSENET], x)
                for kind, x in images.items()
            }
            poses = {
                kind: posenet.unscale_outputs(answer, targets[POSENET])
                for kind, answer in answers.items()
            }
        if POSENET_SHEARED in nets:
            answer = posenet.predict(nets[POSENET_SHEARED], variables[POSENET_SHEARED], sheared)
            poses[DIRECT_KIND] = posenet.unscale_outputs(answer, targets[POSENET_SHEARED])
        return Outputs(images, cells, poses, {}), score_images(images, cells)

    return run


def make_pin_run(
    nets: Mapping[str, Net], targets: Mapping[str, Targets], pins: PinLayout
) -> Callable[..., tuple[Outputs, dict[str, Array]]]:
    """The function (variables, tap pins, sheared pins), (B, P, 2) px each, of networks over pins, not yet jitted. `seen_tap`: the tap's
    pins as PoseNet is to read them, where all is compared with others.

    Images are the pins drawn as dots, whatever the frames showed beside them, so that likenesses stand in the same tables.
    """

    def run(
        variables: Variables, tap: Array, sheared: Array, seen_tap: Array | None = None
    ) -> tuple[Outputs, dict[str, Array]]:
        places, cells, poses = (
            {"tap": tap if seen_tap is None else seen_tap, "sheared": sheared},
            {},
            {},
        )
        for kind in (name for name in UNSHEARING if name in nets):
            z_p, z_s = pin_networks.encode(nets[kind], variables[kind], sheared)
            places[kind] = pin_networks.decode_canonical(nets[kind], variables[kind], z_p)
            if z_s is not None:
                cells = {"DC(z_p)": places[kind]}
                cells["DS(z_p,z_s)"] = pin_networks.decode_sheared(
                    nets[kind], variables[kind], z_p, z_s
                )
        if POSENET in nets:
            for kind, place in places.items():
                outputs = pin_networks.predict(nets[POSENET], variables[POSENET], place)
                poses[kind] = posenet.unscale_outputs(outputs, targets[POSENET])
        if POSENET_SHEARED in nets:
            outputs = pin_networks.predict(
                nets[POSENET_SHEARED], variables[POSENET_SHEARED], sheared
            )
            poses[DIRECT_KIND] = posenet.unscale_outputs(outputs, targets[POSENET_SHEARED])
        shown = places | {"tap": tap}
        images, drawn = (
            {k: draw_dots(p, pins.radius_px, pins.size) for k, p in each.items()}
            for each in (shown, cells)
        )
        apart = {
            f"pins/{kind}": _rms(place, tap) for kind, place in places.items() if kind != "tap"
        }
        return Outputs(images, drawn, poses, places), score_images(images, drawn) | apart

    return run


def _rms(pins: Array, target: Array) -> Array:
    """(B,) root mean square distance px of pins (B, P, 2) that both show; NaN where there is none."""
    square = jnp.sum(jnp.square(pins - target), -1)
    return jnp.sqrt(jnp.nanmean(square, -1))
