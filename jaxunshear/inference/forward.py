"""Networks of a model as functions of a batch, to be compiled.

Inputs are images (B, S, S) uint8 of {0, 255}, or pins (B, P, 2) px; networks over images take and
give (B, S, S, 1) in [0, 1].

>>> run = jit_for_inference(partial(unshearnet.unshear, net), variables)
>>> run(images)
"""

from collections.abc import Callable, Mapping
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from jaxunshear.config.networks import DISENTANGLED, POSENET, POSENET_SHEARED
from jaxunshear.models import posenet
from jaxunshear.models.registry import predict, scale_inputs, unshear
from jaxunshear.models.weights import Tree, Variables
from jaxunshear.training.checkpoint import TrainedNetwork

AS_RECORDED, UNSHEARED = "as_recorded", "unsheared"  # what a pose is predicted from
LEARNT = "learnt"  # poses by a PoseNet that was trained on slides
BATCH = 32

# (variables by network, inputs) -> unsheared or as they are, and pose by quantity, (B,) each
Forward = Callable[[Variables, Array], tuple[Array, dict[str, Array]]]
# scaled inputs -> unsheared if a network does so, and poses by kind and quantity
RunNetworks = Callable[..., Tree]
Outputs = TypeVar("Outputs")


def make_forward(networks: Mapping[str, TrainedNetwork]) -> Forward:
    """Chain networks, in the order in which they run, a PoseNet last."""

    def forward(variables: Variables, inputs: Array) -> tuple[Array, dict[str, Array]]:
        values = scale_inputs(inputs)
        *unshearing, (last, pose_network) = networks.items()
        for name, network in unshearing:
            values = unshear(network.net, variables[name], values)
        outputs = predict(pose_network.net, variables[last], values)
        return values, posenet.unscale_outputs(outputs, pose_network.targets)

    return forward


def make_full_forward(
    networks: Mapping[str, TrainedNetwork], with_sheared_poses: bool
) -> Callable[[Variables, Array], tuple[Array | None, dict[str, dict[str, Array]]]]:
    """Make a function of scaled inputs to the unsheared ones and poses by kind and quantity.

    The unsheared ones are None without a network that unshears. `with_sheared_poses`: poses of the
    inputs as they are, too, where others can be had.
    """

    def forward(
        variables: Variables, values: Array
    ) -> tuple[Array | None, dict[str, dict[str, Array]]]:
        def predict_pose(name: str, values: Array) -> dict[str, Array]:
            outputs = predict(networks[name].net, variables[name], values)
            return posenet.unscale_outputs(outputs, networks[name].targets)

        unsheared = None
        if DISENTANGLED in networks:
            unsheared = unshear(networks[DISENTANGLED].net, variables[DISENTANGLED], values)
        poses = {}
        if POSENET in networks and (with_sheared_poses or unsheared is None):
            poses[AS_RECORDED] = predict_pose(POSENET, values)
        if POSENET in networks and unsheared is not None:
            poses[UNSHEARED] = predict_pose(POSENET, unsheared)
        if POSENET_SHEARED in networks:
            poses[LEARNT] = predict_pose(POSENET_SHEARED, values)
        return unsheared, poses

    return forward


def compile_networks(
    networks: Mapping[str, TrainedNetwork], with_sheared_poses: bool
) -> RunNetworks:
    """Compile `make_full_forward` with the weights of networks."""
    variables = {name: network.variables for name, network in networks.items()}
    return jit_for_inference(make_full_forward(networks, with_sheared_poses), variables)


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
