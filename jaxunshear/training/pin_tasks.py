"""What a training over pins does with a batch: losses as named terms per example, as in tasks.py.

`rest` (P, 2) px are the untouched pins, `spread` px how far pins move (root mean square), both of training examples alone. A field
{"weight"} (B,) weighs the examples; one whose pins are not sure should have none.
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
from jaxunshear.data.factorial import OTHER, SWAPPED
from jaxunshear.models import pin_networks, posenet
from jaxunshear.models.reconstruction import Reconstruction
from jaxunshear.training import losses
from jaxunshear.training.few_pairs import ANOTHER, ONE, TAPS
from jaxunshear.training.rotation import ANGLES, Rotations, rotate_outputs, rotate_pins
from jaxunshear.training.tasks import (
    Batch,
    Task,
    Tree,
    compute_code_terms,
    compute_pose_error_terms,
    list_loss_weights,
    make_pose_supervision,
    supervise_both_slides,
    weight_terms,
)


def make_pin_unshear_task(
    net: PinUnshear,
    training: Training,
    targets: Targets,
    rest: ArrayLike,
    spread: float,
    teacher: Callable[[Array], Array] | None = None,
    slides: Targets = (),
) -> Task:
    """Of PinUnshear; batches {"canonical_pins", "sheared_pins"} (B, P, 2) px, and where poses share slides {"other_pins",
    "swapped_pins"}, see `dataset.factorial`; where they don't, the pose code of a slide is to agree with its tap's alone. With {"tap_pins"}
    (T, P, 2) px taps are to come out as they went in, with {"one_pins", "another_pins"} (A, P, 2) px both alike.

    `teacher` is a trained PinPoseNet, pins (B, P, 2) px -> outputs (B, K), needed for `pose_weight` alone: what it reads off the
    unsheared pins should be the true pose (`pose_target` "label", with the fields of the targets in the batches), or what it reads off
    the partner. Raises UserError where it is lacking. `slides` are what z_s is taught of the slide, and need their fields in the batches.
    """
    watch = make_pose_supervision(training, teacher, targets, losses.compute_absolute_pose_loss)

    def compute_terms(variables: Tree, batch: Batch, found: Reconstruction) -> dict[str, Array]:
        off = partial(pin_networks.compute_pin_distance, variables=variables)
        named = {"supervised": supervise_both_slides(found, batch["canonical_pins"], off)}
        if watch:
            named["pose"] = watch(found.canonical, batch["canonical_pins"], batch)
        return weight_terms(
            named | compute_code_terms(found, ("sheared_pins", SWAPPED), off, batch, slides), batch
        )

    def decode(variables: Tree, batch: Batch, key: Array | None = None) -> Reconstruction:
        alike = (
            batch.get(SWAPPED, batch["canonical_pins"])
            if training.agreement_weight and net.shear_code
            else None
        )
        other = batch.get(OTHER) if training.swap_weight else None
        return pin_networks.reconstruct(net, variables, batch["sheared_pins"], key, alike, other)

    def unshear_noisy(variables: Tree, pins: Array, key: Array, number: int) -> Array:
        return pin_networks.unshear(
            net, variables, pin_networks.add_noise(net, pins, jax.random.fold_in(key, number))
        )

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[dict[str, Array], Tree]:
        named = compute_terms(variables, batch, decode(variables, batch, key))
        if TAPS in batch:
            named["tap"] = pin_networks.compute_pin_distance(
                unshear_noisy(variables, batch[TAPS], key, 2), batch[TAPS], variables
            )
        if ONE in batch:
            one, another = (
                unshear_noisy(variables, batch[ONE], key, 3),
                unshear_noisy(variables, batch[ANOTHER], key, 4),
            )
            named["alike"] = pin_networks.compute_pin_distance(one, another, variables)
        return named, variables["batch_stats"]

    def validate(variables: Tree, batch: Batch) -> dict[str, Array]:
        return compute_terms(variables, batch, decode(variables, batch))

    init = partial(pin_networks.init, net, rest, spread)
    return Task(
        "pin_unshear",
        net,
        targets,
        init,
        terms,
        list_loss_weights(training),
        validate,
        "supervised",
        slides,
    )


def make_pin_posenet_task(
    net: PinPoseNet,
    training: Training,
    targets: Targets,
    rest: ArrayLike,
    spread: float,
    rotations: Rotations | None = None,
    render: Callable[[Array], Array] | None = None,
) -> Task:
    """Of PinPoseNet; batches {"pins"} (B, P, 2) px and the fields of the targets. `rotations` are needed for `net.turned` alone.

    `render`, outputs (B, K) -> pins (B, P, 2) px, is a renderer that learnt from recorded taps: then as many rendered taps, at poses
    drawn anew, teach as recorded contacts. Unsheared pins are as smooth as these: a PoseNet of recorded taps alone reads them less well.
    """
    weights = posenet.list_output_weights(targets)

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[dict[str, Array], Tree]:
        pins = pin_networks.add_noise(net, batch["pins"], key)
        wanted, angle = posenet.scale_poses(batch, targets), jnp.zeros(())
        if rotations is not None:
            k = _drawn_turn(net.turned, jax.random.fold_in(key, 1))
            pins, wanted, angle = (
                rotate_pins(rotations, k, pins),
                rotate_outputs(rotations, k, wanted, targets),
                rotations.radians[k],
            )
        loss = losses.compute_absolute_pose_loss(
            pin_networks.predict(net, variables, pins, angle), wanted, weights
        )
        named = weight_terms({"pose": loss}, batch)
        if render is not None:
            drawn = posenet.sample_outputs(targets, len(pins), jax.random.fold_in(key, 3))
            rendered = pin_networks.add_noise(net, render(drawn), jax.random.fold_in(key, 4))
            named["rendered"] = losses.compute_absolute_pose_loss(
                pin_networks.predict(net, variables, rendered), drawn, weights
            )
        return named, variables["batch_stats"]

    def validate(variables: Tree, batch: Batch) -> dict[str, Array]:
        outputs = pin_networks.predict(net, variables, batch["pins"])
        loss = losses.compute_absolute_pose_loss(
            outputs, posenet.scale_poses(batch, targets), weights
        )
        return weight_terms(
            {"pose": loss} | compute_pose_error_terms(outputs, batch, targets), batch
        )

    init = partial(pin_networks.init, net, rest, spread, outputs=posenet.count_outputs(targets))
    return Task(
        "pin_posenet", net, targets, init, terms, {"pose": 1.0, "rendered": 1.0}, validate, "pose"
    )


def make_renderer_task(
    net: PinRenderer, training: Training, targets: Targets, rest: ArrayLike, spread: float
) -> Task:
    """Of PinRenderer; batches {"pins"} (B, P, 2) px of taps and the fields of the targets."""

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[dict[str, Array], Tree]:
        return validate(variables, batch), variables["batch_stats"]

    def validate(variables: Tree, batch: Batch) -> dict[str, Array]:
        drawn = pin_networks.render_pins(net, variables, posenet.scale_poses(batch, targets))
        return weight_terms(
            {"pins": pin_networks.compute_pin_distance(drawn, batch["pins"], variables)}, batch
        )

    init = partial(pin_networks.init, net, rest, spread, outputs=posenet.count_outputs(targets))
    return Task("renderer", net, targets, init, terms, {"pins": 1.0}, validate, "pins")


def _drawn_turn(share: float, key: Array) -> Array:
    """One angle for a batch: none, or with the chance `share` any of them."""
    chance_key, angle_key = jax.random.split(key)
    return jnp.where(
        jax.random.uniform(chance_key) < share, jax.random.randint(angle_key, (), 0, ANGLES), 0
    )
