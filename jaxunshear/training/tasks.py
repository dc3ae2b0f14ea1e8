"""Tasks: how a network turns a batch into the losses that its training names, per example.

Batches of pairs hold the fields `canonical` and `sheared` of the network's modality, those of one
contact after another its field `single`. A field {"weight"} (B,) weighs the examples, {"sure"} is 0
for those whose pins are not sure. The losses that need labels need their fields.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxunshear.config.losses import LOSSES, SUPERVISION, LossSpec, Role, get_loss
from jaxunshear.config.networks import PinRenderer
from jaxunshear.config.targets import Targets, count_outputs, read_true_values
from jaxunshear.config.training import Training, uses_teacher
from jaxunshear.config.types import raise_first_problem
from jaxunshear.errors import UserError
from jaxunshear.metrics.errors import compute_error
from jaxunshear.models import pin_networks, posenet
from jaxunshear.models.modality import PINS, Batch
from jaxunshear.models.registry import InitFacts, NetworkFunctions, get_functions
from jaxunshear.models.weights import Net, Tree, Variables
from jaxunshear.training.augmentation import Rotations, rotate_outputs, rotate_pins, sample_rotation
from jaxunshear.training.losses import PairInputs, PoseInputs

LABELS = {"labels", "slide_labels"}  # fields of losses, which do not turn with the pins
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
    selection_term: str  # the validation term that the best model is chosen by
    slide_targets: Targets = ()  # what z_s learns of the slide


class Supervision(NamedTuple):
    """Labels and a teacher that a network that unshears learns from, in addition to the taps."""

    targets: Targets = ()  # of poses: of the teacher, and of labels
    slides: Targets = ()  # what z_s learns of the slide
    # a trained PoseNet, images (B, S, S, 1) in [0, 1] or pins (B, P, 2) px -> outputs (B, K)
    teacher: Callable[[Array], Array] | None = None


class PinAugmentation(NamedTuple):
    """What a PoseNet over pins may learn from besides its batches."""

    rotations: Rotations | None = None  # for `net.rotated_share`
    # for the loss "rendered_pose": outputs (B, K) -> pins (B, P, 2) px, by a trained renderer
    render: Callable[[Array], Array] | None = None


def make_unshear_task(
    net: Net,
    training: Training,
    supervision: Supervision = Supervision(),
    facts: InitFacts = InitFacts(),
) -> Task:
    """Make the task of a network that unshears.

    If poses share slides (`FactorialReader`), the losses on codes take the fields `other` and
    `swapped` of the modality. Otherwise `code_agreement` compares a slide with its tap. The loss
    "tap_identity" needs {"tap_pins"} (T, P, 2) px, "consistency" {"one_pins", "another_pins"}
    (A, P, 2) px.

    Raises UserError where the network cannot be built, a loss lacks its teacher, or a crop does not
    fit.
    """
    functions = get_functions(net)
    if "patch" in training.losses:
        _check_crops(net, training)
    if uses_teacher(training):
        _check_teacher(supervision)
    modality, reconstruct = functions.modality, functions.reconstruct
    assert reconstruct is not None  # of every network that unshears

    def run(variables: Variables, batch: Batch, key: Array | None) -> tuple[PairInputs, Tree]:
        batch = modality.prepare(batch)
        partners = _choose_swap_partners(functions, net, training, batch)
        outputs, statistics = reconstruct(net, variables, batch[modality.sheared], key, *partners)
        unsheared = modality.to_output(outputs.canonical)
        inputs = PairInputs(
            batch, outputs, unsheared, net, variables, training, modality, *supervision, key
        )
        return inputs, statistics

    task = _make_task(net, "unshears", training, supervision.targets, facts, run)
    return replace(task, slide_targets=supervision.slides)


def give_tasks(task: Task, count: int) -> Task:
    """Give a network over pins the task, of `count`, of each contact, by its `stimulus`."""

    def give(variables: Tree, batch: Batch) -> Tree:
        return pin_networks.give_tasks(variables, jax.nn.one_hot(batch["stimulus"], count))

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[Terms, Tree]:
        values, statistics = task.terms(give(variables, batch), batch, key)
        return values, statistics | {"tasks": variables["batch_stats"]["tasks"]}

    def validate(variables: Tree, batch: Batch) -> Terms:
        return task.validate(give(variables, batch), batch)

    return replace(task, terms=terms, validate=validate)


def rotate_pairs(task: Task, rotate: Callable[[Batch, Array], tuple[Batch, Array]]) -> Task:
    """Rotate the batches that a network that unshears learns from, by `make_pair_rotation`.

    Losses that take labels are zero for batches that were rotated.
    """
    labelled = [name for name in task.weights if not LABELS.isdisjoint(get_loss(name).fields)]

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[Terms, Tree]:
        batch, is_rotated = rotate(batch, jax.random.fold_in(key, 2))
        values, statistics = task.terms(variables, batch, key)
        unknown = {name: jnp.where(is_rotated, 0, values[name]) for name in labelled}
        return values | unknown, statistics

    return replace(task, terms=terms)


def _choose_swap_partners(
    functions: NetworkFunctions, net: Net, training: Training, batch: Batch
) -> tuple[Array | None, Array | None]:
    """Choose second contacts at the same pose and after the same slide.

    The first are for the loss `code_agreement`, the others for `counterfactual`; without its loss
    each is None.
    """
    if not functions.count_slide_numbers(net):
        return None, None
    same_pose = same_slide = None
    if "code_agreement" in training.losses:
        modality = functions.modality
        same_pose = batch.get(modality.swapped, batch[modality.canonical])
    if "counterfactual" in training.losses:
        same_slide = batch.get(functions.modality.other)
    return same_pose, same_slide


def join_teachers(teachers: Sequence[Callable[[Array], Array]]) -> Callable[[Array], Array]:
    """Join PoseNets to one that gives the outputs of all of them."""
    if len(teachers) == 1:
        return teachers[0]
    return lambda contacts: jnp.concatenate([teach(contacts) for teach in teachers], -1)


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


def make_posenet_task(
    net: Net,
    training: Training,
    targets: Targets,
    facts: InitFacts = InitFacts(),
    support: PinAugmentation = PinAugmentation(),
) -> Task:
    """Make the task of a PoseNet, of batches of single contacts with the fields of `targets`.

    Raises UserError without targets.
    """
    if not targets:
        raise UserError("targets: there is no pose to learn: name some, or record labels")
    functions = get_functions(net)
    modality, rotations = functions.modality, support.rotations
    predict, predict_training = functions.predict, functions.predict_training
    assert predict is not None and predict_training is not None  # of every PoseNet

    def run(variables: Variables, batch: Batch, key: Array | None) -> tuple[PoseInputs, Tree]:
        contacts = modality.scale(batch[modality.single])
        if key is None:
            outputs, statistics = predict(net, variables, contacts), variables["batch_stats"]
            poses = posenet.scale_poses(batch, targets)
        else:
            contacts = modality.add_noise(net, contacts, key)
            poses, radians = posenet.scale_poses(batch, targets), jnp.zeros(())
            if rotations is not None:
                k = sample_rotation(net.rotated_share, jax.random.fold_in(key, 1))
                contacts = rotate_pins(rotations, k, contacts)
                poses = rotate_outputs(rotations, k, poses, targets)
                radians = rotations.radians[k]
            outputs, statistics = predict_training(net, variables, contacts, radians)
        inputs = PoseInputs(
            batch, outputs, poses, net, variables, modality, targets, key, support.render
        )
        return inputs, statistics

    return _make_task(net, "reads poses", training, targets, facts, run)


def make_renderer_task(
    net: PinRenderer, training: Training, targets: Targets, facts: InitFacts
) -> Task:
    """Make the task of PinRenderer, of batches {"pins"} (B, P, 2) px of taps and their labels."""

    def run(variables: Variables, batch: Batch, key: Array | None) -> tuple[PoseInputs, Tree]:
        poses = posenet.scale_poses(batch, targets)
        pins = pin_networks.render_pins(net, variables, poses)
        inputs = PoseInputs(batch, pins, poses, net, variables, PINS, targets, key)
        return inputs, variables["batch_stats"]

    return _make_task(net, "renders", training, targets, facts, run)


def _make_task(
    net: Net,
    role: Role,
    training: Training,
    targets: Targets,
    facts: InitFacts,
    run: Callable[[Variables, Batch, Array | None], tuple[PairInputs | PoseInputs, Tree]],
) -> Task:
    """Make the task of a network that `run` runs, without a key in validation."""
    functions, specs = get_functions(net), _list_losses(training, role)
    raise_first_problem(net, functions.kind)
    facts = facts._replace(outputs=count_outputs(targets))

    def compute_terms(variables: Variables, batch: Batch, key: Array | None) -> tuple[Terms, Tree]:
        inputs, statistics = run(variables, batch, key)
        terms = {}
        for spec in specs:
            has_parts = all(getattr(inputs.outputs, part) is not None for part in spec.parts)
            if has_parts and (key is not None or spec.is_validated):
                terms[spec.name] = spec.load()(inputs)
        if role == "reads poses" and key is None:
            assert isinstance(inputs.outputs, Array)
            terms |= compute_pose_error_terms(inputs.outputs, batch, targets)
        # rendered taps, which are no examples, are all sure
        weighed = [name for name in terms if name != "rendered_pose"]
        for field in ("weight", "sure"):
            if field in batch:
                terms |= {name: terms[name] * batch[field] for name in weighed}
        return terms, statistics

    return Task(
        functions.kind,
        net,
        targets,
        partial(functions.init, net, facts),
        compute_terms,
        dict(training.losses),
        lambda variables, batch: compute_terms(variables, batch, None)[0],
        next(spec.name for spec in specs if spec.is_validated),
    )


def _list_losses(training: Training, role: Role) -> list[LossSpec]:
    """Return the losses that a training names, in the order of the registry.

    Raises UserError for one that is unknown, or for networks of another role, and if none is
    computed in validation.
    """
    specs = [get_loss(name) for name in training.losses]
    for spec in specs:
        if spec.role != role:
            raise UserError(f"losses.{spec.name}: is for a network that {spec.role}: leave it out")
    if not any(spec.is_validated for spec in specs):
        names = ", ".join(training.losses)
        raise UserError(f"losses = {names}: none is computed in validation: name another, too")
    order = list(LOSSES)
    return sorted(specs, key=lambda spec: order.index(spec.name))


def compute_pose_error_terms(outputs: Array, batch: Batch, targets: Targets) -> Terms:
    """Compute absolute errors in mm and deg by target, each (B,)."""
    poses, true_poses = posenet.unscale_outputs(outputs, targets), read_true_values(targets, batch)
    return {
        name: compute_error(name, jnp.asarray(true_poses[name] - poses[name])) for name in poses
    }
