"""The losses. Each takes a batch and the network's outputs, and returns one number per example.

Losses of networks that unshear take `PairInputs`, losses of PoseNets and of the renderer
`PoseInputs`. `config/losses.py` lists them by the names that trainings use, with what each needs.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from jaxunshear.config.targets import Targets, are_of_tasks
from jaxunshear.config.training import Training
from jaxunshear.models import distances, pin_networks, posenet
from jaxunshear.models.modality import Batch, Modality
from jaxunshear.models.reconstruction import Reconstruction
from jaxunshear.models.weights import Net, Variables

# fields that `examples.add_single_contacts` adds
TAPS, ONE, ANOTHER = "tap_pins", "one_pins", "another_pins"
T = TypeVar("T")


class PairInputs(NamedTuple):
    """What a loss of pairs may read. Images are (B, S, S, 1) in [0, 1], pins (B, P, 2) px."""

    batch: Batch
    outputs: Reconstruction  # as the decoders return them: logits of images, or pins
    unsheared: Array  # images or pins: what the network made of the slides
    net: Net
    variables: Variables
    training: Training
    modality: Modality
    targets: Targets  # of poses
    slide_targets: Targets  # of z_s
    teacher: Callable[[Array], Array] | None  # images or pins -> outputs (B, K)
    key: Array | None  # None in validation

    @property
    def tap(self) -> Array:
        """The images or pins of the taps."""
        return self.batch[self.modality.canonical]

    def measure_distance(self, decoded: Array, field: str) -> Array:
        """Return how far what a decoder returned is from a field of the batch, (B,)."""
        return self.modality.measure_distance(decoded, self.batch[field], self.variables)


def compute_supervised_term(inputs: PairInputs) -> Array:
    """Compute L_sup.

    With the loss `code_agreement` it is the mean over the slide and a second contact at the same
    pose.
    """
    outputs, tap = inputs.outputs, inputs.modality.canonical
    distance = inputs.measure_distance(outputs.canonical, tap)
    if outputs.same_pose is None:
        return distance
    return 0.5 * (distance + inputs.measure_distance(outputs.same_pose, tap))


def compute_patch_term(inputs: PairInputs) -> Array:
    """Compute L_patch over random crops."""
    assert inputs.key is not None  # it is no loss of validation
    size, crops, side = inputs.net.size, inputs.training.crops, inputs.training.crop_px
    image = inputs.unsheared
    corners = distances.sample_corners(inputs.key, len(image), crops, size, side)
    counts = distances.count_crop_coverage(corners, size, side)
    return distances.compute_patch_loss(image, inputs.tap, counts)


def compute_reconstruction_term(inputs: PairInputs) -> Array:
    """Compute L_rec, between what DS decodes and the slide."""
    return inputs.measure_distance(_get(inputs.outputs.sheared), inputs.modality.sheared)


def compute_pose_label_term(inputs: PairInputs) -> Array:
    """Compare the pose that the teacher estimates of the unsheared contact with the true one.

    Poses of other tasks than the contact's own are NaN, and do not count.
    """
    return _compare_pose(inputs, posenet.scale_poses(inputs.batch, inputs.targets))


def compute_pose_tap_term(inputs: PairInputs) -> Array:
    """Compare the poses that the teacher estimates of the unsheared contact and of the tap."""
    return _compare_pose(inputs, _get(inputs.teacher)(inputs.tap))


def _compare_pose(inputs: PairInputs, target: Array) -> Array:
    weights = posenet.list_output_weights(inputs.targets)
    outputs = _get(inputs.teacher)(inputs.unsheared)
    if are_of_tasks(inputs.targets):
        target = jnp.where(jnp.isnan(target), outputs, target)
    return inputs.modality.compute_pose_loss(outputs, target, weights)


def compute_counterfactual_term(inputs: PairInputs) -> Array:
    """Compare what DS decodes from exchanged codes with the contact of that pose and slide."""
    return inputs.measure_distance(_get(inputs.outputs.counterfactual), inputs.modality.swapped)


def compute_code_agreement_term(inputs: PairInputs) -> Array:
    """Return how far apart the pose codes of two contacts at one pose are, over their variance."""
    return _get(inputs.outputs.disagreement)


def compute_slide_term(inputs: PairInputs) -> Array:
    """Compare z_s with the slide, shifts before rotations, scaled to [-1, 1] over its range."""
    target = 2 * posenet.scale_poses(inputs.batch, inputs.slide_targets) - 1
    z_s = _get(inputs.outputs.z_s)
    return distances.compute_slide_loss(z_s.reshape(z_s.shape[0], -1), target)


def compute_tap_identity_term(inputs: PairInputs) -> Array:
    """Compare taps without a slide with what unshearing makes of them."""
    taps = inputs.batch[TAPS]
    unsheared = _unshear_noisy(inputs, taps, 2)
    return inputs.modality.measure_distance(unsheared, taps, inputs.variables)


def compute_consistency_term(inputs: PairInputs) -> Array:
    """Compare what unshearing makes of two slides to one pose."""
    one = _unshear_noisy(inputs, inputs.batch[ONE], 3)
    another = _unshear_noisy(inputs, inputs.batch[ANOTHER], 4)
    return inputs.modality.measure_distance(one, another, inputs.variables)


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
    assert key is not None and render is not None  # `make_posenet_task` sees to it
    poses = posenet.sample_outputs(targets, len(inputs.scaled_poses), jax.random.fold_in(key, 3))
    pins = pin_networks.add_noise(inputs.net, render(poses), jax.random.fold_in(key, 4))
    outputs = pin_networks.predict(inputs.net, inputs.variables, pins)
    weights = posenet.list_output_weights(targets)
    return distances.compute_absolute_pose_loss(outputs, poses, weights)


def compute_pins_term(inputs: PoseInputs) -> Array:
    """Compare the renderer's pins with those of the tap."""
    return distances.compute_pin_distance(inputs.outputs, inputs.batch["pins"], inputs.variables)


def _unshear_noisy(inputs: PairInputs, pins: Array, number: int) -> Array:
    """Unshear pins with noise, which differs by its number."""
    noisy = pin_networks.add_noise(inputs.net, pins, jax.random.fold_in(_get(inputs.key), number))
    return pin_networks.unshear(inputs.net, inputs.variables, noisy)


def _get(value: T | None) -> T:
    assert value is not None  # `LossSpec.parts` and the checks of the settings see to it
    return value
