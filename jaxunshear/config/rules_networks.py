"""Rules between the settings of networks and of their trainings, whatever they learn from."""

from collections.abc import Callable, Iterator, Mapping

from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import (
    Experiment,
    get_recorded,
    list_trained_networks,
    uses_pins,
)
from jaxunshear.config.image import Preprocess
from jaxunshear.config.losses import EXCHANGE, Modality, Requirement, Role, get_loss
from jaxunshear.config.registry import PIN_NETWORKS, POSENET_SHEARED, RENDERER, TEACHER
from jaxunshear.config.targets import parse_target
from jaxunshear.config.training import Training, uses_code_exchange
from jaxunshear.config.types import Rule
from jaxunshear.errors import UserError

ROTATED_TARGETS = {"edge_mm", "edge_deg", "depth_mm"}  # targets that a turned simulated touch has


def list_network_rules(
    experiment: Experiment, paired: Preprocess, pose: Preprocess
) -> Iterator[Rule]:
    """`paired` and `pose`: how the images of the two sets are prepared."""
    unshear, posenet, pins = experiment.unshear, experiment.posenet, experiment.pins
    yield (
        unshear.size == paired.size,
        "unshear.size",
        f"differs from the data set's images: make it and paired.preprocess.size ({paired.size}) equal",
    )
    yield (
        posenet.size == pose.size,
        "posenet.size",
        f"differs from the data set's images: make it and pose.preprocess.size ({pose.size}) equal",
    )
    yield (
        posenet.size == unshear.size,
        "posenet.size",
        f"differs from unshear.size ({unshear.size}): PoseNet also reads the unsheared images",
    )
    yield (
        unshear.disentangled,
        "unshear.disentangled",
        "both networks are trained from these settings: to train one of them use `--networks entangled`",
    )
    yield (
        not pins.turned or uses_pins(experiment),
        "pins.turned",
        "is for networks over pins: leave it at 0",
    )
    yield (
        not pins.turned
        or get_recorded(experiment) is None
        or POSENET_SHEARED in list_trained_networks(experiment),
        "pins.turned",
        "is for posenet_sheared, which this experiment does not train: add it to networks, or leave it at 0",
    )
    yield (
        not pins.direct_convolved
        or (uses_pins(experiment) and POSENET_SHEARED in list_trained_networks(experiment)),
        "pins.direct_convolved",
        "is for posenet_sheared over pins, which this experiment does not train: leave it empty",
    )
    yield (
        not (pins.direct_convolved and pins.turned) or get_recorded(experiment) is None,
        "pins.direct_convolved",
        "takes recorded pins as they are: leave pins.turned at 0",
    )
    named = {text.partition(":")[0] for text in experiment.targets}
    yield (
        not pins.turned
        or get_recorded(experiment) is not None
        or (bool(named) and named <= ROTATED_TARGETS),
        "pins.turned",
        f"turns touches about the sensor's axis, which leaves them these targets alone: {', '.join(sorted(ROTATED_TARGETS))}",
    )
    over = ", ".join(name for name in experiment.networks if name not in PIN_NETWORKS)
    yield (
        not uses_pins(experiment) or not over,
        "networks",
        f"{over} reads images alone: with unshear.input pins use {', '.join(PIN_NETWORKS)}",
    )


def list_training_rules(experiment: Experiment, pairs: int, taps: int) -> Iterator[Rule]:
    """Yield the rules of trainings on `pairs` and `taps` examples."""
    yield _batch(experiment.train, "train", pairs)
    yield (
        experiment.train.crop_px <= experiment.unshear.size,
        "train.crop_px",
        f"must be 1 to the image's {experiment.unshear.size} px",
    )
    yield (
        not experiment.train_teacher.start,
        "train_teacher.start",
        "leave it empty: what marks a network must not teach it",
    )
    yield from _list_loss_rules(experiment, "train", "unshears", "images")
    yield from _list_separate_code_rules(experiment)
    yield from _list_few_pair_rules(experiment)
    taught = TEACHER in list_trained_networks(experiment) and not uses_pins(experiment)
    for name in ("train_posenet", "train_teacher") if taught else ("train_posenet",):
        yield _batch(getattr(experiment, name), name, taps)
        yield from _list_loss_rules(experiment, name, "reads poses", "images")
        yield from _list_pair_setting_rules(getattr(experiment, name), name)
    if uses_pins(experiment) or RENDERER in list_trained_networks(experiment):
        yield _batch(experiment.train_pins, "train_pins", min(pairs, taps))
        yield from _list_loss_rules(experiment, "train_pins", "unshears", "pins")


def _batch(training: Training, group: str, examples: int) -> Rule:
    remedy = f"is larger than the training set of {examples}: use a smaller batch or more poses"
    return training.batch <= examples, f"{group}.batch", remedy


def _list_loss_rules(
    experiment: Experiment, group: str, role: Role, modality: Modality
) -> Iterator[Rule]:
    """Yield whether the losses of a group are known, of its networks, and have what they need."""
    for name in getattr(experiment, group).losses:
        field = f"{group}.losses.{name}"
        try:
            spec = get_loss(name)
        except UserError as error:
            yield False, field, str(error)
            continue
        yield spec.role == role, field, f"is for a network that {spec.role}: leave it out"
        yield (
            modality in spec.modalities,
            field,
            f"is for networks over {' and '.join(spec.modalities)}: leave it out",
        )
        for requirement in spec.requires:
            check, remedy = REQUIREMENTS[requirement]
            yield check(experiment, modality), field, remedy


def _has_codes(experiment: Experiment, modality: Modality) -> bool:
    if modality == "pins":
        return experiment.pins.shear_code > 0 and not experiment.pins.turned
    return experiment.unshear.apart and not uses_pins(experiment)


def _shares_slides(experiment: Experiment, modality: Modality) -> bool:
    paired = experiment.paired
    return isinstance(paired, PairedData) and paired.poses_a_slide > 1 and paired.slides > 1


def _has_two_slides(experiment: Experiment, modality: Modality) -> bool:
    return isinstance(experiment.paired, PairedData) and experiment.paired.slides > 1


def _is_simulated(experiment: Experiment, modality: Modality) -> bool:
    return get_recorded(experiment) is None


def _has_still_pins(experiment: Experiment, modality: Modality) -> bool:
    return not experiment.pins.turned


REQUIREMENTS: dict[Requirement, tuple[Callable[[Experiment, Modality], bool], str]] = {
    "codes": (
        _has_codes,
        "takes codes that are apart: set unshear.apart; over pins raise pins.shear_code, and leave pins.turned at 0",
    ),
    "shared slides": (
        _shares_slides,
        "takes simulated slides that poses share, two at least: raise paired.poses_a_slide and paired.slides",
    ),
    "two slides": (_has_two_slides, "takes two slides to a pose: raise paired.slides"),
    "simulated": (_is_simulated, "takes simulated contacts: leave it out"),
    "still pins": (_has_still_pins, "takes pins as they are: leave it out, or pins.turned at 0"),
}


def _list_separate_code_rules(experiment: Experiment) -> Iterator[Rule]:
    """Yield what codes that are apart take: z_s then learns from the slide alone."""
    yield (
        not experiment.pins.apart or "slide" in experiment.train_pins.losses,
        "pins.apart",
        "leaves z_s to learn from the slide alone: raise train_pins.losses.slide",
    )
    yield (
        not experiment.unshear.apart or not uses_pins(experiment),
        "unshear.apart",
        "is of networks over images: use pins.apart",
    )
    yield (
        not experiment.unshear.apart
        or ("slide" in experiment.train.losses and experiment.unshear.shear_channels > 0),
        "unshear.apart",
        "leaves z_s to learn from the slide alone: raise train.losses.slide and unshear.shear_channels",
    )


def _list_few_pair_rules(experiment: Experiment) -> Iterator[Rule]:
    """Yield what learning from a share of the pairs takes."""
    training = experiment.train_pins
    yield (
        experiment.train.paired_share == 1,
        "train.paired_share",
        "is for networks over pins: leave it at 1",
    )
    yield (
        training.paired_share == 1 or get_recorded(experiment) is None,
        "train_pins.paired_share",
        "is of simulated pairs: use paired.labelled",
    )
    yield (
        training.paired_share == 1 or not uses_code_exchange(training),
        "train_pins.paired_share",
        f"leaves slides without their partners: leave it at 1, or {' and '.join(EXCHANGE)} out",
    )


def _list_pair_setting_rules(training: Training, name: str) -> Iterator[Rule]:
    for field in ("crops", "crop_px", "paired_share"):
        value, unused = getattr(training, field), getattr(Training, field)
        yield (
            value == unused,
            f"{name}.{field}",
            f"is for networks that unshear: leave it at {unused:g}",
        )


def list_target_rules(targets: tuple[str, ...], known: Mapping[str, object]) -> Iterator[Rule]:
    names = []
    for text in targets:
        try:
            names.append(parse_target(text, known)[0])
        except UserError as error:
            yield False, "targets", str(error)
    yield len(set(names)) == len(names), "targets", "name each once"
