"""Make the task of each network of an experiment, and choose the fields of its examples."""

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import jax
from jax import Array

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.losses import get_loss
from jaxunshear.config.network_config import resolve_network
from jaxunshear.config.networks import ENTANGLED_LARGE, RENDERER, TEACHER
from jaxunshear.config.targets import list_label_fields
from jaxunshear.config.training import Training, uses_teacher
from jaxunshear.data.sources import Examples, open_source
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.models import pin_networks
from jaxunshear.models.modality import IMAGES, PINS, Batch
from jaxunshear.models.registry import InitFacts, get_functions, predict
from jaxunshear.models.unshearnet import match_entangled_size
from jaxunshear.models.weights import Net, Variables
from jaxunshear.training.checkpoint import SUMMARY
from jaxunshear.training.data_origin import check_origin
from jaxunshear.training.domain_randomisation import make_randomisation
from jaxunshear.training.examples import measure_pin_spread, read_all_training
from jaxunshear.training.rotation import Rotations, find_rotation_sense, make_rotations
from jaxunshear.training.tasks import (
    PinAugmentation,
    Supervision,
    Task,
    Tree,
    make_posenet_task,
    make_renderer_task,
    make_unshear_task,
)
from jaxunshear.training.trained_network import load_network

VALIDATION_BATCH = 64


def make_task(
    experiment: Experiment, network: str, examples: Examples, folder: Path
) -> tuple[Task, tuple[str, ...]]:
    """Make the task of `network`, and list the fields of a batch that it takes."""
    config, source = resolve_network(experiment, network), open_source(experiment)
    training = config.training
    net: Net = config.net
    if network == ENTANGLED_LARGE:
        net = match_entangled_size(net)
    modality, role = get_functions(net).modality, config.spec.role
    field = modality.single if config.spec.learns_from == "taps" else modality.sheared
    facts = InitFacts()
    if modality is PINS:
        rest = examples.pins.rest
        facts = InitFacts(rest=rest, spread=measure_pin_spread(examples.reader, field, rest))
    fields: tuple[str, ...] = (field, *list_label_fields(examples.targets))
    if role == "renders":
        task = make_renderer_task(net, training, examples.targets, facts)
    elif role == "reads poses":
        support = _make_pin_support(experiment, net, training, examples, folder)
        task = make_posenet_task(net, training, examples.targets, facts, support)
    else:
        supervision = _make_supervision(experiment, net, training, examples, folder)
        task = make_unshear_task(net, training, supervision, facts)
        pair_fields = _list_pair_fields(net, training, supervision, source.shares_slides)
        fields = (*pair_fields, *source.pair_fields)
    if modality is PINS:
        fields = (*fields, *source.pin_fields)
        if config.randomised:
            task = _augment_task(task, examples, config.randomised)
    return task, tuple(dict.fromkeys(fields))


def _make_pin_support(
    experiment: Experiment, net: Net, training: Training, examples: Examples, folder: Path
) -> PinAugmentation:
    rotations = render = None
    if getattr(net, "turned", 0):
        rotations = _make_rotations(examples)
    if "rendered_pose" in training.losses:
        renderer = _load_tap_network(experiment, RENDERER, folder)
        render = partial(pin_networks.render_pins, *renderer)
    return PinAugmentation(rotations, render)


def _make_supervision(
    experiment: Experiment, net: Net, training: Training, examples: Examples, folder: Path
) -> Supervision:
    """Make the supervision of a network that unshears.

    Its shear code learns as many slide targets as it has numbers, shifts before rotations. Raises
    UserError if no slide of the data differs from others.
    """
    teacher = None
    if uses_teacher(training):
        teacher = partial(predict, *_load_tap_network(experiment, TEACHER, folder))
    count = get_functions(net).count_slide_numbers(net) if "slide" in training.losses else 0
    if count and not examples.slide_targets:
        raise UserError(
            "losses.slide: no slide of this data set is known to differ from others: leave it out"
        )
    return Supervision(examples.targets, examples.slide_targets[:count], teacher)


def _list_pair_fields(
    net: Net, training: Training, supervision: Supervision, shares_slides: bool
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


def _augment_task(task: Task, examples: Examples, share: float) -> Task:
    """Randomise the pins of a `share` of the batches of a task."""
    randomise = make_randomisation(examples.pins.rest, share)

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[dict[str, Array], Tree]:
        return task.terms(variables, randomise(batch, jax.random.fold_in(key, 2)), key)

    return dataclasses.replace(task, terms=terms)


def rename_inputs(batch: Json) -> Json:
    """Rename the slides of a batch without taps as the inputs of a PoseNet."""
    names = {each.sheared: each.single for each in (IMAGES, PINS) if each.canonical not in batch}
    return {names.get(name, name): values for name, values in batch.items()}


def take_first(
    split: Callable[..., Iterator[Batch]], count: int, fields: tuple[str, ...]
) -> Callable[[], Iterator[Batch]]:
    """Make the function that reads the first `count` validation examples, in batches."""

    def start_batches() -> Iterator[Batch]:
        taken = 0
        for batch in split("validation", VALIDATION_BATCH, fields):
            batch = {name: values[: count - taken] for name, values in batch.items()}
            taken += len(batch[fields[0]])
            yield rename_inputs(batch)
            if taken >= count:
                return

    return start_batches


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


def _load_tap_network(experiment: Experiment, network: str, folder: Path) -> tuple[Net, Variables]:
    """Load settings and variables of a network that another learns from. Raises UserError."""
    path = folder / network
    if not (path / SUMMARY).exists():
        raise UserError(f"{path} is missing, and others learn from it: train {network} first")
    check_origin(experiment, network, folder)
    net, variables, _ = load_network(path)
    return net, variables
