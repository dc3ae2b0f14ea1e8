"""Make the task of a network of an experiment, and choose the fields of its examples."""

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import numpy as np
from jax import Array

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.losses import get_loss
from jaxunshear.config.network_config import resolve_network
from jaxunshear.config.networks import ENTANGLED_LARGE, RENDERER
from jaxunshear.config.targets import list_label_fields
from jaxunshear.config.training import Training, uses_teacher
from jaxunshear.data.sources import Examples, Teacher, open_source
from jaxunshear.errors import UserError
from jaxunshear.models import pin_networks
from jaxunshear.models.modality import PINS, Batch
from jaxunshear.models.registry import InitFacts, get_functions, get_net_modality
from jaxunshear.models.unshearnet import match_entangled_size
from jaxunshear.models.weights import Net
from jaxunshear.training import tasks
from jaxunshear.training.augmentation import (
    Rotations,
    find_rotation_sense,
    make_pair_rotation,
    make_randomisation,
    make_rotations,
)
from jaxunshear.training.examples import (
    HelperLoader,
    load_helper,
    measure_pin_spread,
    read_all_training,
)
from jaxunshear.training.provenance import check_origin

MAX_ROTATED = 0.5  # share of the batches; with more, errors were larger (trials)


def make_task(
    experiment: Experiment, network: str, examples: Examples, folder: Path
) -> tuple[tasks.Task, tuple[str, ...]]:
    """Make the task of `network`, and list the fields of a batch that it takes.

    Helper networks are loaded from `folder`, the run's. Raises UserError.
    """
    config, source = resolve_network(experiment, network), open_source(experiment)
    net: Net = config.net
    training, targets = config.training, examples.targets
    if network == ENTANGLED_LARGE:
        net = match_entangled_size(net)
    modality = get_net_modality(net)
    field = modality.single if config.spec.learns_from == "taps" else modality.sheared
    fields: tuple[str, ...] = (field, *list_label_fields(targets))
    facts = _describe_pins(examples, field) if modality is PINS else InitFacts()
    if config.spec.role == "renders":
        task = tasks.make_renderer_task(net, training, targets, facts)
    elif config.spec.role == "reads poses":
        rotations = _make_rotations(examples) if getattr(net, "rotated_share", 0) else None
        render = None
        if "rendered_pose" in training.losses:
            renderer = load_helper(folder / RENDERER, "other networks")
            check_origin(experiment, RENDERER, folder)
            render = partial(pin_networks.render_pins, renderer.net, renderer.variables)
        support = tasks.PinAugmentation(rotations, render)
        task = tasks.make_posenet_task(net, training, targets, facts, support)
    else:
        load_teacher = HelperLoader(experiment, folder, folder).load_teacher
        supervision = _supervise(net, training, examples, load_teacher)
        task = tasks.make_unshear_task(net, training, supervision, facts)
        if facts.tasks is not None:
            task = tasks.give_tasks(task, examples.tasks)
        pairs = examples.reader.length("train")
        if pairs < training.rotated_below:
            share = MAX_ROTATED * (1 - pairs / training.rotated_below)
            task = tasks.rotate_pairs(task, make_pair_rotation(examples.pins.rest, share))
        pair_fields = _list_pair_fields(net, training, supervision, source.shares_slides)
        fields = (*pair_fields, *source.pair_fields)
    if modality is PINS:
        fields = (*fields, *source.pin_fields)
        if config.randomised:
            task = _randomise_pins(task, examples, config.randomised)
    return task, tuple(dict.fromkeys(fields))


def _describe_pins(examples: Examples, field: str) -> InitFacts:
    """Describe the pins and tasks of the examples to a network that reads `field`."""
    rest, count = examples.pins.rest, examples.tasks
    shares = np.full(count, 1 / count, np.float32) if count > 1 else None
    spread = measure_pin_spread(examples.reader, field, rest)
    return InitFacts(rest=rest, spread=spread, tasks=shares)


def _supervise(
    net: Net, training: Training, examples: Examples, load_teacher: Callable[[], Teacher]
) -> tasks.Supervision:
    """Choose labels and load the teachers that a network that unshears learns from.

    There are as many slide targets as the shear code has numbers, shifts before rotations. Raises
    UserError if no slide of the data differs from others.
    """
    count = get_functions(net).count_slide_numbers(net) if "slide" in training.losses else 0
    if count and not examples.slide_targets:
        raise UserError(
            "losses.slide: no slide of this data set is known to differ from others: leave it out"
        )
    teacher = None
    if uses_teacher(training):
        loaders = examples.load_teachers or (load_teacher,)
        teacher = tasks.join_teachers([load() for load in loaders])
    return tasks.Supervision(examples.targets, examples.slide_targets[:count], teacher)


def _list_pair_fields(
    net: Net, training: Training, supervision: tasks.Supervision, shares_slides: bool
) -> tuple[str, ...]:
    """List the fields of a batch that a network that unshears takes, whatever their source."""
    functions = get_functions(net)
    modality = functions.modality
    partners = {"other": modality.other, "swapped": modality.swapped}
    loss_fields = {name for loss in training.losses for name in get_loss(loss).fields}
    fields = [*modality.pair]
    if shares_slides and functions.count_slide_numbers(net):
        fields += [field for name, field in partners.items() if name in loss_fields]
    if "labels" in loss_fields:
        fields += list_label_fields(supervision.targets)
    fields += list_label_fields(supervision.slides)
    fields += sorted(loss_fields - {*partners, "labels", "slide_labels"})
    return tuple(dict.fromkeys(fields))


def _randomise_pins(task: tasks.Task, examples: Examples, share: float) -> tasks.Task:
    """Randomise the pins of a `share` of the batches."""
    randomise = make_randomisation(examples.pins.rest, share)

    def terms(
        variables: tasks.Tree, batch: Batch, key: Array
    ) -> tuple[dict[str, Array], tasks.Tree]:
        return task.terms(variables, randomise(batch, jax.random.fold_in(key, 2)), key)

    return dataclasses.replace(task, terms=terms)


def _make_rotations(examples: Examples) -> Rotations:
    """Make the rotations of recorded pins.

    Raises UserError if the recorded taps do not turn with their labels.
    """
    reader, modality_field = examples.reader, PINS.sheared
    if examples.taps:
        reader, modality_field = examples.taps, PINS.single
    batch, rest = read_all_training(reader, modality_field, "pose"), examples.pins.rest
    sense = find_rotation_sense(rest, batch[modality_field], batch["pose"], examples.targets)
    return make_rotations(rest, sense)
