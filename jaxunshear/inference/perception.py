"""Methods of perception: from a binary image to the edge's distance and direction.

>>> folder = Path("runs/standard")
>>> estimators = make_edge_estimators(folder, experiment, ("sheared", "disentangled"))
>>> edge_mm, edge_deg = estimators["disentangled"](images)   # (B, S, S) uint8 of {0, 255} -> (B,)

Each method loads its own networks only. Methods have the same names whether a run's networks take
images or pins; pins are first detected and tracked in the image.
"""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.config.experiment import Experiment, require_simulated, uses_pins
from jaxunshear.config.registry import (
    ALL_NETWORKS,
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
from jaxunshear.models.inference import jit_for_inference
from jaxunshear.models.registry import predict, unshear
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
BATCH = 32
# images (B, S, S) uint8 of {0, 255} -> the edge's mm and deg, (B,) each; NaN if the networks need
# pins and these are not identified
EdgeEstimator = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
# (variables by network, images (B, S, S) uint8 of {0, 255}) -> unsheared or as they are
# (B, S, S, 1) in [0, 1], and pose by quantity, (B,) each; for pin networks input and output are
# pins (B, P, 2) px
Forward = Callable[[Variables, Array], tuple[Array, dict[str, Array]]]
# images (N, S, S) uint8 of {0, 255} -> (N, P, 2) px, motions of the unsheared pins; NaN rows if
# pins are not identified
Unshear = Callable[[np.ndarray], np.ndarray]
# images (B, S, S) -> inputs of networks, and whether they are known (B,)
InputReader = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
Images = TypeVar("Images", np.ndarray, Array)


class LoadedNetworks(NamedTuple):
    """Settings, variables and pose targets, each by name of the network."""

    nets: dict[str, Net]
    variables: dict[str, Variables]
    targets: dict[str, Targets]


class LoadedForward(NamedTuple):
    forward: Forward
    variables: Variables
    targets: Targets  # of the predicted pose


def list_methods(model: Path) -> tuple[str, ...]:
    """List the methods that the trained networks in a folder allow."""
    trained = {name for name in ALL_NETWORKS if has_model(model / name)}
    return tuple(method for method, networks in METHODS.items() if trained.issuperset(networks))


def load_networks(model: Path, names: Iterable[str]) -> LoadedNetworks:
    """Load networks from the folder of a run.

    Raises `UserError` if one is missing, damaged or not finished.
    """
    folders = {name: model / name for name in names}
    for folder in folders.values():
        check_finished(folder)
    return LoadedNetworks(
        {name: read_net(folder) for name, folder in folders.items()},
        {name: load_best(folder) for name, folder in folders.items()},
        {name: read_targets(folder) for name, folder in folders.items()},
    )


def list_unshearing_networks(model: Path) -> tuple[str, ...]:
    """List the trained networks in a folder that unshear."""
    return tuple(name for name in UNSHEARING if has_model(model / name))


def make_edge_estimators(
    model: Path, experiment: Experiment, methods: tuple[str, ...]
) -> dict[str, EdgeEstimator]:
    """Make an estimator for each of `methods`.

    Raises `UserError` for an unknown method, or if a network is missing.
    """
    unknown = [method for method in methods if method not in METHODS]
    if unknown:
        raise UserError(
            f"perception '{unknown[0]}' is unknown: use {TRUE_POSE}, {', '.join(METHODS)}"
        )
    read = _make_input_reader(experiment)
    return {method: _make_edge_estimator(model, read, method) for method in methods}


def compute_network_digests(model: Path, methods: Iterable[str]) -> dict[str, str]:
    """Compute a digest of the networks of each of `methods`; that of the true pose is empty.

    Raises `UserError` if a network is missing.
    """
    digests: dict[str, str] = {}
    by_method = {}
    for method in methods:
        networks = METHODS.get(method, ())
        for name in networks:
            if name not in digests:
                digests[name] = compute_weights_digest(model / name)
        by_method[method] = " ".join(digests[name] for name in networks)
    return by_method


def find_unshearing_network(method: str) -> str:
    """Name the network that unshears the images of trajectories by a method of perception.

    There may be no network of the name.
    """
    return DISENTANGLED if method == TRUE_POSE else method


def load_unshearers(
    model: Path, experiment: Experiment, names: tuple[str, ...]
) -> dict[str, Unshear]:
    """Load functions from images to motions of the unsheared pins, by network.

    Pins are detected in the unsheared images, unless the networks give pins. Raises `UserError`.
    """
    lattice = compute_model_lattice(experiment)
    networks = load_networks(model, names)
    make = _make_pin_unshearer if uses_pins(experiment) else _make_image_unshearer
    return {name: make(networks.nets[name], networks.variables[name], lattice) for name in names}


def run_in_batches(
    run: Callable[[np.ndarray], Tree], inputs: np.ndarray, batch_size: int = BATCH
) -> Tree:
    """Run a function of any number of images or pins, (N, ...), in batches of one shape.

    One shape is compiled once. The results of `run` are arrays (B, ...), or a tree of them.
    """
    parts = []
    for start in range(0, len(inputs), batch_size):
        part = inputs[start : start + batch_size]
        outputs = jax.device_get(run(np.resize(part, (batch_size, *part.shape[1:]))))
        parts.append(jax.tree.map(lambda values, count=len(part): values[:count], outputs))
    return jax.tree.map(lambda *values: np.concatenate(values), *parts)


def make_forward(nets: Mapping[str, Net], targets: Mapping[str, Targets]) -> Forward:
    """Chain networks, in the order in which they run, a PoseNet last; `targets` by network."""

    def forward(variables: Variables, inputs: Array) -> tuple[Array, dict[str, Array]]:
        values = scale_to_unit(inputs) if inputs.dtype == np.uint8 else inputs
        *unshearing, (name, pose_net) = nets.items()
        for unshearing_name, net in unshearing:
            values = unshear(net, variables[unshearing_name], values)
        outputs = predict(pose_net, variables[name], values)
        return values, posenet.unscale_outputs(outputs, targets[name])

    return forward


def load_forward(model: Path, method: str) -> LoadedForward:
    """Load the networks of a method from the folder of a run. Raises `UserError`."""
    nets, variables, targets = load_networks(model, METHODS[method])
    return LoadedForward(make_forward(nets, targets), variables, targets[METHODS[method][-1]])


def compute_model_lattice(experiment: Experiment) -> Lattice:
    """Compute the rest positions of the simulated sensor's pins.

    Raises `UserError` for a model that was trained on recordings.
    """
    paired, _ = require_simulated(experiment, "this")
    return compute_rest_lattice(experiment.sensor, paired.camera, paired.preprocess)


def _make_input_reader(experiment: Experiment) -> InputReader:
    """Make a function from images to the inputs of a run's networks: images, or tracked pins."""
    if not uses_pins(experiment):
        return lambda images: (images, np.ones(len(images), bool))
    lattice = compute_model_lattice(experiment)

    def read_pins(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        motion, identified = track_images(lattice, images, independent=True)
        return (lattice.rest + motion).astype(np.float32), identified

    return read_pins


def _make_image_unshearer(net: Net, variables: Variables, lattice: Lattice) -> Unshear:
    run = jit_for_inference(
        lambda variables, images: unshear(net, variables, scale_to_unit(images))[..., 0], variables
    )
    return lambda images: measure_motions(lattice, run_in_batches(run, images))


def _make_pin_unshearer(net: Net, variables: Variables, lattice: Lattice) -> Unshear:
    run = jit_for_inference(lambda variables, pins: unshear(net, variables, pins), variables)

    def unshear_motions(images: np.ndarray) -> np.ndarray:
        motion, identified = track_images(lattice, images)
        pins = (lattice.rest + motion).astype(np.float32)
        unsheared = run_in_batches(run, pins) - lattice.rest
        return np.where(identified[:, None, None], unsheared, np.nan)

    return unshear_motions


def _make_edge_estimator(model: Path, read: InputReader, method: str) -> EdgeEstimator:
    forward, variables, targets = load_forward(model, method)
    names = list_target_names(targets)
    if not {"edge_mm", "edge_deg"} <= set(names):
        raise UserError(
            f"{model} reads {', '.join(names)}: an edge is followed by edge_mm and edge_deg"
        )

    def predict_edge(variables: Variables, inputs: Array) -> tuple[Array, Array]:
        _, pose = forward(variables, inputs)
        return pose["edge_mm"], pose["edge_deg"]

    run = jit_for_inference(predict_edge, variables)

    def estimate_edge(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        inputs, identified = read(images)
        edge_mm, edge_deg = jax.device_get(run(inputs))
        return np.where(identified, edge_mm, np.nan), np.where(identified, edge_deg, np.nan)

    return estimate_edge


def compute_confidence(image: Array) -> Array:
    """Compute how sure an unsheared image (S, S, 1) in [0, 1] is of its white pixels.

    It is the mean of the pixels p, weighted by p: 1 for a crisp image, less for an image that is
    grey between possible positions of a pin, 0 for a black one.
    """
    total = jnp.sum(image)
    return jnp.where(total > 0, jnp.sum(image**2) / jnp.where(total > 0, total, 1), 0)


def scale_to_unit(images: Images) -> Images:
    """Scale (B, S, S) uint8 to (B, S, S, 1) float32 in [0, 1]."""
    return images[..., None].astype(np.float32) / 255
