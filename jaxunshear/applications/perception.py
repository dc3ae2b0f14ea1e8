"""What a robot takes an image for: ways from a binary image to the edge's distance and direction, each with its own networks only.

>>> perceive = perceptions(Path("runs/standard"), ("sheared", "disentangled"))["disentangled"]
>>> edge_mm, edge_deg = perceive(images)                       # (B, S, S) uint8 of {0, 255} -> (B,) each
"""

from collections.abc import Callable, Iterable, Mapping
from functools import partial, reduce
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxunshear.errors import UserError
from jaxunshear.experiment import UNSHEARING
from jaxunshear.model import pose_head, posenet, unshearnet
from jaxunshear.model.layers import in_precision
from jaxunshear.model.ready import ready
from jaxunshear.model.settings import PoseNet
from jaxunshear.model.unshearing import unshear
from jaxunshear.targets import Targets, names_of
from jaxunshear.training.checkpoint import check_finished, digest_of, holds_model, load_best, read_net, read_targets

TRUE = "true"  # the pose that the simulator knows
WAYS = {  # name: the networks it runs, in this order
    "sheared": ("posenet",),
    "entangled": ("entangled", "posenet"),
    "disentangled": ("disentangled", "posenet"),
    "entangled_large": ("entangled_large", "posenet"),
    "unet": ("unet", "posenet"),
    "learnt": ("posenet_sheared",),
    "code": ("disentangled",),  # the head that reads the pose code; draws no image
    "both": ("disentangled", "posenet"),  # the mean of what that head reads and what PoseNet reads off the image
}
OF_CODE = ("code", "both")  # ask for a head
Perceive = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
# (variables by network, images (B, S, S) uint8 of {0, 255}) -> unsheared or as they are (B, S, S, 1) in [0, 1], pose by quantity, each (B,)
Look = Callable[[Mapping[str, Any], Array], tuple[Array, dict[str, Array]]]
BATCH = 32
Unshear = Callable[[np.ndarray], np.ndarray]


def ways_of(model: Path) -> tuple[str, ...]:
    """The ways that the trained networks in a folder allow."""
    there = [way for way, networks in WAYS.items() if all(holds_model(model / name) for name in networks)]
    headed = "code" in there and pose_head.of(load_best(model / "disentangled")) is not None
    return tuple(way for way in there if headed or way not in OF_CODE)


def unshearing_of(model: Path) -> tuple[str, ...]:
    """The trained networks in a folder that unshear."""
    return tuple(name for name in UNSHEARING if holds_model(model / name))


def perceptions(model: Path, ways: tuple[str, ...]) -> dict[str, Perceive]:
    """A function for each of `ways`. Raises `UserError` for an unknown way, or where a network is missing."""
    unknown = [way for way in ways if way not in WAYS]
    if unknown:
        raise UserError(f"perception '{unknown[0]}' is unknown: use {TRUE}, {', '.join(WAYS)}")
    return {way: _perception(model, way) for way in ways}


def digests(model: Path, ways: Iterable[str]) -> dict[str, str]:
    """Of the networks of each of `ways`; that of the true pose has none. Raises `UserError` where a network is missing."""
    parts = {way: WAYS.get(way, ()) for way in ways}
    own = {name: digest_of(model / name) for name in dict.fromkeys(name for names in parts.values() for name in names)}
    return {way: " ".join(own[name] for name in names) for way, names in parts.items()}


def unsheared_by(way: str) -> str:
    """The network, if there is one of the name, that unshears the images of walks by this way of perceiving."""
    return "disentangled" if way in (TRUE, *OF_CODE) else way


def unshearers(model: Path, names: tuple[str, ...]) -> dict[str, Unshear]:
    """Functions of images (B, S, S) uint8 of {0, 255} -> unsheared (B, S, S) in [0, 1], by network. Raises `UserError`."""
    return {name: _unshearer(model, name) for name in names}


def in_batches(unshear: Unshear, images: np.ndarray) -> np.ndarray:
    """`unshear` of any number of images, (N, S, S), in batches of one shape to compile."""
    parts = []
    for start in range(0, len(images), BATCH):
        part = images[start : start + BATCH]
        parts.append(unshear(np.resize(part, (BATCH, *part.shape[1:])))[: len(part)])
    return np.concatenate(parts)


def look_of(
    nets: Mapping[str, Any], targets: Mapping[str, Targets], precision: str = "float32", by_head: bool = False
) -> Look:
    """Of networks by name, in the order in which they look; `targets` by network. With `by_head` the answer of the head of a network
    that unshears counts, too: alone, or in a mean with PoseNet's."""

    def look(variables, images):
        seen, answers = _unit(images), []
        known: Targets = ()
        for name, net in nets.items():
            if isinstance(net, PoseNet):
                known = targets[name]
                answers.append(posenet.pose_from_outputs(posenet.predict(net, variables[name], seen), known))
                continue
            given = in_precision(seen, precision)
            if by_head:
                known = targets[name]
                z_p = unshearnet.encode_pose(net, variables[name], given)
                outputs = pose_head.predict(pose_head.of(variables[name]), z_p)
                answers.append(posenet.pose_from_outputs(outputs, known))
            seen = unshear(net, variables[name], given)
        return seen, reduce(partial(posenet.mean_pose, targets=known), answers)

    return look


def read_look(model: Path, way: str, precision: str = "float32") -> tuple[Look, Any, Targets]:
    """A way of looking, its networks' variables and the poses that it reads, from the folder of a run. Raises `UserError`."""
    names = WAYS[way]
    for name in names:
        check_finished(model / name)
    nets = {name: read_net(model / name) for name in names}
    variables = {name: load_best(model / name) for name in names}
    targets = {name: read_targets(model / name) for name in names}
    if way not in OF_CODE:
        return look_of(nets, targets, precision), variables, targets[names[-1]]
    if pose_head.of(variables["disentangled"]) is None:
        raise UserError(
            f"{model / 'disentangled'} has no head that reads the pose code: train with --train.label_weight above zero, "
            "or perceive another way"
        )
    if not targets["disentangled"]:
        raise UserError(
            f"{model / 'disentangled'} does not tell what its head reads: train it again, or perceive another way"
        )
    return look_of(nets, targets, precision, by_head=True), variables, targets["disentangled"]


def _unshearer(model: Path, name: str) -> Unshear:
    check_finished(model / name)
    net: Any = read_net(model / name)
    run = ready(lambda known, images: unshear(net, known, _unit(images))[..., 0], load_best(model / name))
    return lambda images: jax.device_get(run(images))


def _perception(model: Path, way: str) -> Perceive:
    look, variables, targets = read_look(model, way)
    if not {"edge_mm", "edge_deg"} <= set(names_of(targets)):
        raise UserError(f"{model} reads {', '.join(names_of(targets))}: an edge is followed by edge_mm and edge_deg")

    def edge(variables, images):
        _, pose = look(variables, images)
        return pose["edge_mm"], pose["edge_deg"]

    run = ready(edge, variables)
    return lambda images: jax.device_get(run(images))


def _unit(images: Array) -> Array:
    """(B, S, S) uint8 -> (B, S, S, 1) float32 in [0, 1]."""
    return images[..., None].astype(np.float32) / 255
