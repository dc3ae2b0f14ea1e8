"""Make the task of each network of an experiment, and choose the fields of its examples."""

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import jax
from jax import Array

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.losses import get_loss
from jaxunshear.config.network_config import NetworkConfig, resolve_network
from jaxunshear.config.networks import (
    PinPoseNet,
    PinRenderer,
    PinUnshear,
    PoseNet,
    UNet,
    UnshearNet,
)
from jaxunshear.config.registry import ENTANGLED_LARGE, RENDERER, TEACHER
from jaxunshear.config.targets import Targets, list_label_fields
from jaxunshear.config.training import uses_teacher
from jaxunshear.data.sources import DataSource, Examples, open_source
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.models import pin_networks, posenet
from jaxunshear.models.unshearnet import match_entangled_size
from jaxunshear.models.weights import Net, Variables
from jaxunshear.training import pin_tasks, tasks
from jaxunshear.training.checkpoint import load_best, read_net
from jaxunshear.training.data_origin import check_origin
from jaxunshear.training.domain_randomisation import make_randomisation
from jaxunshear.training.examples import measure_pin_spread, read_all_training
from jaxunshear.training.modality import IMAGES, PINS, Modality
from jaxunshear.training.rotation import Rotations, find_rotation_sense, make_rotations
from jaxunshear.training.tasks import Batch, Supervision, Task, Tree

VALIDATION_BATCH = 64


def make_task(
    experiment: Experiment, network: str, examples: Examples, folder: Path
) -> tuple[Task, tuple[str, ...]]:
    """Make the task of `network`, and list the fields of a batch that it takes."""
    config, source = resolve_network(experiment, network), open_source(experiment)
    if config.modality == "pins":
        task, fields = _make_pin_task(experiment, config, source, examples, folder)
        share = config.randomised
        return _augment_task(task, examples, share) if share else task, fields
    if isinstance(config.net, PoseNet):
        image = "image" if config.spec.learns_from == "taps" else "sheared"
        task = tasks.make_posenet_task(config.net, config.training, examples.targets)
        return task, (image, *list_label_fields(examples.targets))
    net = config.net
    assert isinstance(net, UnshearNet | UNet)
    if network == ENTANGLED_LARGE and isinstance(net, UnshearNet):
        net = match_entangled_size(net)
    size = net.shear_channels if isinstance(net, UnshearNet) and net.apart else 0
    supervision = _make_supervision(experiment, config, examples, folder, size)
    task = tasks.make_unshear_task(net, config.training, supervision)
    return task, _list_pair_fields(config, source, supervision, IMAGES, has_codes=size > 0)


def _make_pin_task(
    experiment: Experiment,
    config: NetworkConfig,
    source: DataSource,
    examples: Examples,
    folder: Path,
) -> tuple[Task, tuple[str, ...]]:
    training, net, targets = config.training, config.net, examples.targets
    field = "pins" if config.spec.learns_from == "taps" else "sheared_pins"
    rest = examples.pins.rest
    spread = measure_pin_spread(examples.reader, field, rest)
    fields = (field, *source.pin_fields, *list_label_fields(targets))
    if isinstance(net, PinRenderer):
        return pin_tasks.make_renderer_task(net, training, targets, rest, spread), fields
    if isinstance(net, PinPoseNet):
        rotations = _make_rotations(examples) if net.turned else None
        render = None
        if "rendered_pose" in training.losses:
            renderer = _load_tap_network(experiment, RENDERER, folder)
            render = partial(pin_networks.render_pins, *renderer)
        task = pin_tasks.make_pin_posenet_task(
            net, training, targets, rest, spread, rotations, render
        )
        return task, fields
    assert isinstance(net, PinUnshear)
    size = net.shear_code if "slide" in training.losses else 0
    supervision = _make_supervision(experiment, config, examples, folder, size)
    task = pin_tasks.make_pin_unshear_task(net, training, rest, spread, supervision)
    return task, _list_pair_fields(config, source, supervision, PINS, config.spec.has_codes)


def _make_supervision(
    experiment: Experiment,
    config: NetworkConfig,
    examples: Examples,
    folder: Path,
    shear_size: int,
) -> Supervision:
    """Make the supervision of a network whose shear code has `shear_size` numbers."""
    teacher = None
    if uses_teacher(config.training):
        predict = pin_networks.predict if config.modality == "pins" else posenet.predict
        teacher = partial(predict, *_load_tap_network(experiment, TEACHER, folder))
    slides = _choose_slide_targets(examples, shear_size) if shear_size else ()
    return Supervision(examples.targets, slides, teacher)


def _list_pair_fields(
    config: NetworkConfig,
    source: DataSource,
    supervision: Supervision,
    modality: Modality,
    has_codes: bool,
) -> tuple[str, ...]:
    """List the fields of a batch that a network that unshears takes."""
    partners = {"other": modality.other, "swapped": modality.swapped}
    loss_fields = {name for loss in config.training.losses for name in get_loss(loss).fields}
    fields = [modality.canonical, modality.sheared]
    if source.shares_slides and has_codes:
        fields += [field for name, field in partners.items() if name in loss_fields]
    fields += source.pin_fields if config.modality == "pins" else ()
    fields += source.pair_fields
    if "labels" in loss_fields:
        fields += list_label_fields(supervision.targets)
    fields += list_label_fields(supervision.slides)
    fields += sorted(loss_fields - {*partners, "labels", "slide_labels"})
    return tuple(dict.fromkeys(fields))


def _choose_slide_targets(examples: Examples, size: int) -> Targets:
    """Choose the slide targets of a shear code of `size` numbers, shifts before rotations.

    Raises UserError if no slide of the data differs from others.
    """
    if not examples.slides:
        raise UserError(
            "losses.slide: no slide of this data set is known to differ from others: leave it out"
        )
    return examples.slides[:size]


def _augment_task(task: Task, examples: Examples, share: float) -> Task:
    """Randomise the pins of a `share` of the batches of a task."""
    randomise = make_randomisation(examples.pins.rest, share)

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[dict[str, Array], Tree]:
        return task.terms(variables, randomise(batch, jax.random.fold_in(key, 2)), key)

    return dataclasses.replace(task, terms=terms)


def rename_inputs(batch: Json) -> Json:
    """Rename the slides of a batch without taps to "image" or "pins", the inputs of a PoseNet."""
    if "canonical" in batch or "canonical_pins" in batch:
        return batch
    new_names = {"sheared": "image", "sheared_pins": "pins"}
    return {new_names.get(name, name): values for name, values in batch.items()}


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
    reader, field = examples.reader, "sheared_pins"
    if examples.taps:
        reader, field = examples.taps, "pins"
    batch, rest = read_all_training(reader, field, "pose"), examples.pins.rest
    sense = find_rotation_sense(rest, batch[field], batch["pose"], examples.targets)
    return make_rotations(rest, sense)


def _load_tap_network(experiment: Experiment, network: str, folder: Path) -> tuple[Net, Variables]:
    """Load settings and variables of a network that another learns from. Raises UserError."""
    path = folder / network
    if not (path / "summary.json").exists():
        raise UserError(f"{path} is missing, and others learn from it: train {network} first")
    check_origin(experiment, network, folder)
    return read_net(path), load_best(path)
