"""What an experiment file holds: one frozen dataclass for the entire path of the data."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import cast

from jaxunshear.config.data import (
    RENDERED_PAIRINGS,
    PairedData,
    PoseData,
    Recorded,
    RecordedTaps,
    make_seed_rule,
)
from jaxunshear.config.networks import PinNet, PoseNet, UnshearNet
from jaxunshear.config.registry import (
    ALL_NETWORKS,
    NETWORKS,
    POSENET_SHEARED,
    POSENETS,
    RENDERER,
    TAP_NETWORKS,
    TEACHER,
    UNSHEARING,
    Network,
)
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.config.stimuli import StimulusSetting, list_stimulus_names
from jaxunshear.config.training import (
    POSENET_TRAINING,
    Training,
    drop_pair_losses,
    uses_teacher,
)
from jaxunshear.config.types import Rule
from jaxunshear.errors import UserError

PIN_TRAINING = Training(
    epochs=100,
    batch=64,
    learning_rate=3e-3,
    beta1=0.9,
    averaging=0.999,
    shift=0.0,
    losses={"supervised": 1.0, "reconstruction": 0.3, "pose_label": 1.0},
    validate_every=500,
    validation_images=10_000,
)


@dataclass(frozen=True)
class Experiment:
    """One run: `jaxunshear run FILE` reads the variable `experiment` of FILE. Results go to runs/<name>/."""

    name: str  # of the folder of its results
    claim: str  # what it is to show
    seed: int = 0  # of weights and batches
    networks: tuple[Network, ...] = NETWORKS  # trained and evaluated, of ALL_NETWORKS
    # stimuli that no network sees in training, evaluated as a test of their own
    unseen: tuple[StimulusSetting, ...] = ()
    # tests of their own, with taps that miss the slide's depth by up to this
    other_jitters_mm: tuple[float, ...] = ()
    other_twists_deg: tuple[float, ...] = ()  # with slides that twist by up to this
    other_tilts_deg: tuple[float, ...] = ()  # with sensors that lean by up to this
    sensor: Sensor = TACTIP_331  # by name, see `jaxunshear sensors`
    # of a pose, as targets.py writes them; none: all usual ones that the data vary
    targets: tuple[str, ...] = ()
    paired: PairedData | Recorded = field(default_factory=PairedData)
    pose: PoseData | RecordedTaps = field(default_factory=PoseData)
    unshear: UnshearNet = field(default_factory=UnshearNet)
    posenet: PoseNet = field(default_factory=PoseNet)
    # all networks over pins: those of `unshear.input` "pins", and the renderer
    pins: PinNet = field(default_factory=PinNet)
    # UnshearNets, and the U-Net of the same widths
    train: Training = field(default_factory=Training)
    train_posenet: Training = POSENET_TRAINING  # both PoseNets that are evaluated
    train_teacher: Training = POSENET_TRAINING  # the PoseNet of pose_label and pose_tap
    train_pins: Training = PIN_TRAINING  # networks over pins, in the place of the first two

    def rules(self) -> Iterator[Rule]:
        named = re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}", self.name)
        yield (
            named is not None,
            "name",
            "use letters, digits, '-', '_' and '.'; it names the folder of the results",
        )
        yield make_seed_rule(self.seed)
        yield len(self.networks) > 0, "networks", f"name at least one of {', '.join(ALL_NETWORKS)}"
        yield len(set(self.networks)) == len(self.networks), "networks", "name each network once"
        yield (
            len(set(list_stimulus_names(self.unseen))) == len(self.unseen),
            "unseen",
            "name each stimulus once",
        )


def get_recorded(experiment: Experiment) -> Recorded | None:
    """The recordings that an experiment is about; None for a simulated one."""
    return experiment.paired if isinstance(experiment.paired, Recorded) else None


def require_simulated(experiment: Experiment, what: str) -> tuple[PairedData, PoseData]:
    """The simulated sets of an experiment. Raises UserError where it is about recordings, which `what` cannot use."""
    if isinstance(experiment.paired, Recorded) or isinstance(experiment.pose, RecordedTaps):
        raise UserError(
            f"{what} needs a model of simulated touches: '{experiment.name}' learnt from recordings"
        )
    return experiment.paired, experiment.pose


def uses_pins(experiment: Experiment) -> bool:
    """Whether the networks that are evaluated read pins, not images."""
    return experiment.unshear.input == "pins"


def list_trained_networks(experiment: Experiment) -> tuple[str, ...]:
    """The networks to train, in this order: those of the results, after those that one of them needs: a
    renderer, a teacher, a reader of slides without labels."""
    unshears = set(experiment.networks) & set(UNSHEARING)
    recorded = get_recorded(experiment)
    reader = (POSENET_SHEARED,) if recorded and recorded.unlabelled == "read" and unshears else ()
    training = experiment.train_pins if uses_pins(experiment) else experiment.train
    taught = (TEACHER,) if uses_teacher(training) and unshears else ()
    drawn = uses_pins(experiment) and set(TAP_NETWORKS) & {
        *experiment.networks,
        *taught,
    }  # learn from rendered taps, too
    direct = (
        recorded is not None
        and recorded.direct_taps == "rendered"
        and POSENET_SHEARED in (*reader, *experiment.networks)
    )
    partners = recorded is not None and recorded.pairing in RENDERED_PAIRINGS and unshears
    rendered = (RENDERER,) if recorded and (drawn or direct or partners) else ()
    return tuple(dict.fromkeys((*rendered, *taught, *reader, *experiment.networks)))


def list_required_networks(experiment: Experiment, network: str) -> tuple[str, ...]:
    """The networks that must be trained in a folder, in this order, to have `network` there."""
    return list_trained_networks(replace(experiment, networks=(cast(Network, network),)))


def get_training_data(experiment: Experiment, network: str) -> PairedData | PoseData | Recorded:
    """The data set that `network` learns from."""
    if isinstance(experiment.pose, PoseData) and network in TAP_NETWORKS:
        return experiment.pose
    return experiment.paired


def takes_taps(experiment: Experiment) -> bool:
    """Whether a network of a simulated experiment learns from the taps without slides, `pose`."""
    return any(
        name in TAP_NETWORKS or "tap" in get_training(experiment, name).losses
        for name in list_trained_networks(experiment)
    )


def get_training(experiment: Experiment, network: str) -> Training:
    """Return how `network` is trained."""
    if network == RENDERER:
        return drop_pair_losses(experiment.train_pins, pins=1.0)
    if uses_pins(experiment) and network in POSENETS:
        return drop_pair_losses(
            experiment.train_pins, **_list_pin_posenet_losses(experiment, network)
        )
    if uses_pins(experiment):
        return experiment.train_pins
    if network == TEACHER:
        return experiment.train_teacher
    return experiment.train_posenet if network in POSENETS else experiment.train


def _list_pin_posenet_losses(experiment: Experiment, network: str) -> dict[str, float]:
    """Return the losses of a PoseNet over pins: rendered taps teach it, too, where there are any."""
    recorded = get_recorded(experiment)
    if network in TAP_NETWORKS:
        rendered = RENDERER in list_trained_networks(experiment)
    else:
        rendered = recorded is not None and recorded.direct_taps == "rendered"
    return {"pose": 1.0} | ({"rendered_pose": 1.0} if rendered else {})


def list_further_tests(experiment: Experiment) -> dict[str, PairedData]:
    """Data sets that are for tests alone, all of their splits: a fifth of the poses, as the test split has."""
    if not isinstance(experiment.paired, PairedData):
        return {}
    paired = experiment.paired
    fifth = replace(paired, poses=max(5, round(0.2 * paired.poses)), seed=paired.seed + 1000)
    tests = {}
    if experiment.unseen:
        tests["unseen"] = replace(fifth, stimuli=experiment.unseen)
    for jitter in experiment.other_jitters_mm:
        tests[f"depth_{jitter:g}mm"] = replace(fifth, tap_depth_jitter_mm=jitter)
    for twist in experiment.other_twists_deg:
        tests[f"twist_{twist:g}deg"] = replace(
            fifth, ranges=replace(paired.ranges, twist_deg=twist)
        )
    for tilt in experiment.other_tilts_deg:
        tests[f"tilt_{tilt:g}deg"] = replace(fifth, ranges=replace(paired.ranges, tilt_deg=tilt))
    return tests
