"""What an experiment can ask for: the rules of each of its settings, then those between them.

Nothing is simulated or trained, so a refusal takes no time.
"""

from collections.abc import Callable, Iterator
from dataclasses import fields

from jaxunshear.config.data import PairedData, Recorded, RecordedTaps, SourceSettings
from jaxunshear.config.experiment import FURTHER_TESTS, Experiment
from jaxunshear.config.fields import format_value, replace_field
from jaxunshear.config.losses import EXCHANGE, InputKind, Requirement, Role, get_loss
from jaxunshear.config.network_config import (
    list_trained_networks,
    resolve_trained_networks,
)
from jaxunshear.config.networks import POSENET_SHEARED, RENDERER, TEACHER, list_modality_networks
from jaxunshear.config.rules_simulated import list_simulated_rules
from jaxunshear.config.sensor import TACTIP_331_FITTED
from jaxunshear.config.targets import (
    LABELLED_SLIDES,
    RECORDED_FIELDS,
    list_slide_names,
    list_text_problems,
)
from jaxunshear.config.types import Rule, Value, check_types, get_value, list_declared_rules
from jaxunshear.errors import UserError


def list_recorded_rules(
    experiment: Experiment, recorded: Recorded, _: RecordedTaps
) -> Iterator[Rule]:
    """Yield the rules of an experiment about recordings."""
    trained = list_trained_networks(experiment)
    yield Rule(
        recorded.pairing != "simulated" or experiment.sensor.pins == TACTIP_331_FITTED.pins,
        "paired.pairing",
        f"simulated follows the one sensor that is fitted, of {TACTIP_331_FITTED.pins} pins; "
        f"yours has {experiment.sensor.pins}",
    )
    yield Rule(
        recorded.direct_taps != "rendered" or experiment.unshear.input == "pins",
        "paired.direct_taps",
        "rendered is for networks over pins: use recorded",
    )
    yield Rule(
        not (experiment.pins.turned and experiment.pins.direct_convolved),
        "pins.direct_convolved",
        "takes recorded pins as they are: leave pins.turned at 0",
    )
    yield Rule(
        experiment.train_pins.paired_share == 1,
        "train_pins.paired_share",
        "is for simulated pairs: use paired.labelled",
    )
    for field in ("unseen", *FURTHER_TESTS):
        yield Rule(
            not getattr(experiment, field),
            field,
            "is a test of simulated touches: leave it empty",
        )
    for problem in list_text_problems(experiment.targets, RECORDED_FIELDS | LABELLED_SLIDES):
        yield Rule(False, "targets", problem)
    if slides := ", ".join(list_slide_names(experiment.targets)):
        yield Rule(
            recorded.direct_taps != "rendered",
            "paired.direct_taps",
            f"rendered knows no {slides}: use recorded or none",
        )
        yield Rule(
            set(trained) == {POSENET_SHEARED},
            "targets",
            f"a tap has no {slides}: name --networks posenet_sheared alone",
        )
        yield Rule(
            not experiment.pins.turned,
            "pins.turned",
            f"does not turn {slides}: leave it at 0",
        )


# rules of the settings of a data source; those of other sources are their own alone
SOURCE_RULES: dict[type[SourceSettings], Callable[[Experiment, Value, Value], Iterator[Rule]]] = {
    PairedData: list_simulated_rules,
    Recorded: list_recorded_rules,
}
# fields that only some networks use: a value that changes none of them is refused
PARTLY_USED = (
    *("pins.turned", "pins.direct_convolved", "paired.direct_taps", "train.paired_share"),
    *(f"train_posenet.{field}" for field in ("crops", "crop_px", "paired_share")),
    *(f"train_teacher.{field}" for field in ("crops", "crop_px", "paired_share")),
)


def validate(experiment: Experiment) -> None:
    """Refuse, by dotted name and with a remedy, settings that no run could work with."""
    check_types(experiment)
    for rule in list_rules(experiment):
        if not rule.holds:
            value = format_value(get_value(experiment, rule.field))
            raise UserError(f"--{rule.field} {value}: {rule.remedy}")


def list_rules(experiment: Experiment) -> Iterator[Rule]:
    """Yield all rules for `experiment`; the first that does not hold is the one to report."""
    yield from list_declared_rules(experiment)
    paired, pose = experiment.paired, experiment.pose
    yield Rule(
        type(pose) is paired.pose_kind,
        "name",
        f"paired is {type(paired).__name__}, which takes pose={paired.pose_kind.__name__}()",
    )
    if source_rules := SOURCE_RULES.get(type(paired)):
        yield from source_rules(experiment, paired, pose)
    size, unshear, posenet = paired.preprocess.size, experiment.unshear, experiment.posenet
    for field, net_size in (("unshear.size", unshear.size), ("posenet.size", posenet.size)):
        yield Rule(
            net_size == size,
            field,
            "differs from the data set's images: "
            f"make it and paired.preprocess.size ({size}) equal",
        )
    yield Rule(
        unshear.disentangled,
        "unshear.disentangled",
        "both networks are trained from these settings: "
        "to train one of them use `--networks entangled`",
    )
    possible = list_modality_networks(unshear.input)
    others = ", ".join(name for name in experiment.networks if name not in possible)
    yield Rule(
        not others,
        "networks",
        f"{others} does not read {unshear.input}: use {', '.join(possible)}",
    )
    yield from _list_training_rules(experiment)
    yield from _list_effect_rules(experiment)


def _list_training_rules(experiment: Experiment) -> Iterator[Rule]:
    pins, trained = experiment.unshear.input == "pins", list_trained_networks(experiment)
    pairs, taps = experiment.paired.count_examples(experiment.pose)
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
    yield from _list_group_rules(experiment, "train", "unshears", pairs)
    for group, apart, code in (
        ("train", "unshear.apart", experiment.unshear.shear_channels),
        ("train_pins", "pins.apart", experiment.pins.shear_code),
    ):
        yield Rule(
            not get_value(experiment, apart)
            or ("slide" in getattr(experiment, group).losses and code > 0),
            apart,
            f"leaves z_s to learn from the slide alone: raise {group}.losses.slide, "
            "and the size of the shear code",
        )
    yield from _list_group_rules(experiment, "train_posenet", "reads poses", taps)
    if TEACHER in trained and not pins:
        yield from _list_group_rules(experiment, "train_teacher", "reads poses", taps)
    if pins or RENDERER in trained:
        yield from _list_group_rules(experiment, "train_pins", "unshears", min(pairs, taps))
    few = experiment.train_pins.paired_share < 1
    yield Rule(
        not few or set(EXCHANGE).isdisjoint(experiment.train_pins.losses),
        "train_pins.paired_share",
        f"leaves slides without their partners: leave it at 1, or {' and '.join(EXCHANGE)} out",
    )


def _list_group_rules(
    experiment: Experiment, group: str, role: Role, examples: int
) -> Iterator[Rule]:
    """Yield the rules that a batch has enough examples, and that losses have what they need."""
    training = getattr(experiment, group)
    yield Rule(
        training.batch <= examples,
        f"{group}.batch",
        f"is larger than the training set of {examples}: use a smaller batch or more poses",
    )
    modality: InputKind = "pins" if group == "train_pins" else "images"
    for name in training.losses:
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
    return experiment.unshear.apart and experiment.unshear.input == "images"


def _get_slides(experiment: Experiment) -> int:
    return getattr(experiment.paired, "slides", 0)


# what a loss can require: whether an experiment has it, and what to do if not
REQUIREMENTS: dict[Requirement, tuple[Callable[[Experiment, InputKind], bool], str]] = {
    "codes": (
        _has_codes,
        "takes codes that are apart: set unshear.apart; "
        "over pins raise pins.shear_code, and leave pins.turned at 0",
    ),
    "shared slides": (
        lambda experiment, _: (
            _get_slides(experiment) > 1 and getattr(experiment.paired, "poses_a_slide", 0) > 1
        ),
        "takes simulated slides that poses share, two at least: "
        "raise paired.poses_a_slide and paired.slides",
    ),
    "two slides": (
        lambda experiment, _: _get_slides(experiment) > 1,
        "takes two slides to a pose: raise paired.slides",
    ),
    "simulated": (
        lambda experiment, _: experiment.paired.is_simulated,
        "takes simulated contacts: leave it out",
    ),
    "still pins": (
        lambda experiment, _: not experiment.pins.turned,
        "takes pins as they are: leave it out, or pins.turned at 0",
    ),
}


def _list_effect_rules(experiment: Experiment) -> Iterator[Rule]:
    """Yield the rules that fields which few networks use have an effect on a trained one."""
    configs = resolve_trained_networks(experiment)
    for field in PARTLY_USED:
        group, _, name = field.partition(".")
        settings = getattr(experiment, group)
        if not hasattr(settings, name):
            continue
        default = next(each.default for each in fields(settings) if each.name == name)
        if getattr(settings, name) != default:
            plain = replace_field(experiment, field, default)
            yield Rule(
                resolve_trained_networks(plain) != configs,
                field,
                "changes none of the networks that this experiment trains: "
                f"leave it at {format_value(default)}",
            )
