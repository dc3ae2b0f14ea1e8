"""Make the task of each network of an experiment, and choose the fields of its examples."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path

import jax
from jax import Array

from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import Experiment, get_recorded, get_training, uses_pins
from jaxunshear.config.losses import get_loss
from jaxunshear.config.networks import (
    PinPoseNet,
    PinRenderer,
    PinUnshear,
    UNet,
    UnshearNet,
    drop_codes,
    drop_direct,
    drop_pin_codes,
    drop_rotation,
)
from jaxunshear.config.registry import (
    DISENTANGLED,
    ENTANGLED,
    ENTANGLED_LARGE,
    POSENETS,
    RENDERER,
    TAP_NETWORKS,
    TEACHER,
    UNET,
)
from jaxunshear.config.targets import Targets, list_label_fields
from jaxunshear.config.training import Training, uses_teacher
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.models import pin_networks, posenet
from jaxunshear.models.modality import IMAGES, PINS, Modality
from jaxunshear.models.unshearnet import match_entangled_size
from jaxunshear.models.weights import Net, Variables
from jaxunshear.training import pin_tasks, tasks
from jaxunshear.training.checkpoint import load_best, read_net
from jaxunshear.training.data_origin import check_origin
from jaxunshear.training.domain_randomisation import make_randomisation
from jaxunshear.training.examples import Examples, measure_pin_spread, read_all_training
from jaxunshear.training.rotation import Rotations, find_rotation_sense, make_rotations
from jaxunshear.training.tasks import Batch, Supervision, Task, Tree

VALIDATION_BATCH = 64


def make_task(
    experiment: Experiment, network: str, examples: Examples, folder: Path
) -> tuple[Task, tuple[str, ...]]:
    """Make the task of `network`, and list the fields of a batch that it takes."""
    training, targets = get_training(experiment, network), examples.targets
    labels = tuple(list_label_fields(targets))
    if network == RENDERER or uses_pins(experiment):
        task, fields = _make_pin_task(experiment, network, examples, folder)
        share = 0.0 if get_recorded(experiment) else experiment.pins.turned
        return _augment_task(task, examples, share) if share else task, fields
    if network in POSENETS:
        image = "image" if network in TAP_NETWORKS else "sheared"
        return tasks.make_posenet_task(experiment.posenet, training, targets), (image, *labels)
    net = make_unshear_net(experiment.unshear, network)
    size = net.shear_channels if isinstance(net, UnshearNet) and net.apart else 0
    supervision = _make_supervision(experiment, training, examples, folder, size)
    task = tasks.make_unshear_task(net, training, supervision)
    fields = _list_pair_fields(experiment, training, supervision, IMAGES, has_codes=size > 0)
    return task, fields


def _make_pin_task(
    experiment: Experiment, network: str, examples: Examples, folder: Path
) -> tuple[Task, tuple[str, ...]]:
    training, targets = get_training(experiment, network), examples.targets
    labels = tuple(list_label_fields(targets))
    field = "pins" if network in TAP_NETWORKS else "sheared_pins"
    rest = examples.pins.rest
    spread = measure_pin_spread(examples.reader, field, rest)
    sure = ("sure",) if get_recorded(experiment) else ()  # simulated pins are all known
    if network == RENDERER:
        renderer = PinRenderer(**_list_plain_settings(experiment))
        task = pin_tasks.make_renderer_task(renderer, training, targets, rest, spread)
        return task, ("pins", *sure, *labels)
    if network in POSENETS:
        task = _make_pin_posenet_task(experiment, network, examples, spread, folder)
        return task, (field, *sure, *labels)
    pins, has_codes = drop_direct(drop_rotation(experiment.pins)), network == DISENTANGLED
    net = PinUnshear(**asdict(pins) if has_codes else asdict(pins) | {"shear_code": 0})
    size = net.shear_code if "slide" in training.losses else 0
    supervision = _make_supervision(experiment, training, examples, folder, size)
    task = pin_tasks.make_pin_unshear_task(net, training, rest, spread, supervision)
    return task, _list_pair_fields(experiment, training, supervision, PINS, has_codes, sure)


def _make_pin_posenet_task(
    experiment: Experiment, network: str, examples: Examples, spread: float, folder: Path
) -> Task:
    training, pins = get_training(experiment, network), experiment.pins
    reads_slides = network not in TAP_NETWORKS
    turned = pins.turned if reads_slides and get_recorded(experiment) else 0.0
    convolved = pins.direct_convolved if reads_slides else ()
    settings = _list_plain_settings(experiment) | {"turned": turned, "convolved": convolved}
    rotations = _make_rotations(examples) if turned else None
    render = None
    if "rendered_pose" in training.losses:
        renderer = _load_tap_network(experiment, RENDERER, folder)
        render = partial(pin_networks.render_pins, *renderer)
    return pin_tasks.make_pin_posenet_task(
        PinPoseNet(**settings),
        training,
        examples.targets,
        examples.pins.rest,
        spread,
        rotations,
        render,
    )


def _list_plain_settings(experiment: Experiment) -> Json:
    """List the settings of networks over pins that have neither codes nor rotations."""
    return asdict(drop_pin_codes(drop_direct(drop_rotation(experiment.pins))))


def _make_supervision(
    experiment: Experiment, training: Training, examples: Examples, folder: Path, shear_size: int
) -> Supervision:
    """Make the supervision of a network whose shear code has `shear_size` numbers."""
    teacher = None
    if uses_teacher(training):
        predict = pin_networks.predict if uses_pins(experiment) else posenet.predict
        teacher = partial(predict, *_load_tap_network(experiment, TEACHER, folder))
    slides = _choose_slide_targets(examples, shear_size) if shear_size else ()
    return Supervision(examples.targets, slides, teacher)


def _list_pair_fields(
    experiment: Experiment,
    training: Training,
    supervision: Supervision,
    modality: Modality,
    has_codes: bool,
    more: tuple[str, ...] = (),
) -> tuple[str, ...]:
    """List the fields of a batch that a network that unshears takes, `more` among them."""
    shares_slides = (
        isinstance(experiment.paired, PairedData) and experiment.paired.poses_a_slide > 1
    )
    partners = {"other": modality.other, "swapped": modality.swapped}
    loss_fields = {name for loss in training.losses for name in get_loss(loss).fields}
    fields = [modality.canonical, modality.sheared]
    if shares_slides and has_codes:
        fields += [field for name, field in partners.items() if name in loss_fields]
    fields += more
    if get_recorded(experiment):
        fields.append("weight")
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


def make_unshear_net(net: UnshearNet, network: str) -> UnshearNet | UNet:
    """Make the settings of a network that unshears, all derived from `net`."""
    return _NETS[network](dataclasses.replace(net, disentangled=True))


_NETS: dict[str, Callable[[UnshearNet], UnshearNet | UNet]] = {
    DISENTANGLED: lambda net: net,
    ENTANGLED: lambda net: dataclasses.replace(drop_codes(net), disentangled=False),
    ENTANGLED_LARGE: match_entangled_size,
    UNET: lambda net: UNet(net.size, net.widths),
}


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
