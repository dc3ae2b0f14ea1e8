"""What each network of an experiment learns, and from which fields of its examples."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path

import jax
from jax import Array

from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import (
    Experiment,
    get_recorded,
    get_training,
    list_trained_networks,
    uses_pins,
)
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
    REGISTRY,
    RENDERER,
    TAP_NETWORKS,
    TEACHER,
    UNET,
)
from jaxunshear.config.targets import Targets, list_label_fields
from jaxunshear.config.training import Training, uses_pose_labels
from jaxunshear.data.factorial import OTHER, OTHER_IMAGE, SWAPPED, SWAPPED_IMAGE
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
from jaxunshear.training.rotation import Rotations, find_rotation_sense, make_rotations
from jaxunshear.training.tasks import Batch, Task, Tree


def make_task(
    experiment: Experiment, network: str, examples: Examples, folder: Path
) -> tuple[Task, tuple[str, ...]]:
    """What `network` learns, and the fields of a batch that this takes."""
    training, targets, labels = (
        get_training(experiment, network),
        examples.targets,
        list_label_fields(examples.targets),
    )
    weighed = (
        ("weight",) if get_recorded(experiment) and REGISTRY[network].role == "unshears" else ()
    )
    if network == RENDERER or uses_pins(experiment):
        task, fields = _make_pin_task(experiment, network, examples, folder, weighed)
        share = 0.0 if get_recorded(experiment) else experiment.pins.turned
        return _augment_task(task, examples, share) if share else task, fields
    if network in POSENETS:
        seen = "image" if network in TAP_NETWORKS else "sheared"
        return tasks.make_posenet_task(experiment.posenet, training, targets), (seen, *labels)
    teacher = (
        partial(posenet.predict, *_load_tap_network(experiment, TEACHER, folder))
        if training.pose_weight
        else None
    )
    net = make_unshear_net(experiment.unshear, network)
    room = net.shear_channels if isinstance(net, UnshearNet) and net.apart else 0
    slides = _slides(examples, room) if room else ()
    task = tasks.make_unshear_task(net, training, teacher, targets, slides)
    partners = _partners(experiment, training, OTHER_IMAGE, SWAPPED_IMAGE) if room else ()
    named = (
        "canonical",
        "sheared",
        *partners,
        *weighed,
        *(labels if uses_pose_labels(training) else ()),
        *list_label_fields(slides),
    )
    return task, tuple(dict.fromkeys(named))


def _make_pin_task(
    experiment: Experiment, network: str, examples: Examples, folder: Path, weighed: tuple[str, ...]
) -> tuple[Task, tuple[str, ...]]:
    training, targets, labels = (
        get_training(experiment, network),
        examples.targets,
        list_label_fields(examples.targets),
    )
    field = "pins" if network in TAP_NETWORKS else "sheared_pins"
    known = (
        targets,
        examples.pins.rest,
        measure_pin_spread(examples.reader, field, examples.pins.rest),
    )
    pins, recorded = drop_direct(drop_rotation(experiment.pins)), get_recorded(experiment)
    net, plain = asdict(pins), asdict(drop_pin_codes(pins))
    sure = ("sure",) if recorded else ()  # simulated pins are all known
    if network == RENDERER:
        return pin_tasks.make_renderer_task(PinRenderer(**plain), training, *known), (
            "pins",
            *sure,
            *labels,
        )
    if network in POSENETS:
        turned = experiment.pins.turned if network not in TAP_NETWORKS and recorded else 0.0
        turns = _make_rotations(examples) if turned else None
        convolved = () if network in TAP_NETWORKS else experiment.pins.direct_convolved
        reader = PinPoseNet(**plain | {"turned": turned, "convolved": convolved})
        rendered = RENDERER in list_trained_networks(experiment)
        if network not in TAP_NETWORKS:
            rendered = recorded is not None and recorded.direct_taps == "rendered"
        render = (
            partial(pin_networks.render_pins, *_load_tap_network(experiment, RENDERER, folder))
            if rendered
            else None
        )
        return pin_tasks.make_pin_posenet_task(reader, training, *known, turns, render), (
            field,
            *sure,
            *labels,
        )
    codes = PinUnshear(**net if network == DISENTANGLED else net | {"shear_code": 0})
    teacher = (
        partial(pin_networks.predict, *_load_tap_network(experiment, TEACHER, folder))
        if training.pose_weight
        else None
    )
    partners = _partners(experiment, training, OTHER, SWAPPED) if network == DISENTANGLED else ()
    named = (
        "canonical_pins",
        "sheared_pins",
        *partners,
        *sure,
        *weighed,
        *(labels if uses_pose_labels(training) else ()),
    )
    taught = training.slide_weight and network == DISENTANGLED
    slides = _slides(examples, codes.shear_code) if taught else ()
    named = tuple(dict.fromkeys((*named, *list_label_fields(slides))))
    return pin_tasks.make_pin_unshear_task(codes, training, *known, teacher, slides), named


def _partners(
    experiment: Experiment, training: Training, other: str, swapped: str
) -> tuple[str, ...]:
    """The fields of those that a network learns from where poses share slides."""
    shared = isinstance(experiment.paired, PairedData) and experiment.paired.poses_a_slide > 1
    wanted = {
        other: training.swap_weight,
        swapped: training.swap_weight or training.agreement_weight,
    }
    return tuple(field for field, weight in wanted.items() if shared and weight)


def _slides(examples: Examples, size: int) -> Targets:
    """Return what a shear code of `size` numbers is taught: shifts before turns, as many as it has room for.

    Raises UserError if no slide of the data differs from others.
    """
    if not examples.slides:
        raise UserError(
            "slide_weight: no slide of this data set is known to differ from others: leave it at 0"
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
