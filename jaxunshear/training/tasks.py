"""Tasks: how a network turns a batch into the losses that its training names, per example."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxunshear.angles import wrap_degrees
from jaxunshear.config import networks
from jaxunshear.config.losses import LOSSES, SUPERVISION, LossSpec, Role, get_loss
from jaxunshear.config.targets import Targets, read_true_values
from jaxunshear.config.training import Training, uses_teacher
from jaxunshear.errors import UserError
from jaxunshear.models import posenet, unet, unshearnet
from jaxunshear.models.modality import IMAGES, Batch, Modality
from jaxunshear.models.reconstruction import Reconstruction
from jaxunshear.models.weights import Net, Tree, Variables
from jaxunshear.training.pair_losses import PairInputs
from jaxunshear.training.pose_losses import PoseInputs

Terms = dict[str, Array]  # losses per example (B,), by name


@dataclass(frozen=True)
class Task:
    """What a network learns: its losses, per example, in training and in validation."""

    kind: str
    net: Net  # the network's settings
    targets: Targets
    init: Callable[[Array], Tree]
    terms: Callable[[Tree, Batch, Array], tuple[Terms, Tree]]  # of variables, batch and key
    weights: dict[str, float]
    validate: Callable[[Tree, Batch], Terms]
    rank: str  # the validation term that the best model is chosen by
    slide_targets: Targets = ()  # what z_s learns of the slide


class Supervision(NamedTuple):
    """Labels and a teacher that a network that unshears learns from, in addition to the taps."""

    targets: Targets = ()  # of poses: of the teacher, and of labels
    slides: Targets = ()  # what z_s learns of the slide
    # a trained PoseNet, images (B, S, S, 1) in [0, 1] or pins (B, P, 2) px -> outputs (B, K)
    teacher: Callable[[Array], Array] | None = None


class PairPasses(NamedTuple):
    """How a network that unshears is run."""

    init: Callable[[Array], Variables]
    # variables, batch, key -> what the decoders make of the batch, and new running statistics
    train: Callable[[Variables, Batch, Array], tuple[Reconstruction, Tree]]
    validate: Callable[[Variables, Batch], Reconstruction]
    # variables, key, pins, number of the noise -> pins; None over images
    unshear_noisy: Callable[[Variables, Array, Array, int], Array] | None = None


def make_unshear_task(
    net: networks.UnshearNet | networks.UNet,
    training: Training,
    supervision: Supervision = Supervision(),
) -> Task:
    """Make the task of an UnshearNet or a U-Net, of batches {"canonical", "sheared"}.

    Both are uint8 (B, S, S, 1) of {0, 255}. A field {"weight"} (B,) weighs the examples. Codes that
    are `apart` take partners where poses share slides, {"other", "swapped"} as above, see
    `data.factorial`; elsewhere the pose code of a slide is to agree with its tap's. The losses that
    need labels need their fields.

    Raises UserError where the network cannot be built, a loss lacks its teacher, or a crop does not
    fit.
    """
    _check_crops(net, training)
    if isinstance(net, networks.UNet):
        unet.check_net(net)
        passes = PairPasses(
            partial(unet.init, net), partial(_run_unet, net), partial(_validate_unet, net)
        )
        return make_pair_task("unet", net, training, IMAGES, passes, supervision)
    unshearnet.check_net(net)
    passes = PairPasses(
        partial(unshearnet.init, net),
        partial(_run_unshearnet, net, training),
        partial(_validate_unshearnet, net),
    )
    return make_pair_task("unshear", net, training, IMAGES, passes, supervision)


def _run_unet(
    net: networks.UNet, variables: Variables, batch: Batch, key: Array
) -> tuple[Reconstruction, Tree]:
    return unet.reconstruct(net, variables, batch[IMAGES.sheared])


def _validate_unet(net: networks.UNet, variables: Variables, batch: Batch) -> Reconstruction:
    return Reconstruction(unet.compute_logits(net, variables, batch[IMAGES.sheared]))


def _run_unshearnet(
    net: networks.UnshearNet, training: Training, variables: Variables, batch: Batch, key: Array
) -> tuple[Reconstruction, Tree]:
    same_pose = same_slide = None
    if net.disentangled and net.apart:
        if "code_agreement" in training.losses:
            same_pose = batch.get(IMAGES.swapped, batch[IMAGES.canonical])
        if "counterfactual" in training.losses:
            same_slide = batch[IMAGES.other]
    return unshearnet.reconstruct(net, variables, batch[IMAGES.sheared], same_pose, same_slide)


def _validate_unshearnet(
    net: networks.UnshearNet, variables: Variables, batch: Batch
) -> Reconstruction:
    z_p, z_s = unshearnet.encode(net, variables, batch[IMAGES.sheared])
    sheared = None if z_s is None else unshearnet.decode_sheared(net, variables, z_p, z_s)
    canonical = unshearnet.decode_canonical(net, variables, z_p)
    return Reconstruction(canonical, z_p, sheared, z_s=z_s)


def make_pair_task(
    kind: str,
    net: Net,
    training: Training,
    modality: Modality,
    passes: PairPasses,
    supervision: Supervision,
) -> Task:
    """Make the task of a network that unshears. Raises UserError where a loss lacks its teacher."""
    if uses_teacher(training):
        _check_teacher(supervision)
    specs = list_losses(training, "unshears")

    def compute_terms(
        variables: Variables, batch: Batch, outputs: Reconstruction, key: Array | None
    ) -> Terms:
        unshear_noisy = None
        if passes.unshear_noisy is not None and key is not None:
            unshear_noisy = partial(passes.unshear_noisy, variables, key)
        inputs = PairInputs(
            batch,
            outputs,
            modality.to_output(outputs.canonical),
            net,
            variables,
            training,
            modality,
            supervision.targets,
            supervision.slides,
            supervision.teacher,
            key,
            unshear_noisy,
        )
        possible = (spec for spec in specs if _has_parts(outputs, spec))
        return weight_terms(run_losses(possible, inputs, key), batch)

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[Terms, Tree]:
        batch = modality.prepare(batch)
        outputs, batch_stats = passes.train(variables, batch, key)
        return compute_terms(variables, batch, outputs, key), batch_stats

    def validate(variables: Tree, batch: Batch) -> Terms:
        batch = modality.prepare(batch)
        return compute_terms(variables, batch, passes.validate(variables, batch), None)

    return Task(
        kind,
        net,
        supervision.targets,
        passes.init,
        terms,
        dict(training.losses),
        validate,
        choose_rank(specs),
        supervision.slides,
    )


def _check_teacher(supervision: Supervision) -> None:
    if supervision.teacher is None:
        raise UserError(
            f"losses.{' and '.join(SUPERVISION)}: a PoseNet is needed to read the pose: "
            "train one first, or leave them out"
        )
    if not supervision.targets:
        raise UserError(
            f"losses.{' and '.join(SUPERVISION)}: no pose targets are known: "
            "give them, or leave them out"
        )


def _has_parts(outputs: Reconstruction, spec: LossSpec) -> bool:
    return all(getattr(outputs, part) is not None for part in spec.parts)


def list_losses(training: Training, role: Role) -> list[LossSpec]:
    """Return the losses that a training names, in the order of the registry.

    Raises UserError for one that is unknown, or for networks of another role.
    """
    specs = [get_loss(name) for name in training.losses]
    for spec in specs:
        if spec.role != role:
            raise UserError(f"losses.{spec.name}: is for a network that {spec.role}: leave it out")
    order = list(LOSSES)
    return sorted(specs, key=lambda spec: order.index(spec.name))


def choose_rank(specs: list[LossSpec]) -> str:
    """Return the loss that the best model is chosen by: the first that validation computes.

    Raises UserError where there is none.
    """
    for spec in specs:
        if spec.is_validated:
            return spec.name
    names = ", ".join(spec.name for spec in specs)
    raise UserError(f"losses = {names}: none is computed in validation: name another, too")


def run_losses(specs: Iterable[LossSpec], inputs: Any, key: Array | None) -> Terms:
    """Compute losses by name; without a key, only those of validation."""
    return {
        spec.name: spec.load()(inputs) for spec in specs if key is not None or spec.is_validated
    }


def make_posenet_task(net: networks.PoseNet, training: Training, targets: Targets) -> Task:
    """Make the task of PoseNet, of batches {"image"} and the fields of `targets`.

    Images are uint8 (B, S, S, 1). Raises UserError without targets.
    """
    if not targets:
        raise UserError("targets: there is no pose to learn: name some, or record labels")
    posenet.check_net(net)
    specs = list_losses(training, "reads poses")

    def compute_terms(
        variables: Variables, batch: Batch, outputs: Array, key: Array | None
    ) -> Terms:
        poses = posenet.scale_poses(batch, targets)
        inputs = PoseInputs(batch, outputs, poses, net, variables, IMAGES, targets, key)
        return run_losses(specs, inputs, key)

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[Terms, Tree]:
        images = IMAGES.scale(batch["image"])
        outputs, batch_stats = posenet.predict_training(net, variables, images)
        return compute_terms(variables, batch, outputs, key), batch_stats

    def validate(variables: Tree, batch: Batch) -> Terms:
        outputs = posenet.predict(net, variables, IMAGES.scale(batch["image"]))
        computed = compute_terms(variables, batch, outputs, None)
        return computed | compute_pose_error_terms(outputs, batch, targets)

    init = partial(posenet.init, net, posenet.count_outputs(targets))
    rank = choose_rank(specs)
    return Task("posenet", net, targets, init, terms, dict(training.losses), validate, rank)


def _check_crops(net: networks.UnshearNet | networks.UNet, training: Training) -> None:
    if not 0 < training.crop_px <= net.size:
        raise UserError(
            f"crop_px: crops of {training.crop_px} px do not fit images of {net.size} px"
        )
    if "patch" in training.losses and training.crops < 1:
        raise UserError(
            f"crops: {training.crops} of them leave no patch loss: use at least 1, "
            "or leave losses.patch out"
        )


def compute_pose_error_terms(outputs: Array, batch: Batch, targets: Targets) -> Terms:
    """Compute absolute errors in mm and deg by target, each (B,)."""
    poses, true_poses = posenet.unscale_outputs(outputs, targets), read_true_values(targets, batch)
    errors = {name: true_poses[name] - poses[name] for name in poses}
    return {
        name: jnp.abs(wrap_degrees(error) if name.endswith("_deg") else error)
        for name, error in errors.items()
    }


def weight_terms(terms: Terms, batch: Batch) -> Terms:
    """Weigh terms (B,) by the "weight" of their examples, and by "sure", 0 for unsure pins."""
    for field in ("weight", "sure"):
        if field in batch:
            terms = {name: term * batch[field] for name, term in terms.items()}
    return terms
