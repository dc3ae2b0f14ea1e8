"""What a training over pins does with a batch: losses as named terms per example, as in tasks.py.

`rest` (P, 2) px are the untouched pins, `spread` px how far pins move (root mean square), both of training examples alone. A field
{"weight"} (B,) weighs the examples; one whose pins are not sure should have none.
"""

from collections.abc import Callable
from functools import partial

import jax
from jax import Array
from jax.typing import ArrayLike

from jaxunshear.errors import UserError
from jaxunshear.model import pinnets, posenet
from jaxunshear.model.settings import PinPoseNet, PinRenderer, PinUnshear
from jaxunshear.targets import Targets
from jaxunshear.training import losses
from jaxunshear.training.settings import Training
from jaxunshear.training.tasks import Task, pose_error_terms, weighed


def pin_unshear_task(
    net: PinUnshear,
    training: Training,
    targets: Targets,
    rest: ArrayLike,
    spread: float,
    teacher: Callable[[Array], Array] | None = None,
    render: Callable[[Array], Array] | None = None,
) -> Task:
    """Of PinUnshear; batches {"canonical_pins", "sheared_pins"} (B, P, 2) px, and the fields of the targets where there is a teacher by
    labels, or a renderer.

    `teacher` is a trained PinPoseNet, pins (B, P, 2) px -> outputs (B, K), needed for `pose_weight` alone: what it reads off the
    unsheared pins should be the true pose (`pose_target` "label"), or what it reads off the partner. With `render`, outputs (B, K) ->
    pins of a tap there, slides are seen at other poses, too (`net.jitter`): their pins and their partner's move as a tap's would.
    Raises UserError where a teacher is lacking.
    """
    if training.pose_weight and teacher is None:
        raise UserError("pose_weight: a PoseNet is needed to read the pose: train one first, or use pose_weight 0")
    by_label = training.pose_weight > 0 and training.pose_target == "label"

    def watched(image, partner, pose):
        if not training.pose_weight or teacher is None:
            return {}
        wanted = pose if by_label else teacher(partner)
        return {"pose": losses.absolute_pose(teacher(image), wanted, posenet.output_weights(targets))}

    def elsewhere(batch, key):
        """Sheared pins, partner and pose, moved along."""
        sheared, partner = batch["sheared_pins"], batch["canonical_pins"]
        if render is None or not net.jitter:
            return sheared, partner, posenet.pose_targets(batch, targets) if by_label else None
        pose = posenet.pose_targets(batch, targets)
        other = posenet.jittered(pose, targets, net.jitter, key)
        shift = render(other) - render(pose)
        return sheared + shift, partner + shift, other

    def terms(variables, batch, key):
        pose_key, noise_key = jax.random.split(key)
        pins, partner, pose = elsewhere(batch, pose_key)
        canonical, sheared = pinnets.reconstruct(net, variables, pins, noise_key)
        named = {"supervised": pinnets.distance(canonical, partner, variables)} | watched(canonical, partner, pose)
        if sheared is not None:
            named["reconstruction"] = pinnets.distance(sheared, pins, variables)
        return weighed(named, batch), variables["batch_stats"]

    def validate(variables, batch):
        pins, partner = batch["sheared_pins"], batch["canonical_pins"]
        z_p, z_s = pinnets.encode(net, variables, pins)
        canonical = pinnets.decode_canonical(net, variables, z_p)
        pose = posenet.pose_targets(batch, targets) if by_label else None
        named = {"supervised": pinnets.distance(canonical, partner, variables)} | watched(canonical, partner, pose)
        if z_s is not None:
            sheared = pinnets.decode_sheared(net, variables, z_p, z_s)
            named["reconstruction"] = pinnets.distance(sheared, pins, variables)
        return weighed(named, batch)

    weights = {"supervised": 1.0, "reconstruction": training.reconstruction_weight, "pose": training.pose_weight}
    init = partial(pinnets.init, net, rest, spread)
    return Task("pin_unshear", net, targets, init, terms, weights, validate, "supervised")


def pin_posenet_task(net: PinPoseNet, training: Training, targets: Targets, rest: ArrayLike, spread: float) -> Task:
    """Of PinPoseNet; batches {"pins"} (B, P, 2) px and the fields of the targets."""
    weights = posenet.output_weights(targets)

    def terms(variables, batch, key):
        outputs = pinnets.predict(net, variables, pinnets.spoilt(net, batch["pins"], key))
        loss = losses.absolute_pose(outputs, posenet.pose_targets(batch, targets), weights)
        return weighed({"pose": loss}, batch), variables["batch_stats"]

    def validate(variables, batch):
        outputs = pinnets.predict(net, variables, batch["pins"])
        loss = losses.absolute_pose(outputs, posenet.pose_targets(batch, targets), weights)
        return weighed({"pose": loss} | pose_error_terms(outputs, batch, targets), batch)

    init = partial(pinnets.init, net, rest, spread, outputs=posenet.outputs_of(targets))
    return Task("pin_posenet", net, targets, init, terms, {"pose": 1.0}, validate, "pose")


def renderer_task(net: PinRenderer, training: Training, targets: Targets, rest: ArrayLike, spread: float) -> Task:
    """Of PinRenderer; batches {"pins"} (B, P, 2) px of taps and the fields of the targets."""

    def terms(variables, batch, key):
        drawn = pinnets.render(net, variables, posenet.pose_targets(batch, targets))
        return weighed({"pins": pinnets.distance(drawn, batch["pins"], variables)}, batch), variables["batch_stats"]

    def validate(variables, batch):
        drawn = pinnets.render(net, variables, posenet.pose_targets(batch, targets))
        return weighed({"pins": pinnets.distance(drawn, batch["pins"], variables)}, batch)

    init = partial(pinnets.init, net, rest, spread, outputs=posenet.outputs_of(targets))
    return Task("renderer", net, targets, init, terms, {"pins": 1.0}, validate, "pins")
