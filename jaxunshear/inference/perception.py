"""What a robot takes an image for: ways from a binary image to the edge's distance and direction, each with its own networks only.

>>> perceive = make_edge_estimators(Path("runs/standard"), experiment, ("sheared", "disentangled"))["disentangled"]
>>> edge_mm, edge_deg = perceive(images)                       # (B, S, S) uint8 of {0, 255} -> (B,) each

Ways have the same names whether a run's networks read images or pins, which are then found and followed in the image first.
"""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.config.experiment import Experiment, require_simulated, uses_pins
from jaxunshear.config.registry import (
    DISENTANGLED,
    ENTANGLED,
    ENTANGLED_LARGE,
    POSENET,
    POSENET_SHEARED,
    UNET,
    UNSHEARING,
)
from jaxunshear.config.targets import Targets, list_target_names
from jaxunshear.errors import UserError
from jaxunshear.models import posenet
from jaxunshear.models.dispatch import predict, unshear
from jaxunshear.models.inference import jit_for_inference
from jaxunshear.models.weights import Net, Tree, Variables
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_tracking import measure_motions, track_images
from jaxunshear.perception.rest_positions import compute_rest_lattice
from jaxunshear.training.checkpoint import (
    check_finished,
    compute_weights_digest,
    has_model,
    load_best,
    read_net,
    read_targets,
)

TRUE_POSE = "true"  # the pose that the simulator knows
METHODS = {  # name: the networks it runs, in this order
    "sheared": (POSENET,),
    ENTANGLED: (ENTANGLED, POSENET),
    DISENTANGLED: (DISENTANGLED, POSENET),
    ENTANGLED_LARGE: (ENTANGLED_LARGE, POSENET),
    UNET: (UNET, POSENET),
    "learnt": (POSENET_SHEARED,),
}
# images (B, S, S) uint8 of {0, 255} -> the edge's mm and deg, (B,) each; NaN where pins are needed and not identified for sure
EdgeEstimator = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
# (variables by network, images (B, S, S) uint8 of {0, 255}) -> unsheared or as they are (B, S, S, 1) in [0, 1], pose by quantity, each
# (B,); of networks over pins both are pins (B, P, 2) px
Forward = Callable[[Variables, Array], tuple[Array, dict[str, Array]]]
BATCH = 32
# images (N, S, S) uint8 of {0, 255} -> (N, P, 2) px, motions of the unsheared pins; NaN rows where pins are not identified for sure
Unshear = Callable[[np.ndarray], np.ndarray]
# images (B, S, S) -> what networks read, whether that is known (B,)
InputReader = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
Images = TypeVar("Images", np.ndarray, Array)


def list_methods(model: Path) -> tuple[str, ...]:
    """The ways that the trained networks in a folder allow."""
    return tuple(
        way
        for way, networks in METHODS.items()
        if all(has_model(model / name) for name in networks)
    )


def load_networks(
    model: Path, names: Iterable[str]
) -> tuple[dict[str, Net], dict[str, Variables], dict[str, Targets]]:
    """Settings, variables and pose targets of networks in the folder of a run, by name each. Raises `UserError` where one is missing,
    damaged or not finished."""
    folders = {name: model / name for name in names}
    for folder in folders.values():
        check_finished(folder)
    nets = {name: read_net(folder) for name, folder in folders.items()}
    variables = {name: load_best(folder) for name, folder in folders.items()}
    return nets, variables, {name: read_targets(folder) for name, folder in folders.items()}


def list_unshearing_networks(model: Path) -> tuple[str, ...]:
    """The trained networks in a folder that unshear."""
    return tuple(name for name in UNSHEARING if has_model(model / name))


def make_edge_estimators(
    model: Path, experiment: Experiment, methods: tuple[str, ...]
) -> dict[str, EdgeEstimator]:
    """A function for each of `methods`. Raises `UserError` for an unknown way, or where a network is missing."""
    unknown = [way for way in methods if way not in METHODS]
    if unknown:
        raise UserError(
            f"perception '{unknown[0]}' is unknown: use {TRUE_POSE}, {', '.join(METHODS)}"
        )
    see = _make_input_reader(experiment)
    return {way: _perception(model, see, way) for way in methods}


def compute_network_digests(model: Path, methods: Iterable[str]) -> dict[str, str]:
    """Of the networks of each of `methods`; that of the true pose has none. Raises `UserError` where a network is missing."""
    parts = {way: METHODS.get(way, ()) for way in methods}
    own = {
        name: compute_weights_digest(model / name)
        for name in dict.fromkeys(name for names in parts.values() for name in names)
    }
    return {way: " ".join(own[name] for name in names) for way, names in parts.items()}


def find_unshearing_network(method: str) -> str:
    """The network, if there is one of the name, that unshears the images of walks by this way of perceiving."""
    return DISENTANGLED if method == TRUE_POSE else method


def load_unshearers(
    model: Path, experiment: Experiment, names: tuple[str, ...]
) -> dict[str, Unshear]:
    """By network: images in, motions of the unsheared pins out. They are found in the unsheared images, or networks over pins give
    them. Raises `UserError`."""
    lattice = compute_model_lattice(experiment)
    nets, variables, _ = load_networks(model, names)
    unshearer = _make_pin_unshearer if uses_pins(experiment) else _make_image_unshearer
    return {name: unshearer(nets[name], variables[name], lattice) for name in names}


def run_in_batches(
    run: Callable[[np.ndarray], Tree], given: np.ndarray, at_once: int = BATCH
) -> Tree:
    """`run` of any number of images or pins, (N, ...), in batches of one shape to compile; what it gives are arrays (B, ...), or a tree
    of them."""
    parts = []
    for start in range(0, len(given), at_once):
        part = given[start : start + at_once]
        found = jax.device_get(run(np.resize(part, (at_once, *part.shape[1:]))))
        parts.append(jax.tree.map(lambda values, kept=len(part): values[:kept], found))
    return jax.tree.map(lambda *values: np.concatenate(values), *parts)


def make_forward(nets: Mapping[str, Net], targets: Mapping[str, Targets]) -> Forward:
    """Return the function of networks by name, in the order in which they run, a PoseNet last; `targets` by network."""

    def forward(variables: Variables, given: Array) -> tuple[Array, dict[str, Array]]:
        seen = scale_to_unit(given) if given.dtype == np.uint8 else given
        *unshearing, reader = nets.items()
        for name, net in unshearing:
            seen = unshear(net, variables[name], seen)
        name, net = reader
        return seen, posenet.unscale_outputs(predict(net, variables[name], seen), targets[name])

    return forward


def load_forward(model: Path, method: str) -> tuple[Forward, Variables, Targets]:
    """A way of looking, its networks' variables and the poses that it reads, from the folder of a run. Raises `UserError`."""
    nets, variables, targets = load_networks(model, METHODS[method])
    return make_forward(nets, targets), variables, targets[METHODS[method][-1]]


def compute_model_lattice(experiment: Experiment) -> Lattice:
    """Where the simulated sensor's pins stand untouched. Raises `UserError` for a model that learnt from recordings."""
    paired, _ = require_simulated(experiment, "this")
    return compute_rest_lattice(experiment.sensor, paired.camera, paired.preprocess)


def _make_input_reader(experiment: Experiment) -> InputReader:
    """How the networks of a run are given images: as they are, or as the pins that are followed in each."""
    if not uses_pins(experiment):
        return lambda images: (images, np.ones(len(images), bool))
    lattice = compute_model_lattice(experiment)

    def see(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        motion, sure = track_images(lattice, images, independent=True)
        return (lattice.rest + motion).astype(np.float32), sure

    return see


def _make_image_unshearer(net: Net, variables: Variables, lattice: Lattice) -> Unshear:
    run = jit_for_inference(
        lambda known, images: unshear(net, known, scale_to_unit(images))[..., 0], variables
    )
    return lambda images: measure_motions(lattice, run_in_batches(run, images))


def _make_pin_unshearer(net: Net, variables: Variables, lattice: Lattice) -> Unshear:
    run = jit_for_inference(lambda known, pins: unshear(net, known, pins), variables)

    def motions(images: np.ndarray) -> np.ndarray:
        motion, sure = track_images(lattice, images)
        after = run_in_batches(run, (lattice.rest + motion).astype(np.float32)) - lattice.rest
        return np.where(sure[:, None, None], after, np.nan)

    return motions


def _perception(model: Path, see: InputReader, way: str) -> EdgeEstimator:
    forward, variables, targets = load_forward(model, way)
    if not {"edge_mm", "edge_deg"} <= set(list_target_names(targets)):
        raise UserError(
            f"{model} reads {', '.join(list_target_names(targets))}: an edge is followed by edge_mm and edge_deg"
        )

    def edge(variables: Variables, given: Array) -> tuple[Array, Array]:
        _, pose = forward(variables, given)
        return pose["edge_mm"], pose["edge_deg"]

    run = jit_for_inference(edge, variables)

    def perceive(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        given, known = see(images)
        edge_mm, edge_deg = (np.where(known, each, np.nan) for each in jax.device_get(run(given)))
        return edge_mm, edge_deg

    return perceive


def confidence(image: Array) -> Array:
    """How sure an unsheared image (S, S, 1) in [0, 1] is of its white pixels: the mean of p, weighted by p. 1 for a crisp image;
    one that hesitates between places of a pin is grey there. 0 for a black one."""
    total = jnp.sum(image)
    return jnp.where(total > 0, jnp.sum(image**2) / jnp.where(total > 0, total, 1), 0)


def scale_to_unit(images: Images) -> Images:
    """(B, S, S) uint8 -> (B, S, S, 1) float32 in [0, 1]."""
    return images[..., None].astype(np.float32) / 255
