"""Methods of perception in the simulator: from a binary image to the edge, or to unsheared pins.

>>> model = load_model("standard")
>>> estimators = make_edge_estimators(model, ("sheared", "disentangled"))
>>> edge_mm, edge_deg = estimators["disentangled"](images)   # (B, S, S) uint8 of {0, 255} -> (B,)

A method loads its own networks only, each once for all methods. Methods have the same names whether
a run's networks take images or pins; pins are first detected and tracked in the image.
"""

from collections.abc import Callable, Iterable
from functools import cache, partial

import jax
import numpy as np
from jax import Array

from jaxunshear.config import networks
from jaxunshear.config.targets import list_target_names
from jaxunshear.errors import UserError
from jaxunshear.inference.forward import bind_networks, jit_for_inference
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.models.registry import scale_inputs, unshear
from jaxunshear.models.weights import Tree, Variables
from jaxunshear.training.checkpoint import compute_weights_digest

TRUE_POSE = "true"  # the pose that the simulator knows
METHODS = {  # name: the networks it runs, in this order
    "sheared": (networks.POSENET,),
    networks.ENTANGLED: (networks.ENTANGLED, networks.POSENET),
    networks.DISENTANGLED: (networks.DISENTANGLED, networks.POSENET),
    networks.ENTANGLED_LARGE: (networks.ENTANGLED_LARGE, networks.POSENET),
    networks.UNET: (networks.UNET, networks.POSENET),
    "learnt": (networks.POSENET_SHEARED,),
}
EDGE_TARGETS = ("edge_mm", "edge_deg")
# images (B, S, S) uint8 of {0, 255} -> the edge's mm and deg, (B,) each; NaN if the networks need
# pins and these are not identified
EdgeEstimator = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
# images (N, S, S) uint8 of {0, 255} -> (N, P, 2) px, motions of the unsheared pins; NaN rows if
# pins are not identified
Unshear = Callable[[np.ndarray], np.ndarray]


def list_methods(model: TrainedModel) -> tuple[str, ...]:
    """List the methods that the trained networks of a model allow."""
    trained = set(model.networks)
    return tuple(method for method, networks in METHODS.items() if trained.issuperset(networks))


def compute_network_digests(model: TrainedModel, methods: Iterable[str]) -> dict[str, str]:
    """Compute a digest of the networks of each of `methods`; that of the true pose is empty.

    Raises `UserError` if a network is missing.
    """

    @cache
    def compute_digest(name: str) -> str:
        return compute_weights_digest(model.load_network(name).variables)

    return {method: " ".join(map(compute_digest, METHODS.get(method, ()))) for method in methods}


def make_edge_estimators(
    model: TrainedModel, methods: Iterable[str]
) -> dict[str, EdgeEstimator | None]:
    """Make an estimator for each of `methods`; None for the true pose.

    Raises `UserError` for an unknown method, or if a network is missing.
    """
    estimators: dict[str, EdgeEstimator | None] = {}
    for method in methods:
        if method not in (TRUE_POSE, *METHODS):
            raise UserError(
                f"perception '{method}' is unknown: use {TRUE_POSE}, {', '.join(METHODS)}"
            )
        estimators[method] = None if method == TRUE_POSE else _make_edge_estimator(model, method)
    return estimators


def _make_edge_estimator(model: TrainedModel, method: str) -> EdgeEstimator:
    networks = {name: model.load_network(name) for name in METHODS[method]}
    names = list_target_names(networks[METHODS[method][-1]].targets)
    if not set(EDGE_TARGETS) <= set(names):
        raise UserError(
            f"{model.folder} reads {', '.join(names)}: an edge is followed by edge_mm and edge_deg"
        )
    reader = model.simulated_reader

    def predict_edge(variables: Variables, inputs: Array) -> list[Array]:
        values: Tree = scale_inputs(inputs)
        for run_network in bind_networks(networks, variables).values():
            values = run_network(values)
        return [values[target] for target in EDGE_TARGETS]

    variables = {name: network.variables for name, network in networks.items()}
    run = jit_for_inference(predict_edge, variables)

    def estimate_edge(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        inputs = reader.read(images)
        edge_mm, edge_deg = jax.device_get(run(inputs.values))
        identified = inputs.identified
        return np.where(identified, edge_mm, np.nan), np.where(identified, edge_deg, np.nan)

    return estimate_edge


def find_unshearing_network(method: str) -> str:
    """Name the network that unshears the images of trajectories by a method of perception.

    There may be no network of the name.
    """
    return networks.DISENTANGLED if method == TRUE_POSE else method


def load_unshearers(model: TrainedModel) -> dict[str, Unshear]:
    """Load functions from images to motions of the unsheared pins, by network.

    Pins are detected in the unsheared images, unless the networks give pins. Raises `UserError`.
    """
    measure = partial(model.simulated_reader.measure_unsheared_motions, model.lattice)

    def load_unshearer(name: str) -> Unshear:
        net, variables, _ = model.load_network(name)
        run = jit_for_inference(
            lambda variables, inputs: unshear(net, variables, scale_inputs(inputs)), variables
        )
        return partial(measure, run)

    return {name: load_unshearer(name) for name in networks.UNSHEARING if name in model.networks}
