"""The exported part of a model: the networks that `stream` runs, as one function of a batch.

Exported files are compared with this function.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.apps.export.sensor_check import (
    JaxGraph,
    SensorCheck,
    add_image_plausibility,
    add_pin_plausibility,
    make_sensor_check,
)
from jaxunshear.config.networks import DISENTANGLED, POSENET, POSENET_SHEARED
from jaxunshear.config.targets import Targets
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.inference.forward import (
    AS_RECORDED,
    LEARNT,
    UNSHEARED,
    bind_networks,
    chain_networks,
    compute_confidence,
)
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.models.registry import scale_inputs
from jaxunshear.perception.drawing import draw_dots
from jaxunshear.perception.sensor_check import MIN_PLAUSIBILITY, MIN_SPACING_PX
from jaxunshear.training.checkpoint import TrainedNetwork

Run = Callable[[np.ndarray], Json]
Prepare = Callable[[np.ndarray], np.ndarray]
MAX_DIFFERENCE = 1e-4  # between an exported network and JAX, over each output's range
CHECK_INPUTS = 6


class ExportedModel(NamedTuple):
    """The networks of a model that a robot runs."""

    # DISENTANGLED, and POSENET or POSENET_SHEARED, as far as there are any
    networks: dict[str, TrainedNetwork]
    rest: np.ndarray | None  # (P, 2) px, the untouched pins of networks over pins
    check: SensorCheck

    @property
    def unshear_network(self) -> TrainedNetwork | None:
        return self.networks.get(DISENTANGLED)

    @property
    def pose_network(self) -> TrainedNetwork | None:
        return self.networks.get(POSENET, self.networks.get(POSENET_SHEARED))

    @property
    def method(self) -> str:
        """The input of poses, UNSHEARED or AS_RECORDED; LEARNT if PoseNet learnt from slides."""
        if POSENET in self.networks:
            return UNSHEARED if DISENTANGLED in self.networks else AS_RECORDED
        return LEARNT if POSENET_SHEARED in self.networks else ""

    @property
    def size(self) -> int:
        return self.check.size  # S, px

    @property
    def targets(self) -> Targets:
        return self.pose_network.targets if self.pose_network else ()

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of one image, or of its pins."""
        return (self.size, self.size) if self.rest is None else self.rest.shape

    @property
    def dtype(self) -> type:
        return np.uint8 if self.rest is None else np.float32


def load_exported_model(model: TrainedModel) -> ExportedModel:
    """Load the networks that a robot runs. Raises UserError."""
    posenet = POSENET if POSENET in model.networks else POSENET_SHEARED
    networks = {}
    for name in model.networks:
        if name not in (DISENTANGLED, posenet):
            continue
        network = model.load_network(name)
        networks[name] = network._replace(variables=jax.device_get(network.variables))
    if not networks:
        raise UserError(
            f"{model.folder} holds no trained network that unshears or reads poses: "
            "train one, or name another"
        )
    constants = next(iter(networks.values())).variables["batch_stats"]
    rest = np.asarray(constants["rest"], np.float32) if "rest" in constants else None
    size = model.experiment.paired.preprocess.size
    check = make_sensor_check(model.rest if rest is None else rest, size)
    if rest is None and check.spacing < MIN_SPACING_PX:
        raise UserError(
            f"{model.folder}: pins are {check.spacing:.1f} px apart in its images, fewer than the "
            f"{MIN_SPACING_PX:g} by which they differ from noise: train with larger images"
        )
    return ExportedModel(networks, rest, check)


def make_exported_function(parts: ExportedModel) -> Callable[[Array], Json]:
    """Make a function of images (B, S, S) uint8 of {0, 255}, or of pins (B, P, 2) px.

    It returns "unsheared" in the shape of its input (images in [0, 1]), "pose", mm and deg by name,
    (B,) each, "confidence" (B,), plausibility by `apps/export/sensor_check.py`, over images times
    `compute_confidence`, and "sure" (B,): whether the input is of the model's sensor. Where it is
    not, confidence is 0 and the others are NaN. An output that the model has no network for is left
    out.
    """
    variables = {name: network.variables for name, network in parts.networks.items()}
    forward = chain_networks(bind_networks(parts.networks, variables), with_sheared_poses=False)

    def run(inputs: Array) -> Json:
        inputs = scale_inputs(inputs)
        if parts.rest is None:
            channels_first = inputs.transpose(0, 3, 1, 2)
            confidence = add_image_plausibility(JaxGraph(), parts.check, channels_first)
        else:
            confidence = add_pin_plausibility(JaxGraph(), parts.check, inputs)
        sure = confidence >= MIN_PLAUSIBILITY
        unsheared, poses = forward(inputs)
        outputs: Json = {}
        if poses:
            (outputs["pose"],) = poses.values()
        if unsheared is not None:
            outputs["unsheared"] = unsheared[..., 0] if parts.rest is None else unsheared
            if parts.rest is None:
                confidence *= jax.vmap(compute_confidence)(unsheared)
        outputs = jax.tree.map(lambda values: _keep(sure, values, jnp.nan), outputs)
        return outputs | {"confidence": _keep(sure, confidence, 0.0), "sure": sure}

    return run


def _keep(sure: Array, values: Array, other: float) -> Array:
    return jnp.where(sure.reshape(-1, *[1] * (values.ndim - 1)), values, other)


def make_check_inputs(parts: ExportedModel) -> np.ndarray:
    """Make CHECK_INPUTS inputs, always the same: pins that have moved, and last nothing at all.

    Of images some pins are missing, and so are some of pins by identity.
    """
    random = np.random.default_rng(0)
    rest, spacing = parts.check.rest, parts.check.spacing
    slide = random.normal(0, 0.3 * spacing, (CHECK_INPUTS, 1, 2))
    pins = rest + slide + random.normal(0, 0.1 * spacing, (CHECK_INPUTS, *rest.shape))
    is_missing = random.random((CHECK_INPUTS, len(rest), 1)) < 0.02
    is_missing[-1] = True
    if parts.rest is not None:
        return np.where(is_missing, np.nan, pins).astype(np.float32)
    shown = np.where(is_missing, -parts.size, pins).astype(np.float32)
    dots = draw_dots(jnp.asarray(shown), 0.3 * spacing, parts.size)
    return np.uint8(255) * np.asarray(dots[..., 0] > 0.5, np.uint8)


def measure_difference(
    parts: ExportedModel,
    run: Run,
    inputs: np.ndarray,
    batch: int | None,
    prepare: Prepare | None = None,
) -> float:
    """Measure the largest difference of `run` to `make_exported_function`, over an output's range.

    With `prepare`, `run` takes frames. The images that it makes of them then count by the share of
    pixels that differ from `prepare`, since a pixel at the threshold may fall to either side, and
    its networks are compared on its own images.

    Args:
        batch: how many inputs `run` takes at once. None is any number: one, and then the rest.
    """
    batches = _split_batches(inputs, batch)
    outputs = jax.tree.map(lambda *each: np.concatenate(each), *map(run, batches))
    inputs = np.concatenate(batches)
    function = jax.jit(make_exported_function(parts))
    expected = jax.device_get(function(outputs.get("image", inputs)))
    wrong = 0.0 if prepare is None else float(np.mean(outputs["image"] != prepare(inputs)))
    return float(np.max([wrong, *_compute_differences(parts, outputs, expected)]))


def _split_batches(inputs: np.ndarray, batch: int | None) -> list[np.ndarray]:
    if batch is None:
        return [each for each in (inputs[:1], inputs[1:]) if len(each)]
    count, shape = -(-len(inputs) // batch), inputs.shape[1:]
    return list(np.resize(inputs, (count * batch, *shape)).reshape(count, batch, *shape))


def _compute_differences(parts: ExportedModel, outputs: Json, expected: Json) -> Iterator[float]:
    """Yield the largest difference of each output over its range.

    The ranges are: white; the distance of the outermost pins; half the range of a target; half a
    circle.
    """
    span = 1.0 if parts.rest is None else float(np.ptp(parts.rest))
    sure = expected["sure"]
    yield float(np.any(outputs["sure"] != sure))
    ranges = {"unsheared": span, "confidence": 1.0}
    for name, output_range in ranges.items():
        if name in expected:
            error = np.abs(outputs[name] - expected[name])[sure]
            yield float(error.max(initial=0.0)) / output_range
    for target in parts.targets:
        error = np.abs(outputs["pose"][target.name] - expected["pose"][target.name])[sure]
        if target.is_circular:
            yield float(np.max(np.minimum(error, 360 - error) / 180, initial=0.0))
        else:
            yield float(np.max(error / target.half_range, initial=0.0))
