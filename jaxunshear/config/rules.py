"""What an experiment can ask for: problems of each of its settings, then those between them.

Nothing is simulated or trained, so a refusal takes no time.
"""

from collections.abc import Iterator

from jaxunshear.config.data import PairedData, PoseData, Recorded, RecordedTaps
from jaxunshear.config.experiment import FURTHER_TESTS, Experiment, uses_pins
from jaxunshear.config.fields import format_value, replace_field
from jaxunshear.config.losses import EXCHANGE, InputKind, Requirement, Role, get_loss
from jaxunshear.config.network_config import list_trained_networks, resolve_trained_networks
from jaxunshear.config.networks import (
    POSENET_SHEARED,
    REGISTRY,
    RENDERER,
    TEACHER,
    list_networks,
)
from jaxunshear.config.rules_simulated import find_simulated_problems
from jaxunshear.config.sensor import TACTIP_331_FITTED, MarkerSensor
from jaxunshear.config.targets import (
    LABELLED_SLIDES,
    RECORDED_FIELDS,
    list_column_names,
    list_slide_names,
    list_text_problems,
)
from jaxunshear.config.types import Problem, check_types, find_problems, get_value
from jaxunshear.errors import UserError

UNKNOWN = 2**62  # examples, of data that are counted when they are read
OF_PAIRS = ("crops", "crop_px", "paired_share", "rotated_below")
# fields that only some networks use: a value that changes none of them is refused
PARTLY_USED = (
    "pins.rotated_share",
    "pins.direct_conv_channels",
    "paired.direct_taps",
    "train.paired_share",
    "train.rotated_below",
    "train_pins.paired_share",
    *(f"train_posenet.{field}" for field in OF_PAIRS),
    *(f"train_teacher.{field}" for field in OF_PAIRS),
)


def validate(experiment: Experiment) -> None:
    """Refuse, by dotted name and with a remedy, settings that no run could work with."""
    check_types(experiment)
    for field, remedy in find_experiment_problems(experiment):
        value = format_value(get_value(experiment, field))
        raise UserError(f"--{field} {value}: {remedy}")


def find_experiment_problems(experiment: Experiment) -> Iterator[Problem]:
    """Find all problems of `experiment`; the first is the one to report."""
    yield from find_problems(experiment)
    paired, pose = experiment.paired, experiment.pose
    pose_kind = PoseData if isinstance(paired, PairedData) else RecordedTaps
    if type(pose) is not pose_kind:
        yield "name", f"paired is {type(paired).__name__}, which takes pose={pose_kind.__name__}()"
    # a source that an experiment file adds has no problems but its own
    if type(paired) is PairedData and isinstance(pose, PoseData):
        yield from find_simulated_problems(experiment, paired, pose)
    if type(paired) is Recorded:
        yield from _find_recorded_problems(experiment, paired)
    size, unshear = paired.preprocess.size, experiment.unshear
    for group in ("unshear", "posenet"):
        if getattr(experiment, group).size != size:
            remedy = f"make it and paired.preprocess.size ({size}) equal"
            yield f"{group}.size", f"differs from the data set's images: {remedy}"
    if not unshear.disentangled:
        remedy = "it is a setting of both networks: to train one use `--networks entangled`"
        yield "unshear.disentangled", remedy
    possible = [name for name in list_networks() if unshear.input in REGISTRY[name].modalities]
    if others := ", ".join(name for name in experiment.networks if name not in possible):
        remedy = f"use {', '.join(possible)}"
        yield "networks", f"{others} does not read {unshear.input}: {remedy}"
    yield from _find_training_problems(experiment)
    yield from _find_unused_fields(experiment)


def _find_recorded_problems(experiment: Experiment, recorded: Recorded) -> Iterator[Problem]:
    """Find problems of an experiment about recordings, before these are read."""
    pins, sensor, fitted = experiment.pins, experiment.sensor, TACTIP_331_FITTED.pins
    is_dome = not (isinstance(sensor, MarkerSensor) or sensor.is_flat)
    is_fitted = sensor.pins == fitted and is_dome
    if recorded.pairing == "simulated" and not is_fitted:
        problem = f"simulated follows the one dome that is fitted, of {fitted} pins"
        yield "paired.pairing", f"{problem}; yours, {sensor.name}, has {sensor.pins}"
    if recorded.direct_taps == "rendered" and not uses_pins(experiment):
        yield "paired.direct_taps", "rendered is for networks over pins: use recorded"
    if pins.rotated_share and pins.direct_conv_channels:
        yield (
            "pins.direct_conv_channels",
            "takes recorded pins as they are: leave pins.rotated_share at 0",
        )
    for field in ("unseen", *FURTHER_TESTS):
        if getattr(experiment, field):
            yield field, "is a test of simulated touches: leave it empty"
    columns, slides = list_column_names(experiment.targets), list_slide_names(experiment.targets)
    known = (*RECORDED_FIELDS, *LABELLED_SLIDES, *columns)
    for problem in list_text_problems(experiment.targets, known):
        yield "targets", problem
    if columns or slides:
        yield from _find_label_target_problems(experiment, recorded, columns, slides)


def _find_label_target_problems(
    experiment: Experiment, recorded: Recorded, columns: list[str], slides: list[str]
) -> Iterator[Problem]:
    """Find what does not go with targets that are no poses: other columns, and slides."""
    names, trained = ", ".join(columns + slides), set(list_trained_networks(experiment))
    if recorded.direct_taps == "rendered":
        yield "paired.direct_taps", f"rendered knows no {names}: use recorded or none"
    if slides and trained != {POSENET_SHEARED}:
        remedy = f"a tap has no {', '.join(slides)}: name --networks posenet_sheared alone"
        yield "targets", remedy
    if columns and recorded.unlabelled == "pseudo_label":
        yield "paired.unlabelled", f"pseudo_label estimates no {', '.join(columns)}: use left_out"
    if experiment.pins.rotated_share:
        yield "pins.rotated_share", f"does not turn {names}: leave it at 0"


def _find_training_problems(experiment: Experiment) -> Iterator[Problem]:
    pins, trained = uses_pins(experiment), list_trained_networks(experiment)
    pairs, taps, paired, pose = UNKNOWN, UNKNOWN, experiment.paired, experiment.pose
    if isinstance(paired, PairedData) and isinstance(pose, PoseData):
        pairs, taps = paired.slides * paired.count_training_poses(), pose.count_training_poses()
    if experiment.train.crop_px > experiment.unshear.size:
        yield "train.crop_px", f"must be 1 to the image's {experiment.unshear.size} px"
    if experiment.train_pins.rotated_below and paired.is_simulated:
        yield "train_pins.rotated_below", "turns recorded pairs: set it to 0"
    if experiment.train_teacher.start:
        remedy = "leave it empty: the PoseNet that scores a network must not supervise it"
        yield "train_teacher.start", remedy
    yield from _find_group_problems(experiment, "train", "unshears", pairs)
    for group, field, code in (
        ("train", "unshear.separate_encoders", experiment.unshear.shear_channels),
        ("train_pins", "pins.separate_encoders", experiment.pins.shear_code),
    ):
        learns_slide = "slide" in getattr(experiment, group).losses and code > 0
        if get_value(experiment, field) and not learns_slide:
            remedy = f"raise {group}.losses.slide, and the size of the shear code"
            yield field, f"leaves z_s to learn from the slide alone: {remedy}"
    yield from _find_group_problems(experiment, "train_posenet", "reads poses", taps)
    if TEACHER in trained and not pins:
        yield from _find_group_problems(experiment, "train_teacher", "reads poses", taps)
    if pins or RENDERER in trained:
        yield from _find_group_problems(experiment, "train_pins", "unshears", min(pairs, taps))
    train_pins = experiment.train_pins
    if train_pins.paired_share < 1 and not set(EXCHANGE).isdisjoint(train_pins.losses):
        remedy = f"leave it at 1, or {' and '.join(EXCHANGE)} out"
        yield "train_pins.paired_share", f"leaves slides without their partners: {remedy}"


def _find_group_problems(
    experiment: Experiment, group: str, role: Role, examples: int
) -> Iterator[Problem]:
    """Find batches of more than all examples, and losses that lack what they need."""
    training = getattr(experiment, group)
    if training.batch > examples:
        remedy = "use a smaller batch or more poses"
        yield f"{group}.batch", f"is larger than the training set of {examples}: {remedy}"
    modality: InputKind = "pins" if group == "train_pins" else "images"
    is_met = _meet_requirements(experiment, modality)
    for name in training.losses:
        field = f"{group}.losses.{name}"
        try:
            spec = get_loss(name)
        except UserError as error:
            yield field, str(error)
            continue
        if spec.role != role:
            yield field, f"is for a network that {spec.role}: leave it out"
        if modality not in spec.modalities:
            kinds = " and ".join(spec.modalities)
            yield field, f"is for networks over {kinds}: leave it out"
        for requirement in spec.requires:
            if not is_met[requirement]:
                yield field, REMEDIES[requirement]


REMEDIES: dict[Requirement, str] = {  # if a loss requires what an experiment lacks
    "codes": "takes codes of separate encoders: set unshear.separate_encoders; "
    "over pins raise pins.shear_code, and leave pins.rotated_share at 0",
    "shared slides": "takes simulated slides that poses share, two at least: "
    "raise paired.poses_a_slide and paired.slides",
    "two slides": "takes two slides to a pose: raise paired.slides",
    "simulated": "takes simulated contacts: leave it out",
    "still pins": "takes pins as they are: leave it out, or pins.rotated_share at 0",
}


def _meet_requirements(experiment: Experiment, modality: InputKind) -> dict[Requirement, bool]:
    """Return whether an experiment has what losses may require of networks over `modality`."""
    paired, is_still = experiment.paired, not experiment.pins.rotated_share
    has_two_slides = getattr(paired, "slides", 0) > 1
    has_pin_codes = experiment.pins.shear_code > 0 and is_still
    has_image_codes = experiment.unshear.separate_encoders and not uses_pins(experiment)
    return {
        "codes": has_pin_codes if modality == "pins" else has_image_codes,
        "shared slides": has_two_slides and getattr(paired, "poses_a_slide", 0) > 1,
        "two slides": has_two_slides,
        "simulated": paired.is_simulated,
        "still pins": is_still,
    }


def _find_unused_fields(experiment: Experiment) -> Iterator[Problem]:
    """Find fields of PARTLY_USED that were changed, and that no trained network uses."""
    configs = resolve_trained_networks(experiment)
    for field in PARTLY_USED:
        group, _, name = field.partition(".")
        default = getattr(type(getattr(experiment, group)), name, None)
        if default is None or get_value(experiment, field) == default:
            continue
        if resolve_trained_networks(replace_field(experiment, field, default)) == configs:
            remedy = f"leave it at {format_value(default)}"
            yield field, f"changes none of the networks that this experiment trains: {remedy}"
