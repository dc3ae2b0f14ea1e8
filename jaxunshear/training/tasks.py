"""Tasks: how a network turns a batch into the losses that its training names, per example.

Batches of pairs hold the fields `canonical` and `sheared` of the network's modality, those of one
contact after another its field `single`. A field {"weight"} (B,) weighs the examples, {"sure"} is 0
for those whose pins are not sure. The losses that need labels need their fields.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxunshear.angles import wrap_degrees
from jaxunshear.config.losses import LOSSES, SUPERVISION, LossSpec, Role, get_loss
from jaxunshear.config.networks import PinRenderer
from jaxunshear.config.targets import Targets, read_true_values
from jaxunshear.config.training import Training, uses_teacher
from jaxunshear.errors import UserError
from jaxunshear.models import pin_networks, posenet
from jaxunshear.models.modality import PINS, Batch
from jaxunshear.models.reconstruction import Reconstruction
from jaxunshear.models.registry import DataFacts, NetworkFunctions, get_functions
from jaxunshear.models.weights import Net, Tree, Variables
from jaxunshear.training.losses import PairInputs, PoseInputs
from jaxunshear.training.rotation import Rotations, rotate_outputs, rotate_pins, sample_rotation

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


class PinSupport(NamedTuple):
    """What a PoseNet over pins may learn from besides its batches."""

    rotations: Rotations | None = None  # for `net.turned`
    # for the loss "rendered_pose": outputs (B, K) -> pins (B, P, 2) px, by a trained renderer
    render: Callable[[Array], Array] | None = None


def make_unshear_task(
    net: Net,
    training: Training,
    supervision: Supervision = Supervision(),
    facts: DataFacts = DataFacts(),
) -> Task:
    """Make the task of a network that unshears.

    Codes that can be exchanged take partners where poses share slides, the fields `other` and
    `swapped` of the modality, see `data.factorial`; elsewhere the pose code of a slide is to agree
    with its tap's. The loss "tap_identity" needs {"tap_pins"} (T, P, 2) px, "consistency"
    {"one_pins", "another_pins"} (A, P, 2) px.

    Raises UserError where the network cannot be built, a loss lacks its teacher, or a crop does not
    fit.
    """
    functions, specs = get_functions(net), list_losses(training, "unshears")
    functions.check(net)
    if "patch" in training.losses:
        _check_crops(net, training)
    if uses_teacher(training):
        _check_teacher(supervision)
    modality, reconstruct = functions.modality, functions.reconstruct
    assert reconstruct is not None  # of every network that unshears

    def compute_terms(variables: Variables, batch: Batch, key: Array | None) -> tuple[Terms, Tree]:
        batch = modality.prepare(batch)
        partners = _choose_partners(functions, net, training, batch)
        outputs, statistics = reconstruct(net, variables, batch[modality.sheared], key, *partners)
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
        )
        possible = (spec for spec in specs if _has_parts(outputs, spec))
        return weight_terms(run_losses(possible, inputs, key), batch), statistics

    return Task(
        functions.kind,
        net,
        supervision.targets,
        partial(functions.init, net, facts),
        compute_terms,
        dict(training.losses),
        lambda variables, batch: compute_terms(variables, batch, None)[0],
        choose_rank(specs),
        supervision.slides,
    )


def _choose_partners(
    functions: NetworkFunctions, net: Net, training: Training, batch: Batch
) -> tuple[Array | None, Array | None]:
    """Choose inputs at the same poses and after the same slides, if codes are exchanged."""
    if not functions.count_slide_numbers(net):
        return None, None
    same_pose = same_slide = None
    if "code_agreement" in training.losses:
        modality = functions.modality
        same_pose = batch.get(modality.swapped, batch[modality.canonical])
    if "counterfactual" in training.losses:
        same_slide = batch.get(functions.modality.other)
    return same_pose, same_slide


def _check_teacher(supervision: Supervision) -> None:
    losses = " and ".join(SUPERVISION)
    if supervision.teacher is None:
        raise UserError(
            f"losses.{losses}: a PoseNet is needed to read the pose: "
            "train one first, or leave them out"
        )
    if not supervision.targets:
        raise UserError(f"losses.{losses}: no pose targets are known: give them, or leave them out")


def _check_crops(net: Net, training: Training) -> None:
    if not 0 < training.crop_px <= net.size:
        raise UserError(
            f"crop_px: crops of {training.crop_px} px do not fit images of {net.size} px"
        )
    if training.crops < 1:
        raise UserError(
            f"crops: {training.crops} of them leave no patch loss: use at least 1, "
            "or leave losses.patch out"
        )


def _has_parts(outputs: Reconstruction, spec: LossSpec) -> bool:
    return all(getattr(outputs, part) is not None for part in spec.parts)


def make_posenet_task(
    net: Net,
    training: Training,
    targets: Targets,
    facts: DataFacts = DataFacts(),
    support: PinSupport = PinSupport(),
) -> Task:
    """Make the task of a PoseNet, of batches of single contacts with the fields of `targets`.

    Raises UserError without targets.
    """
    if not targets:
        raise UserError("targets: there is no pose to learn: name some, or record labels")
    functions, specs = get_functions(net), list_losses(training, "reads poses")
    functions.check(net)
    modality, rotations = functions.modality, support.rotations
    predict, predict_training = functions.predict, functions.predict_training
    assert predict is not None and predict_training is not None  # of every PoseNet

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[Terms, Tree]:
        inputs = modality.add_noise(net, modality.scale(batch[modality.single]), key)
        poses, radians = posenet.scale_poses(batch, targets), jnp.zeros(())
        if rotations is not None:
            k = sample_rotation(net.turned, jax.random.fold_in(key, 1))
            inputs = rotate_pins(rotations, k, inputs)
            poses = rotate_outputs(rotations, k, poses, targets)
            radians = rotations.radians[k]
        outputs, statistics = predict_training(net, variables, inputs, radians)
        given = PoseInputs(
            batch, outputs, poses, net, variables, modality, targets, key, support.render
        )
        return _weight_recordings(run_losses(specs, given, key), batch), statistics

    def validate(variables: Tree, batch: Batch) -> Terms:
        outputs = predict(net, variables, modality.scale(batch[modality.single]))
        poses = posenet.scale_poses(batch, targets)
        given = PoseInputs(batch, outputs, poses, net, variables, modality, targets, None)
        computed = run_losses(specs, given, None)
        errors = compute_pose_error_terms(outputs, batch, targets)
        return weight_terms(computed | errors, batch)

    init = partial(functions.init, net, _count_outputs(facts, targets))
    rank = choose_rank(specs)
    return Task(functions.kind, net, targets, init, terms, dict(training.losses), validate, rank)


def make_renderer_task(
    net: PinRenderer, training: Training, targets: Targets, facts: DataFacts
) -> Task:
    """Make the task of PinRenderer, of batches {"pins"} (B, P, 2) px of taps and their labels."""
    functions, specs = get_functions(net), list_losses(training, "renders")

    def compute_terms(variables: Variables, batch: Batch, key: Array | None) -> Terms:
        poses = posenet.scale_poses(batch, targets)
        pins = pin_networks.render_pins(net, variables, poses)
        inputs = PoseInputs(batch, pins, poses, net, variables, PINS, targets, key)
        return weight_terms(run_losses(specs, inputs, key), batch)

    return Task(
        functions.kind,
        net,
        targets,
        partial(functions.init, net, _count_outputs(facts, targets)),
        lambda variables, batch, key: (
            compute_terms(variables, batch, key),
            variables["batch_stats"],
        ),
        dict(training.losses),
        lambda variables, batch: compute_terms(variables, batch, None),
        choose_rank(specs),
    )


def _count_outputs(facts: DataFacts, targets: Targets) -> DataFacts:
    return facts._replace(outputs=posenet.count_outputs(targets))


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


def _weight_recordings(terms: Terms, batch: Batch) -> Terms:
    """Weigh terms by their examples, other than those of rendered taps, which are all sure."""
    return {
        name: term if name == "rendered_pose" else weight_terms({name: term}, batch)[name]
        for name, term in terms.items()
    }
