"""The losses of networks that unshear, each a function of `PairInputs` to losses (B,).

`config/losses.py` lists them by the names that trainings use, with what each needs.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

from jax import Array

from jaxunshear.config.targets import Targets
from jaxunshear.config.training import Training
from jaxunshear.models import distances, posenet
from jaxunshear.models.modality import Batch, Modality
from jaxunshear.models.reconstruction import Reconstruction
from jaxunshear.models.weights import Net, Variables
from jaxunshear.training.few_pairs import ANOTHER, ONE, TAPS

T = TypeVar("T")


class PairInputs(NamedTuple):
    """What a loss of pairs may read. Images are (B, S, S, 1) in [0, 1], pins (B, P, 2) px."""

    batch: Batch
    outputs: Reconstruction  # as the decoders return them: logits of images, or pins
    canonical: Array  # the unsheared images or pins
    net: Net
    variables: Variables
    training: Training
    modality: Modality
    targets: Targets  # of poses
    slide_targets: Targets  # of z_s
    teacher: Callable[[Array], Array] | None  # images or pins -> outputs (B, K)
    key: Array | None  # None in validation
    unshear_noisy: Callable[[Array, int], Array] | None  # pins, a number of their noise -> pins

    @property
    def tap(self) -> Array:
        """The images or pins of the taps."""
        return self.batch[self.modality.canonical]

    def measure_distance(self, decoded: Array, field: str) -> Array:
        """Return how far what a decoder returned is from a field of the batch, (B,)."""
        return self.modality.measure_distance(decoded, self.batch[field], self.variables)


def compute_supervised_term(inputs: PairInputs) -> Array:
    """Compute L_sup, averaged with that of a partner at the same pose where codes should agree."""
    outputs, tap = inputs.outputs, inputs.modality.canonical
    distance = inputs.measure_distance(outputs.canonical, tap)
    if outputs.same_pose is None:
        return distance
    return 0.5 * (distance + inputs.measure_distance(outputs.same_pose, tap))


def compute_patch_term(inputs: PairInputs) -> Array:
    """Compute L_patch over random crops."""
    assert inputs.key is not None  # it is no loss of validation
    size, crops, side = inputs.net.size, inputs.training.crops, inputs.training.crop_px
    image = inputs.canonical
    corners = distances.sample_corners(inputs.key, len(image), crops, size, side)
    counts = distances.count_crop_coverage(corners, size, side)
    return distances.compute_patch_loss(image, inputs.tap, counts)


def compute_reconstruction_term(inputs: PairInputs) -> Array:
    """Compute L_rec, between what DS decodes and the slide."""
    return inputs.measure_distance(_get(inputs.outputs.sheared), inputs.modality.sheared)


def compute_pose_label_term(inputs: PairInputs) -> Array:
    """Compare the pose that the teacher estimates of the unsheared contact with the true one."""
    return _compare_pose(inputs, posenet.scale_poses(inputs.batch, inputs.targets))


def compute_pose_tap_term(inputs: PairInputs) -> Array:
    """Compare the poses that the teacher estimates of the unsheared contact and of the tap."""
    return _compare_pose(inputs, _get(inputs.teacher)(inputs.tap))


def _compare_pose(inputs: PairInputs, target: Array) -> Array:
    weights = posenet.list_output_weights(inputs.targets)
    outputs = _get(inputs.teacher)(inputs.canonical)
    return inputs.modality.compute_pose_loss(outputs, target, weights)


def compute_counterfactual_term(inputs: PairInputs) -> Array:
    """Compare what DS decodes from exchanged codes with the contact of that pose and slide."""
    return inputs.measure_distance(_get(inputs.outputs.counterfactual), inputs.modality.swapped)


def compute_code_agreement_term(inputs: PairInputs) -> Array:
    """Return the difference of the pose codes of two contacts at one pose."""
    return _get(inputs.outputs.disagreement)


def compute_slide_term(inputs: PairInputs) -> Array:
    """Compare z_s with the slide, shifts before rotations, scaled to [-1, 1] over its range."""
    target = 2 * posenet.scale_poses(inputs.batch, inputs.slide_targets) - 1
    z_s = _get(inputs.outputs.z_s)
    return distances.compute_slide_loss(z_s.reshape(z_s.shape[0], -1), target)


def compute_tap_identity_term(inputs: PairInputs) -> Array:
    """Compare taps without a slide with what unshearing makes of them."""
    taps = inputs.batch[TAPS]
    unsheared = _get(inputs.unshear_noisy)(taps, 2)
    return inputs.modality.measure_distance(unsheared, taps, inputs.variables)


def compute_consistency_term(inputs: PairInputs) -> Array:
    """Compare what unshearing makes of two slides to one pose."""
    unshear = _get(inputs.unshear_noisy)
    one, another = unshear(inputs.batch[ONE], 3), unshear(inputs.batch[ANOTHER], 4)
    return inputs.modality.measure_distance(one, another, inputs.variables)


def _get(value: T | None) -> T:
    assert value is not None  # `LossSpec.parts` and the rules of the settings see to it
    return value
