"""What a robot takes an image for: ways from a binary image to the edge's distance and direction, each with its own networks only.

>>> perceive = perceptions(Path("runs/standard"), ("sheared", "disentangled"))["disentangled"]
>>> edge_mm, edge_deg = perceive(images)                       # (B, S, S) uint8 of {0, 255} -> (B,) each
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxunshear.errors import UserError
from jaxunshear.experiment import Experiment
from jaxunshear.model import posenet, unet, unshearnet
from jaxunshear.training.checkpoint import holds_model, load_best, read_net

TRUE = "true"  # the pose that the simulator knows
UNSHEARING = ("entangled", "disentangled", "entangled_large", "unet")  # networks
WAYS = {  # name: the networks it runs, the last of them a PoseNet
    "sheared": ("posenet",),
    "entangled": ("entangled", "posenet"),
    "disentangled": ("disentangled", "posenet"),
    "entangled_large": ("entangled_large", "posenet"),
    "unet": ("unet", "posenet"),
    "learnt": ("posenet_sheared",),
}
Perceive = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
BATCH = 32
Unshear = Callable[[np.ndarray], np.ndarray]


def ways_of(model: Path) -> tuple[str, ...]:
    """The ways that the trained networks in a folder allow."""
    return tuple(way for way, networks in WAYS.items() if all(holds_model(model / name) for name in networks))


def unshearing_of(model: Path) -> tuple[str, ...]:
    """The trained networks in a folder that unshear."""
    return tuple(name for name in UNSHEARING if holds_model(model / name))


def perceptions(model: Path, experiment: Experiment, ways: tuple[str, ...]) -> dict[str, Perceive]:
    """A function for each of `ways`. Raises `UserError` for an unknown way, or where a network is missing."""
    unknown = [way for way in ways if way not in WAYS]
    if unknown:
        raise UserError(f"perception '{unknown[0]}' is unknown: use {TRUE}, {', '.join(WAYS)}")
    return {way: _perception(model, experiment, WAYS[way]) for way in ways}


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


def _unshearer(model: Path, name: str) -> Unshear:
    net, variables = read_net(model / name), load_best(model / name)
    run = jax.jit(lambda variables, images: _unshear(name, net, variables, _unit(images))[..., 0])
    return lambda images: jax.device_get(run(variables, images))


def _perception(model: Path, experiment: Experiment, networks: tuple[str, ...]) -> Perceive:
    nets: list[Any] = [read_net(model / name) for name in networks]
    variables = [load_best(model / name) for name in networks]
    ranges = (experiment.paired if networks[-1] == "posenet_sheared" else experiment.pose).ranges

    @jax.jit
    def run(variables, images):
        seen = _unit(images)
        for name, net, known in zip(networks[:-1], nets[:-1], variables[:-1], strict=True):
            seen = _unshear(name, net, known, seen)
        pose = posenet.pose_from_outputs(posenet.predict(nets[-1], variables[-1], seen), ranges)
        return pose["edge_mm"], pose["edge_deg"]

    return lambda images: jax.device_get(run(variables, images))


def _unit(images: jax.Array) -> jax.Array:
    """(B, S, S) uint8 -> (B, S, S, 1) float32 in [0, 1]."""
    return images[..., None].astype(np.float32) / 255


def _unshear(name: str, net: Any, variables: Any, images: jax.Array) -> jax.Array:
    module: Any = unet if name == "unet" else unshearnet
    return module.unshear(net, variables, images)
