"""Networks of a model as functions of a batch, to be compiled.

Inputs are images (B, S, S) uint8 of {0, 255}, or pins (B, P, 2) px; networks over images take and
give (B, S, S, 1) in [0, 1].

>>> run = jit_for_inference(partial(unshearnet.unshear, net), variables)
>>> run(images)
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxunshear.config.networks import DISENTANGLED, POSENET, POSENET_SHEARED
from jaxunshear.models import posenet
from jaxunshear.models.registry import get_functions, predict, unshear
from jaxunshear.models.weights import Tree, Variables
from jaxunshear.training.checkpoint import TrainedNetwork

AS_RECORDED, UNSHEARED = "as_recorded", "unsheared"  # what a pose is predicted from
LEARNT = "learnt"  # poses by a PoseNet that was trained on slides
BATCH = 32

# scaled inputs -> unsheared ones, or a pose by quantity, (B,) each
RunNetwork = Callable[..., Tree]
# scaled inputs -> unsheared if a network does so, and poses by kind and quantity
RunNetworks = Callable[..., Tree]
Outputs = TypeVar("Outputs")


def bind_networks(
    networks: Mapping[str, TrainedNetwork], variables: Variables
) -> dict[str, RunNetwork]:
    """Make a function of scaled inputs of each network."""

    def bind(name: str) -> RunNetwork:
        net, _, targets = networks[name]
        if get_functions(net).predict is None:
            return partial(unshear, net, variables[name])
        predict_pose = partial(predict, net, variables[name])
        return lambda values: posenet.unscale_outputs(predict_pose(values), targets)

    return {name: bind(name) for name in networks}


def chain_networks(runs: Mapping[str, RunNetwork], with_sheared_poses: bool) -> RunNetworks:
    """Chain functions of networks, by name, into one of scaled inputs.

    The unsheared inputs are None without a network that unshears. `with_sheared_poses`: poses of
    the inputs as they are, too, where others can be had.
    """

    def run(values: ArrayLike) -> tuple[Array | None, dict[str, dict[str, Array]]]:
        unsheared = runs[DISENTANGLED](values) if DISENTANGLED in runs else None
        poses = {}
        if POSENET in runs and (with_sheared_poses or unsheared is None):
            poses[AS_RECORDED] = runs[POSENET](values)
        if POSENET in runs and unsheared is not None:
            poses[UNSHEARED] = runs[POSENET](unsheared)
        if POSENET_SHEARED in runs:
            poses[LEARNT] = runs[POSENET_SHEARED](values)
        return unsheared, poses

    return run


def compile_networks(
    networks: Mapping[str, TrainedNetwork], with_sheared_poses: bool
) -> RunNetworks:
    """Compile `chain_networks` with the weights of networks."""

    def run(variables: Variables, values: Array) -> Tree:
        return chain_networks(bind_networks(networks, variables), with_sheared_poses)(values)

    return jit_for_inference(run, {name: network.variables for name, network in networks.items()})


def compute_confidence(image: Array) -> Array:
    """Compute how sure an unsheared image (S, S, 1) in [0, 1] is of its white pixels.

    It is the mean of the pixels p, weighted by p: 1 for a crisp image, less for an image that is
    grey between possible positions of a pin, 0 for a black one.
    """
    total = jnp.sum(image)
    return jnp.where(total > 0, jnp.sum(image**2) / jnp.where(total > 0, total, 1), 0)


def jit_for_inference(run: Callable[..., Outputs], variables: Variables) -> Callable[..., Outputs]:
    """Jit `run(variables, ...)` as a function of its other arguments.

    The weights are constants of the compiled program. What depends on them alone (kernels
    rearranged for `fast/conv.py`, the norm's factors) is computed once, by the compiler; it would
    cost a single image up to a third of its time.

    Products have the precision of the inputs, also on a GPU, which would round float32 to ten bits:
    outputs are the same there as on a CPU.
    """
    constants = jax.device_get(variables)

    def run_with_constants(*inputs: object) -> Outputs:
        with jax.default_matmul_precision("highest"):
            return run(constants, *inputs)

    return jax.jit(run_with_constants)
