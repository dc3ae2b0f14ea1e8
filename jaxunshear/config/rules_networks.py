"""Rules between the settings of networks and of their trainings, whatever they learn from."""

from collections.abc import Iterator, Mapping

from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import (
    PAIR_LOSS_FIELDS,
    Experiment,
    get_recorded,
    list_trained_networks,
    uses_pins,
)
from jaxunshear.config.image import Preprocess
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
    """Of `pairs` and `taps` to learn from."""
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
    yield from _exchange(experiment)
    yield from _few_pairs(experiment)
    taught = TEACHER in list_trained_networks(experiment) and not uses_pins(experiment)
    for name in ("train_posenet", "train_teacher") if taught else ("train_posenet",):
        yield _batch(getattr(experiment, name), name, taps)
        yield from _without_pair_losses(getattr(experiment, name), name)
    if uses_pins(experiment) or RENDERER in list_trained_networks(experiment):
        yield _batch(experiment.train_pins, "train_pins", min(pairs, taps))
        unused = not experiment.train_pins.patch_weight
        yield unused, "train_pins.patch_weight", "is for networks over images: leave it at 0"


def _batch(training: Training, group: str, examples: int) -> Rule:
    remedy = f"is larger than the training set of {examples}: use a smaller batch or more poses"
    return training.batch <= examples, f"{group}.batch", remedy


def _exchange(experiment: Experiment) -> Iterator[Rule]:
    """What learning codes that do not leak takes."""
    paired, training = experiment.paired, experiment.train_pins
    shared = isinstance(paired, PairedData) and paired.poses_a_slide > 1 and paired.slides > 1
    share = "takes simulated slides that poses share, two at least: raise paired.poses_a_slide and paired.slides"
    for field in ("swap_weight", "agreement_weight", "slide_weight"):
        weight = getattr(experiment.train, field)
        yield (
            not weight or (experiment.unshear.apart and not uses_pins(experiment)),
            f"train.{field}",
            "takes codes of images that are apart: set unshear.apart, or leave it at 0",
        )
        yield not weight or shared or field != "swap_weight", f"train.{field}", share
        yield (
            not getattr(training, field)
            or (experiment.pins.shear_code > 0 and not experiment.pins.turned),
            f"train_pins.{field}",
            "takes a shear code, and pins as they are: raise pins.shear_code, leave pins.turned at 0",
        )
    yield (
        not experiment.pins.apart or training.slide_weight > 0,
        "pins.apart",
        "leaves z_s to learn from the slide alone: raise train_pins.slide_weight",
    )
    yield not training.swap_weight or shared, "train_pins.swap_weight", share
    yield (
        not experiment.unshear.apart or not uses_pins(experiment),
        "unshear.apart",
        "is of networks over images: use pins.apart",
    )
    yield (
        not experiment.unshear.apart
        or (experiment.train.slide_weight > 0 and experiment.unshear.shear_channels > 0),
        "unshear.apart",
        "leaves z_s to learn from the slide alone: raise train.slide_weight and unshear.shear_channels",
    )


def _few_pairs(experiment: Experiment) -> Iterator[Rule]:
    """What learning from a share of the pairs takes, and from taps without a slide."""
    simulated, over_images, training = (
        get_recorded(experiment) is None,
        experiment.train,
        experiment.train_pins,
    )
    yield (
        over_images.paired_share == 1,
        "train.paired_share",
        "is for networks over pins: leave it at 1",
    )
    yield (
        training.paired_share == 1 or simulated,
        "train_pins.paired_share",
        "is of simulated pairs: use paired.labelled",
    )
    yield (
        training.paired_share == 1 or not uses_code_exchange(training),
        "train_pins.paired_share",
        "leaves slides without their partners: leave it at 1, or swap_weight and agreement_weight at 0",
    )
    for field in ("tap_weight", "alike_weight"):
        weight = getattr(training, field)
        yield (
            not getattr(over_images, field),
            f"train.{field}",
            "is for networks over pins: leave it at 0",
        )
        yield (
            not weight or (simulated and not experiment.pins.turned),
            f"train_pins.{field}",
            "takes simulated pins as they are: leave it at 0, or pins.turned",
        )
    yield (
        not training.alike_weight
        or (isinstance(experiment.paired, PairedData) and experiment.paired.slides > 1),
        "train_pins.alike_weight",
        "takes two slides to a pose: raise paired.slides",
    )


def _without_pair_losses(training: Training, name: str) -> Iterator[Rule]:
    for field in PAIR_LOSS_FIELDS:
        value, unused = getattr(training, field), getattr(Training, field)
        yield (
            value == unused,
            f"{name}.{field}",
            f"is for networks that unshear: leave it at {_plain(unused)}",
        )


def _plain(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def list_target_rules(targets: tuple[str, ...], known: Mapping[str, object]) -> Iterator[Rule]:
    names = []
    for text in targets:
        try:
            names.append(parse_target(text, known)[0])
        except UserError as error:
            yield False, "targets", str(error)
    yield len(set(names)) == len(names), "targets", "name each once"
