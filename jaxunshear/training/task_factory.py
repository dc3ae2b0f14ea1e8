"""What each network of an experiment learns, and from which fields of its examples."""

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
from jaxunshear.models.unshearnet import match_entangled_size
from jaxunshear.models.weights import Net, Variables
from jaxunshear.training import pin_tasks, tasks
from jaxunshear.training.checkpoint import load_best, read_net
from jaxunshear.training.data_origin import check_origin
from jaxunshear.training.domain_randomisation import make_randomisation
from jaxunshear.training.examples import Examples, measure_pin_spread, read_all_training
from jaxunshear.training.modality import IMAGES, PINS, Modality
from jaxunshear.training.rotation import Rotations, find_rotation_sense, make_rotations
from jaxunshear.training.tasks import Batch, Supervision, Task, Tree


def make_task(
    experiment: Experiment, network: str, examples: Examples, folder: Path
) -> tuple[Task, tuple[str, ...]]:
    """Return what `network` learns, and the fields of a batch that this takes."""
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
    pins, recorded = drop_direct(drop_rotation(experiment.pins)), get_recorded(experiment)
    settings, plain = asdict(pins), asdict(drop_pin_codes(pins))
    sure = ("sure",) if recorded else ()  # simulated pins are all known
    if network == RENDERER:
        net = PinRenderer(**plain)
        task = pin_tasks.make_renderer_task(net, training, targets, rest, spread)
        return task, ("pins", *sure, *labels)
    if network in POSENETS:
        turned = experiment.pins.turned if network not in TAP_NETWORKS and recorded else 0.0
        turns = _make_rotations(examples) if turned else None
        convolved = () if network in TAP_NETWORKS else experiment.pins.direct_convolved
        reader = PinPoseNet(**plain | {"turned": turned, "convolved": convolved})
        render = None
        if "rendered_pose" in training.losses:
            render = partial(
                pin_networks.render_pins, *_load_tap_network(experiment, RENDERER, folder)
            )
        task = pin_tasks.make_pin_posenet_task(
            reader, training, targets, rest, spread, turns, render
        )
        return task, (field, *sure, *labels)
    has_codes = network == DISENTANGLED
    codes = PinUnshear(**settings if has_codes else settings | {"shear_code": 0})
    size = codes.shear_code if "slide" in training.losses else 0
    supervision = _make_supervision(experiment, training, examples, folder, size)
    task = pin_tasks.make_pin_unshear_task(codes, training, rest, spread, supervision)
    return task, _list_pair_fields(experiment, training, supervision, PINS, has_codes, sure)


def _make_supervision(
    experiment: Experiment, training: Training, examples: Examples, folder: Path, shear_size: int
) -> Supervision:
    """Return what teaches a network whose shear code, of `shear_size` numbers, is taught the slide."""
    teacher = None
    if uses_teacher(training):
        predict = pin_networks.predict if uses_pins(experiment) else posenet.predict
        teacher = partial(predict, *_load_tap_network(experiment, TEACHER, folder))
    slides = _slides(examples, shear_size) if shear_size else ()
    return Supervision(examples.targets, slides, teacher)


def _list_pair_fields(
    experiment: Experiment,
    training: Training,
    supervision: Supervision,
    modality: Modality,
    has_codes: bool,
    more: tuple[str, ...] = (),
) -> tuple[str, ...]:
    """Return the fields of a batch that a network that unshears takes, `more` among them."""
    shares = isinstance(experiment.paired, PairedData) and experiment.paired.poses_a_slide > 1
    partners = {"other": modality.other, "swapped": modality.swapped}
    of_losses = {name for loss in training.losses for name in get_loss(loss).fields}
    fields = [modality.canonical, modality.sheared]
    if shares and has_codes:
        fields += [field for name, field in partners.items() if name in of_losses]
    fields += more
    if get_recorded(experiment):
        fields.append("weight")
    if "labels" in of_losses:
        fields += list_label_fields(supervision.targets)
    fields += list_label_fields(supervision.slides)
    fields += sorted(of_losses - {*partners, "labels", "slide_labels"})
    return tuple(dict.fromkeys(fields))


def _slides(examples: Examples, size: int) -> Targets:
    """Return what a shear code of `size` numbers is taught: shifts before turns, as many as it has room for.

    Raises UserError if no slide of the data differs from others.
    """
    if not examples.slides:
        raise UserError(
            "losses.slide: no slide of this data set is known to differ from others: leave it out"
        )
    return examples.slides[:size]


def _augment_task(task: Task, examples: Examples, share: float) -> Task:
    """The same task on simulated pins that are drawn as another sensor would show them."""
    draw = make_randomisation(examples.pins.rest, share)

    def terms(variables: Tree, batch: Batch, key: Array) -> tuple[dict[str, Array], Tree]:
        return task.terms(variables, draw(batch, jax.random.fold_in(key, 2)), key)

    return dataclasses.replace(task, terms=terms)


def make_unshear_net(net: UnshearNet, network: str) -> UnshearNet | UNet:
    """The settings of one of the networks that unshear, all derived from `net`."""
    return _NETS[network](dataclasses.replace(net, disentangled=True))


_NETS: dict[str, Callable[[UnshearNet], UnshearNet | UNet]] = {
    DISENTANGLED: lambda net: net,
    ENTANGLED: lambda net: dataclasses.replace(drop_codes(net), disentangled=False),
    ENTANGLED_LARGE: match_entangled_size,
    UNET: lambda net: UNet(net.size, net.widths),
}


def rename_inputs(batch: Json) -> Json:
    """Trainings that read poses name their input "image", or "pins"."""
    if "canonical" in batch or "canonical_pins" in batch:
        return batch
    return {
        {"sheared": "image", "sheared_pins": "pins"}.get(name, name): x for name, x in batch.items()
    }


def take_first(
    split: Callable[..., Iterator[Batch]], count: int, fields: tuple[str, ...]
) -> Callable[[], Iterator[Batch]]:
    """The first `count` validation examples, in batches."""
    batch = 64

    def batches() -> Iterator[Batch]:
        taken = 0
        for examples in split("validation", batch, fields):
            examples = {name: values[: count - taken] for name, values in examples.items()}
            taken += len(examples[fields[0]])
            yield rename_inputs(examples)
            if taken >= count:
                return

    return batches


def _make_rotations(examples: Examples) -> Rotations:
    """Raises UserError where the taps that the sensor has recorded do not turn with their labels."""
    taps = examples.taps or examples.reader
    field = "pins" if examples.taps else "sheared_pins"
    known = read_all_training(taps, field, "pose")
    return make_rotations(
        examples.pins.rest,
        find_rotation_sense(examples.pins.rest, known[field], known["pose"], examples.targets),
    )


def _load_tap_network(experiment: Experiment, network: str, folder: Path) -> tuple[Net, Variables]:
    """Settings and variables of a network that another learns from. Raises UserError."""
    path = folder / network
    if not (path / "summary.json").exists():
        raise UserError(f"{path} is missing, and others learn from it: train {network} first")
    check_origin(experiment, network, folder)
    return read_net(path), load_best(path)
