"""The losses of PoseNets and of the renderer, each a function of `PoseInputs` to losses (B,).

`config/losses.py` lists them by the names that trainings use.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
from jax import Array

from jaxunshear.config.targets import Targets
from jaxunshear.models import distances, pin_networks, posenet
from jaxunshear.models.modality import Batch, Modality
from jaxunshear.models.weights import Net, Variables


class PoseInputs(NamedTuple):
    """What a loss of poses may read."""

    batch: Batch
    outputs: Array  # of a PoseNet (B, K), or the renderer's pins (B, P, 2) px
    scaled_poses: Array  # (B, K) what a PoseNet's outputs should be
    net: Net
    variables: Variables
    modality: Modality
    targets: Targets
    key: Array | None  # None in validation
    render: Callable[[Array], Array] | None = None  # scaled poses (B, K) -> pins (B, P, 2) px


def compute_pose_term(inputs: PoseInputs) -> Array:
    """Compare a PoseNet's outputs with the true poses."""
    weights = posenet.list_output_weights(inputs.targets)
    return inputs.modality.compute_pose_loss(inputs.outputs, inputs.scaled_poses, weights)


def compute_rendered_pose_term(inputs: PoseInputs) -> Array:
    """Compute the pose loss of a PoseNet over pins on as many rendered taps, at random poses.

    Unsheared pins are as smooth as rendered ones: a PoseNet that learnt recorded taps alone
    estimates their poses less well.
    """
    key, render, targets = inputs.key, inputs.render, inputs.targets
    assert key is not None and render is not None  # `make_pin_posenet_task` sees to it
    poses = posenet.sample_outputs(targets, len(inputs.scaled_poses), jax.random.fold_in(key, 3))
    pins = pin_networks.add_noise(inputs.net, render(poses), jax.random.fold_in(key, 4))
    outputs = pin_networks.predict(inputs.net, inputs.variables, pins)
    weights = posenet.list_output_weights(targets)
    return distances.compute_absolute_pose_loss(outputs, poses, weights)


def compute_pin_term(inputs: PoseInputs) -> Array:
    """Compare the renderer's pins with those of the tap."""
    return distances.compute_pin_distance(inputs.outputs, inputs.batch["pins"], inputs.variables)
