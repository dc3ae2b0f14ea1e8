"""Tasks of networks over pins, see tasks.py.

`rest` (P, 2) px are the untouched pins, `spread` px is how far pins move (root mean square), both
of training examples alone. A field {"weight"} (B,) weighs the examples; an example whose pins are
not sure should have none.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxunshear.config.networks import PinPoseNet, PinRenderer, PinUnshear
from jaxunshear.config.targets import Targets
from jaxunshear.config.training import Training
from jaxunshear.models import pin_networks, posenet
from jaxunshear.models.modality import PINS, Batch
from jaxunshear.models.reconstruction import Reconstruction
from jaxunshear.models.weights import Variables
from jaxunshear.training.pose_losses import PoseInputs
from jaxunshear.training.rotation import ANGLES, Rotations, rotate_outputs, rotate_pins
from jaxunshear.training.tasks import (
    PairPasses,
    Supervision,
    Task,
    Terms,
    Tree,
    choose_rank,
    compute_pose_error_terms,
    list_losses,
    make_pair_task,
    run_losses,
    weight_terms,
)


def make_pin_unshear_task(
    net: PinUnshear,
    training: Training,
    rest: ArrayLike,
    spread: float,
    supervision: Supervision = Supervision(),
) -> Task:
    """Make the task of PinUnshear, of batches {"canonical_pins", "sheared_pins"} (B, P, 2) px.

    Where poses share slides {"other_pins", "swapped_pins"} come with them, see `data.factorial`;
    elsewhere the pose code of a slide is to agree with its tap's. The loss "tap_identity" needs
    {"tap_pins"} (T, P, 2) px, "consistency" {"one_pins", "another_pins"} (A, P, 2) px. Raises
    UserError where a loss lacks its teacher.
    """

    def decode(variables: Variables, batch: Batch, key: Array | None = None) -> Reconstruction:
        same_pose = same_slide = None
        if "code_agreement" in training.losses and net.shear_code:
            same_pose = batch.get(PINS.swapped, batch[PINS.canonical])
        if "counterfactual" in training.losses:
            same_slide = batch.get(PINS.other)
        pins = batch[PINS.sheared]
        return pin_networks.reconstruct(net, variables, pins, key, same_pose, same_slide)

    def train(variables: Variables, batch: Batch, key: Array) -> tuple[Reconstruction, Tree]:
        return decode(variables, batch, key), variables["batch_stats"]

    def unshear_noisy(variables: Variables, key: Array, pins: Array, number: int) -> Array:
        pins = pin_networks.add_noise(net, pins, jax.random.fold_in(key, number))
        return pin_networks.unshear(net, variables, pins)

    init = partial(pin_networks.init, net, rest, spread)
    passes = PairPasses(init, train, decode, unshear_noisy)
    return make_pair_task("pin_unshear", net, training, PINS, passes, supervision)


def make_pin_posenet_task(
    net: PinPoseNet,
    training: Training,
    targets: Targets,
    rest: ArrayLike,
    spread: float,
    rotations: Rotations | None = None,
    render: Callable[[Array], Array] | None = None,
) -> Task:
    """Make the task of PinPoseNet, of batches {"pins"} (B, P, 2) px and the fields of the targets.

    `rotations` are needed for `net.turned` alone. The loss "rendered_pose" takes `render`: outputs
    (B, K) -> pins (B, P, 2) px, a renderer that learnt from recorded taps.
    """
    specs = list_losses(training, "reads poses")

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[Terms, Tree]:
        pins = pin_networks.add_noise(net, batch["pins"], key)
        poses, angle = posenet.scale_poses(batch, targets), jnp.zeros(())
        if rotations is not None:
            k = _sample_rotation(net.turned, jax.random.fold_in(key, 1))
            pins = rotate_pins(rotations, k, pins)
            poses = rotate_outputs(rotations, k, poses, targets)
            angle = rotations.radians[k]
        outputs = pin_networks.predict(net, variables, pins, angle)
        inputs = PoseInputs(batch, outputs, poses, net, variables, PINS, targets, key, render)
        computed = run_losses(specs, inputs, key)
        return _weight_recordings(computed, batch), variables["batch_stats"]

    def validate(variables: Tree, batch: Batch) -> Terms:
        outputs = pin_networks.predict(net, variables, batch["pins"])
        poses = posenet.scale_poses(batch, targets)
        inputs = PoseInputs(batch, outputs, poses, net, variables, PINS, targets, None)
        computed = run_losses(specs, inputs, None)
        errors = compute_pose_error_terms(outputs, batch, targets)
        return weight_terms(computed | errors, batch)

    init = partial(pin_networks.init, net, rest, spread, outputs=posenet.count_outputs(targets))
    rank = choose_rank(specs)
    return Task("pin_posenet", net, targets, init, terms, dict(training.losses), validate, rank)


def _weight_recordings(terms: Terms, batch: Batch) -> Terms:
    """Weigh terms by their examples, other than those of rendered taps, which are all sure."""
    return {
        name: term if name == "rendered_pose" else weight_terms({name: term}, batch)[name]
        for name, term in terms.items()
    }


def make_renderer_task(
    net: PinRenderer, training: Training, targets: Targets, rest: ArrayLike, spread: float
) -> Task:
    """Make the task of PinRenderer, of batches {"pins"} (B, P, 2) px of taps and their labels."""
    specs = list_losses(training, "renders")

    def compute_terms(variables: Variables, batch: Batch, key: Array | None) -> Terms:
        poses = posenet.scale_poses(batch, targets)
        pins = pin_networks.render_pins(net, variables, poses)
        inputs = PoseInputs(batch, pins, poses, net, variables, PINS, targets, key)
        return weight_terms(run_losses(specs, inputs, key), batch)

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[Terms, Tree]:
        return compute_terms(variables, batch, key), variables["batch_stats"]

    def validate(variables: Tree, batch: Batch) -> Terms:
        return compute_terms(variables, batch, None)

    init = partial(pin_networks.init, net, rest, spread, outputs=posenet.count_outputs(targets))
    rank = choose_rank(specs)
    return Task("renderer", net, targets, init, terms, dict(training.losses), validate, rank)


def _sample_rotation(share: float, key: Array) -> Array:
    """Sample one angle for a batch: any of them with probability `share`, else none."""
    chance_key, angle_key = jax.random.split(key)
    is_rotated = jax.random.uniform(chance_key) < share
    return jnp.where(is_rotated, jax.random.randint(angle_key, (), 0, ANGLES), 0)
