"""Rules between the settings of networks and of their trainings, for simulations and recordings."""

from collections.abc import Callable, Iterator, Mapping

from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import (
    Experiment,
    get_recorded,
    list_trained_networks,
    uses_pins,
)
from jaxunshear.config.image import Preprocess
from jaxunshear.config.losses import EXCHANGE, InputKind, Requirement, Role, get_loss
from jaxunshear.config.registry import (
    POSENET_SHEARED,
    RENDERER,
    TEACHER,
    list_modality_networks,
)
from jaxunshear.config.targets import parse_target
from jaxunshear.config.training import Training, uses_code_exchange
from jaxunshear.config.types import Rule
from jaxunshear.errors import UserError

# targets that stay true when a simulated contact is turned about the sensor's axis
ROTATED_TARGETS = {"edge_mm", "edge_deg", "depth_mm"}


def list_network_rules(
    experiment: Experiment, paired: Preprocess, pose: Preprocess
) -> Iterator[Rule]:
    """Yield the rules of networks over images that `paired` and `pose` prepare, and over pins."""
    unshear, posenet = experiment.unshear, experiment.posenet
    yield Rule(
        unshear.size == paired.size,
        "unshear.size",
        "differs from the data set's images: "
        f"make it and paired.preprocess.size ({paired.size}) equal",
    )
    yield Rule(
        posenet.size == pose.size,
        "posenet.size",
        f"differs from the data set's images: make it and pose.preprocess.size ({pose.size}) equal",
    )
    yield Rule(
        posenet.size == unshear.size,
        "posenet.size",
        f"differs from unshear.size ({unshear.size}): PoseNet also reads the unsheared images",
    )
    yield Rule(
        unshear.disentangled,
        "unshear.disentangled",
        "both networks are trained from these settings: "
        "to train one of them use `--networks entangled`",
    )
    yield from _list_rotation_rules(experiment)
    yield from _list_pin_rules(experiment)


def _list_rotation_rules(experiment: Experiment) -> Iterator[Rule]:
    """Yield the rules of rotation augmentation, `pins.turned`."""
    if not experiment.pins.turned:
        return
    field = "pins.turned"
    yield Rule(uses_pins(experiment), field, "is for networks over pins: leave it at 0")
    if get_recorded(experiment):
        yield Rule(
            POSENET_SHEARED in list_trained_networks(experiment),
            field,
            "is for posenet_sheared, which this experiment does not train: "
            "add it to networks, or leave it at 0",
        )
        yield Rule(
            not experiment.pins.direct_convolved,
            "pins.direct_convolved",
            "takes recorded pins as they are: leave pins.turned at 0",
        )
        return
    targets = {text.partition(":")[0] for text in experiment.targets}
    yield Rule(
        bool(targets) and targets <= ROTATED_TARGETS,
        field,
        "turns touches about the sensor's axis, which leaves them these targets alone: "
        f"{', '.join(sorted(ROTATED_TARGETS))}",
    )


def _list_pin_rules(experiment: Experiment) -> Iterator[Rule]:
    pins = uses_pins(experiment)
    yield Rule(
        not experiment.pins.direct_convolved
        or (pins and POSENET_SHEARED in list_trained_networks(experiment)),
        "pins.direct_convolved",
        "is for posenet_sheared over pins, which this experiment does not train: leave it empty",
    )
    modality = experiment.unshear.input
    possible = list_modality_networks(modality)
    others = ", ".join(name for name in experiment.networks if name not in possible)
    yield Rule(
        not others,
        "networks",
        f"{others} does not read {modality}: use {', '.join(possible)}",
    )


def list_training_rules(experiment: Experiment, pairs: int, taps: int) -> Iterator[Rule]:
    """Yield the rules of trainings on `pairs` and `taps` examples."""
    pins, trained = uses_pins(experiment), list_trained_networks(experiment)
    yield _make_batch_rule(experiment.train, "train", pairs)
    yield Rule(
        experiment.train.crop_px <= experiment.unshear.size,
        "train.crop_px",
        f"must be 1 to the image's {experiment.unshear.size} px",
    )
    yield Rule(
        not experiment.train_teacher.start,
        "train_teacher.start",
        "leave it empty: the PoseNet that scores a network must not supervise it",
    )
    yield from _list_loss_rules(experiment, "train", "unshears", "images")
    yield from _list_separate_code_rules(experiment)
    yield from _list_few_pair_rules(experiment)
    posenets = [("train_posenet", experiment.train_posenet)]
    if TEACHER in trained and not pins:
        posenets.append(("train_teacher", experiment.train_teacher))
    for group, training in posenets:
        yield _make_batch_rule(training, group, taps)
        yield from _list_loss_rules(experiment, group, "reads poses", "images")
        yield from _list_pair_setting_rules(training, group)
    if pins or RENDERER in trained:
        yield _make_batch_rule(experiment.train_pins, "train_pins", min(pairs, taps))
        yield from _list_loss_rules(experiment, "train_pins", "unshears", "pins")


def _make_batch_rule(training: Training, group: str, examples: int) -> Rule:
    remedy = f"is larger than the training set of {examples}: use a smaller batch or more poses"
    return Rule(training.batch <= examples, f"{group}.batch", remedy)


def _list_loss_rules(
    experiment: Experiment, group: str, role: Role, modality: InputKind
) -> Iterator[Rule]:
    """Yield the rules that the losses of a group exist, suit its networks, and have their needs."""
    for name in getattr(experiment, group).losses:
        field = f"{group}.losses.{name}"
        try:
            spec = get_loss(name)
        except UserError as error:
            yield Rule(False, field, str(error))
            continue
        yield Rule(spec.role == role, field, f"is for a network that {spec.role}: leave it out")
        yield Rule(
            modality in spec.modalities,
            field,
            f"is for networks over {' and '.join(spec.modalities)}: leave it out",
        )
        for requirement in spec.requires:
            check, remedy = REQUIREMENTS[requirement]
            yield Rule(check(experiment, modality), field, remedy)


def _has_codes(experiment: Experiment, modality: InputKind) -> bool:
    if modality == "pins":
        return experiment.pins.shear_code > 0 and not experiment.pins.turned
    return experiment.unshear.apart and not uses_pins(experiment)


def _shares_slides(experiment: Experiment, modality: InputKind) -> bool:
    paired = experiment.paired
    return isinstance(paired, PairedData) and paired.poses_a_slide > 1 and paired.slides > 1


def _has_two_slides(experiment: Experiment, modality: InputKind) -> bool:
    return isinstance(experiment.paired, PairedData) and experiment.paired.slides > 1


def _is_simulated(experiment: Experiment, modality: InputKind) -> bool:
    return get_recorded(experiment) is None


def _has_still_pins(experiment: Experiment, modality: InputKind) -> bool:
    return not experiment.pins.turned


# what a loss can require: whether an experiment has it, and what to do if not
REQUIREMENTS: dict[Requirement, tuple[Callable[[Experiment, InputKind], bool], str]] = {
    "codes": (
        _has_codes,
        "takes codes that are apart: set unshear.apart; "
        "over pins raise pins.shear_code, and leave pins.turned at 0",
    ),
    "shared slides": (
        _shares_slides,
        "takes simulated slides that poses share, two at least: "
        "raise paired.poses_a_slide and paired.slides",
    ),
    "two slides": (_has_two_slides, "takes two slides to a pose: raise paired.slides"),
    "simulated": (_is_simulated, "takes simulated contacts: leave it out"),
    "still pins": (_has_still_pins, "takes pins as they are: leave it out, or pins.turned at 0"),
}


def _list_separate_code_rules(experiment: Experiment) -> Iterator[Rule]:
    """Yield the rules of separate encoders, `apart`: z_s then learns from the slide alone."""
    yield Rule(
        not experiment.pins.apart or "slide" in experiment.train_pins.losses,
        "pins.apart",
        "leaves z_s to learn from the slide alone: raise train_pins.losses.slide",
    )
    yield Rule(
        not experiment.unshear.apart or not uses_pins(experiment),
        "unshear.apart",
        "is for networks over images: use pins.apart",
    )
    yield Rule(
        not experiment.unshear.apart
        or ("slide" in experiment.train.losses and experiment.unshear.shear_channels > 0),
        "unshear.apart",
        "leaves z_s to learn from the slide alone: "
        "raise train.losses.slide and unshear.shear_channels",
    )


def _list_few_pair_rules(experiment: Experiment) -> Iterator[Rule]:
    """Yield the rules of learning from a share of the pairs."""
    training = experiment.train_pins
    yield Rule(
        experiment.train.paired_share == 1,
        "train.paired_share",
        "is for networks over pins: leave it at 1",
    )
    yield Rule(
        training.paired_share == 1 or get_recorded(experiment) is None,
        "train_pins.paired_share",
        "is for simulated pairs: use paired.labelled",
    )
    yield Rule(
        training.paired_share == 1 or not uses_code_exchange(training),
        "train_pins.paired_share",
        f"leaves slides without their partners: leave it at 1, or {' and '.join(EXCHANGE)} out",
    )


def _list_pair_setting_rules(training: Training, group: str) -> Iterator[Rule]:
    """Yield the rules that a PoseNet's training leaves the settings of pairs at their defaults."""
    for field in ("crops", "crop_px", "paired_share"):
        default = getattr(Training, field)
        yield Rule(
            getattr(training, field) == default,
            f"{group}.{field}",
            f"is for networks that unshear: leave it at {default:g}",
        )


def list_target_rules(texts: tuple[str, ...], fields: Mapping[str, object]) -> Iterator[Rule]:
    """Yield the rules that each text is a target with a name among `fields`, named once."""
    names = []
    for text in texts:
        try:
            names.append(parse_target(text, fields).name)
        except UserError as error:
            yield Rule(False, "targets", str(error))
    yield Rule(len(set(names)) == len(names), "targets", "name each once")
