"""Run the trained networks of a run as one function of a batch, without knowing data sets."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.config.networks import DISENTANGLED, POSENET, POSENET_SHEARED, UNSHEARING
from jaxunshear.config.targets import Targets
from jaxunshear.data.sources import PinLayout
from jaxunshear.evaluation.code_swaps import decode_cells
from jaxunshear.evaluation.score import CELLS, DIRECT_KIND, Outputs, score_images
from jaxunshear.models import posenet
from jaxunshear.models.modality import IMAGES, PINS, Modality
from jaxunshear.models.registry import predict, unshear
from jaxunshear.models.weights import Net, Variables
from jaxunshear.selection import select_evenly
from jaxunshear.training.checkpoint import load_network

PIN_CELLS = ("DC(z_p)", "DS(z_p,z_s)")  # of networks over pins

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
                names = CELLS if modality is IMAGES else PIN_CELLS
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
                square = jnp.sum(jnp.square(places - tap), -1)
                scores[f"pins/{kind}"] = jnp.sqrt(jnp.nanmean(square, -1))  # of pins in both
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


MAX_TAPS = 2000  # of the training split, evenly chosen
MAX_SHIFT = 0.25  # of a translation, in sides of the image


def collect_training_taps(batches: Iterable[Mapping[str, np.ndarray]]) -> np.ndarray:
    """Collect one tap of every pose, at most MAX_TAPS: (M, S, S, 1) uint8.

    Batches hold canonical, stimulus and pose_id.
    """
    tap_by_pose: dict[tuple[int, int], np.ndarray] = {}
    for batch in batches:
        for stimulus, pose, tap in zip(
            batch["stimulus"], batch["pose_id"], batch["canonical"], strict=True
        ):
            tap_by_pose.setdefault((int(stimulus), int(pose)), tap)
    taps = list(tap_by_pose.values())
    return np.stack([taps[index] for index in select_evenly(len(taps), MAX_TAPS)])


def make_baseline_images(taps: Array, tap: Array, sheared: Array) -> dict[str, Array]:
    """Make the images of `score.BASELINES` by name.

    `taps` (M, S, S, 1) uint8 are of the training split. Only "translated" uses `tap`.
    """
    training_taps = taps.astype(sheared.dtype) / 255
    return {
        "mean_tap": jnp.broadcast_to(training_taps.mean(0), sheared.shape),
        "nearest_tap": find_nearest_images(training_taps, sheared),
        "translated": jax.vmap(translate_to_target)(sheared, tap),
    }


def find_nearest_images(candidates: Array, images: Array) -> Array:
    """Find for every image that of `candidates` (M, S, S, 1) with the least mean squared error."""
    flat, rows = candidates.reshape(len(candidates), -1), images.reshape(len(images), -1)
    products = jnp.matmul(rows, flat.T, precision="highest")
    distances = jnp.sum(flat**2, 1) - 2 * products  # without the square of the image, a constant
    return candidates[jnp.argmin(distances, 1)]


def translate_to_target(image: Array, target: Array) -> Array:
    """Translate `image` (S, S, 1) by the pixels that bring it nearest to `target`.

    The shift is at most MAX_SHIFT of the side, nearness is the mean squared difference, and black
    flows in. No translation can do better, since this one uses the answer.
    """
    size = image.shape[0]
    most = int(MAX_SHIFT * size)
    shape = (2 * size, 2 * size)

    def correlate(a: Array, b: Array) -> Array:
        """Sum a(x) b(x + shift) over x, for shifts from -most to most on each axis."""
        product = jnp.fft.irfft2(jnp.conj(jnp.fft.rfft2(a, shape)) * jnp.fft.rfft2(b, shape), shape)
        return jnp.roll(product, (most, most), (0, 1))[: 2 * most + 1, : 2 * most + 1]

    plain = image[..., 0]
    in_view = correlate(plain**2, jnp.ones_like(plain))
    best = jnp.argmin(in_view - 2 * correlate(plain, target[..., 0]))
    rows, columns = jnp.divmod(best, 2 * most + 1)
    # the shift is (rows - most, columns - most)
    start = (2 * most - rows, 2 * most - columns)
    return jax.lax.dynamic_slice(jnp.pad(plain, most), start, (size, size))[..., None]
