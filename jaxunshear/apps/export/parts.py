"""What of a trained model is exported: the networks that `stream` runs, as one function of a batch, and what it is checked with."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jax import Array

from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.registry import DISENTANGLED, POSENET, POSENET_SHEARED
from jaxunshear.config.targets import Targets
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.inference.perceiver import AS_RECORDED, LEARNT, UNSHEARED
from jaxunshear.inference.perception import compute_confidence, load_networks, scale_to_unit
from jaxunshear.models import posenet
from jaxunshear.models.dispatch import predict, unshear
from jaxunshear.models.weights import Net, Variables
from jaxunshear.training.checkpoint import has_model

Run = Callable[[np.ndarray], Json]
Prepared = Callable[[np.ndarray], np.ndarray]
MAX_DIFFERENCE = 1e-4  # by which an exported network may differ from JAX, of each output's range
CHECK_INPUTS = 6  # inputs


class ExportedNetwork(NamedTuple):
    """One network."""

    net: Net
    variables: Variables


class ExportedModel(NamedTuple):
    """The networks of a model that a robot runs."""

    unshear_network: ExportedNetwork | None
    pose_network: ExportedNetwork | None
    targets: Targets  # what `reads` gives
    method: str  # whose pose: of the unsheared image, of the recorded one, or by a PoseNet that learnt from slides; "" without `reads`
    rest: np.ndarray | None  # (P, 2) px, the untouched pins of networks over pins
    size: int  # S, px

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one image, or of its pins."""
        return (self.size, self.size) if self.rest is None else self.rest.shape

    @property
    def dtype(self) -> type:
        return np.uint8 if self.rest is None else np.float32


def load_exported_model(model: Path, experiment: Experiment) -> ExportedModel:
    """From the folder of a finished run or of released weights. Raises UserError."""
    reader = next((name for name in (POSENET, POSENET_SHEARED) if has_model(model / name)), "")
    pairs = has_model(model / DISENTANGLED)
    nets, variables, targets = load_networks(
        model, filter(None, (DISENTANGLED if pairs else "", reader))
    )
    parts = {
        name: ExportedNetwork(net, jax.device_get(variables[name])) for name, net in nets.items()
    }
    if not parts:
        raise UserError(
            f"{model} holds no trained network that unshears or reads poses: train one, or name another"
        )
    way = LEARNT if reader == POSENET_SHEARED else UNSHEARED if pairs else AS_RECORDED
    first = next(iter(parts.values()))
    rest = (
        np.asarray(first.variables["batch_stats"]["rest"], np.float32)
        if uses_pins(experiment)
        else None
    )
    size = experiment.paired.preprocess.size
    return ExportedModel(
        parts.get(DISENTANGLED),
        parts.get(reader),
        targets.get(reader, ()),
        way if reader else "",
        rest,
        size,
    )


def make_exported_function(parts: ExportedModel) -> Callable[[Array], Json]:
    """Images (B, S, S) uint8 of {0, 255}, or pins (B, P, 2) px -> "unsheared", the same as taps (images in [0, 1]), "confidence" (B,) of
    images, see `stream`, and "pose", mm and deg by name, (B,) each; what the model has no network for is left out."""

    def run(given: Array) -> Json:
        found: Json = {}
        seen = scale_to_unit(given) if parts.rest is None else given
        if parts.unshear_network is not None:
            after = unshear(*parts.unshear_network, seen)
            found["unsheared"] = after[..., 0] if parts.rest is None else after
            if parts.rest is None:
                found["confidence"] = jax.vmap(compute_confidence)(after)
            seen = after if parts.method == UNSHEARED else seen
        if parts.pose_network is not None:
            outputs = predict(*parts.pose_network, seen)
            found["pose"] = posenet.unscale_outputs(outputs, parts.targets)
        return found

    return run


def make_check_inputs(parts: ExportedModel) -> np.ndarray:
    """CHECKED inputs, always the same: images of a few large patches, of noise; pins that have moved, some of them not seen."""
    random = np.random.default_rng(0)
    if parts.rest is None:
        shares = np.linspace(0.02, 0.5, CHECK_INPUTS)[:, None, None]
        coarse = 2 ** (np.arange(CHECK_INPUTS) % 4)
        noise = random.random((CHECK_INPUTS, *parts.shape))
        white = [
            np.kron(x, np.ones((n, n)))[: len(x), : len(x)]
            for x, n in zip(noise < shares, coarse, strict=True)
        ]
        return np.uint8(255) * np.array(white, np.uint8)
    moved = parts.rest + random.normal(
        0, 0.01 * np.ptp(parts.rest), (CHECK_INPUTS, *parts.rest.shape)
    )
    return np.where(random.random((CHECK_INPUTS, len(parts.rest), 1)) < 0.02, np.nan, moved).astype(
        np.float32
    )


def measure_difference(
    parts: ExportedModel,
    run: Run,
    given: np.ndarray,
    batch: int | None,
    prepared: Prepared | None = None,
) -> float:
    """Of `run` and `make_exported_function`, as other commands run it, over all that is given: the largest, of each output's range. `batch`: how
    many `run` takes at once; None for any, which is one, and then the rest. With `prepared`, `run` is given frames: what it makes of
    them counts by the share of pixels that are otherwise, since one on the verge of the threshold may fall to either side, and its
    networks are compared on that."""
    batches = _batches(given, batch)
    found = jax.tree.map(lambda *each: np.concatenate(each), *map(run, batches))
    given = np.concatenate(batches)
    expected = jax.device_get(jax.jit(make_exported_function(parts))(found.get("image", given)))
    wrong = 0.0 if prepared is None else float(np.mean(found["image"] != prepared(given)))
    return float(np.max([wrong, *_differences(parts, found, expected)]))


def _batches(given: np.ndarray, batch: int | None) -> list[np.ndarray]:
    if batch is None:
        return [each for each in (given[:1], given[1:]) if len(each)]
    count = -(-len(given) // batch)
    return list(
        np.resize(given, (count * batch, *given.shape[1:])).reshape(count, batch, *given.shape[1:])
    )


def _differences(parts: ExportedModel, found: Json, true: Json) -> Iterator[float]:
    """Between two answers of `make_exported_function`, the largest of each output, over its range: white; all pins from the first to the last; half
    the range of a target; half a circle."""
    span = 1.0 if parts.rest is None else float(np.ptp(parts.rest))
    for name in ("unsheared", "confidence"):
        if name in true:
            yield float(np.abs(found[name] - true[name]).max()) / (
                span if name == "unsheared" else 1
            )
    for target in parts.targets:
        off = np.abs(found["pose"][target.name] - true["pose"][target.name])
        yield float(
            np.max(
                np.minimum(off, 360 - off) / 180 if target.is_circular else off / target.half_range
            )
        )
