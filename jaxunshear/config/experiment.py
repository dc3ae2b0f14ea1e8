"""What an experiment file holds: one frozen dataclass for the entire path of the data."""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace

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
    NETWORKS,
    POSENET_SHEARED,
    POSENETS,
    RENDERER,
    TAP_NETWORKS,
    TEACHER,
    UNSHEARING,
    list_networks,
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
    """One run: `jaxunshear run FILE` reads the variable `experiment` of FILE.

    Results go to runs/<name>/.
    """

    name: str  # also of the folder of its results
    claim: str  # what it is to show
    seed: int = 0  # of weights and batches
    # to train and evaluate: these, entangled_large, unet, posenet_sheared, and your own
    networks: tuple[str, ...] = NETWORKS
    # stimuli of a further test, which no network sees in training
    unseen: tuple[StimulusSetting, ...] = ()
    # one further test for each: taps miss the slide's depth by up to this
    other_jitters_mm: tuple[float, ...] = ()
    other_twists_deg: tuple[float, ...] = ()  # likewise: slides twist by up to this
    other_tilts_deg: tuple[float, ...] = ()  # likewise: the sensor leans by up to this
    sensor: Sensor = TACTIP_331  # by name, see `jaxunshear sensors`
    # pose targets, written as in targets.py; empty: all usual ones that vary in the data
    targets: tuple[str, ...] = ()
    paired: PairedData | Recorded = field(default_factory=PairedData)
    pose: PoseData | RecordedTaps = field(default_factory=PoseData)
    unshear: UnshearNet = field(default_factory=UnshearNet)
    posenet: PoseNet = field(default_factory=PoseNet)
    # of all networks over pins: those of `unshear.input` "pins", and the renderer
    pins: PinNet = field(default_factory=PinNet)
    # of UnshearNets, and of the U-Net of the same widths
    train: Training = field(default_factory=Training)
    train_posenet: Training = POSENET_TRAINING  # of both PoseNets that are evaluated
    train_teacher: Training = POSENET_TRAINING  # of the PoseNet of pose_label and pose_tap
    train_pins: Training = PIN_TRAINING  # of networks over pins, instead of the other three

    def rules(self) -> Iterator[Rule]:
        yield Rule(
            re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}", self.name) is not None,
            "name",
            "use letters, digits, '-', '_' and '.'; it names the folder of the results",
        )
        yield make_seed_rule(self.seed)
        yield Rule(
            len(self.networks) > 0, "networks", f"name at least one of {', '.join(list_networks())}"
        )
        yield Rule(
            len(set(self.networks)) == len(self.networks), "networks", "name each network once"
        )
        yield make_network_rule(self.networks)
        yield Rule(
            len(set(list_stimulus_names(self.unseen))) == len(self.unseen),
            "unseen",
            "name each stimulus once",
        )


def make_network_rule(networks: Sequence[str]) -> Rule:
    """Make the rule that networks are known."""
    unknown = ", ".join(name for name in networks if name not in list_networks())
    remedy = f"{unknown} is unknown: use one of {', '.join(list_networks())}"
    return Rule(not unknown, "networks", f"{remedy}, or name the experiment file that registers it")


def get_recorded(experiment: Experiment) -> Recorded | None:
    """Return the recordings that an experiment is about; None for a simulated one."""
    return experiment.paired if isinstance(experiment.paired, Recorded) else None


def require_simulated(experiment: Experiment, what: str) -> tuple[PairedData, PoseData]:
    """Return the simulated sets of an experiment.

    Raises UserError if it is about recordings, which `what` cannot use.
    """
    if isinstance(experiment.paired, Recorded) or isinstance(experiment.pose, RecordedTaps):
        raise UserError(
            f"{what} needs a model of simulated touches: '{experiment.name}' learnt from recordings"
        )
    return experiment.paired, experiment.pose


def uses_pins(experiment: Experiment) -> bool:
    """Return whether the networks that are evaluated read pins, not images."""
    return experiment.unshear.input == "pins"


def list_trained_networks(experiment: Experiment) -> tuple[str, ...]:
    """List the networks to train, in this order: `experiment.networks` after those they need.

    They may need a renderer, a teacher, and a PoseNet that reads slides without labels.
    """
    recorded = get_recorded(experiment)
    networks: list[str] = []
    if set(experiment.networks) & set(UNSHEARING):
        training = experiment.train_pins if uses_pins(experiment) else experiment.train
        if uses_teacher(training):
            networks.append(TEACHER)
        if recorded and recorded.unlabelled == "read":
            networks.append(POSENET_SHEARED)
    networks += experiment.networks
    if recorded and _needs_renderer(recorded, networks, uses_pins(experiment)):
        networks.insert(0, RENDERER)
    return tuple(dict.fromkeys(networks))


def _needs_renderer(recorded: Recorded, networks: Collection[str], pins: bool) -> bool:
    """Return whether one of `networks` learns from rendered taps."""
    return (
        (recorded.pairing in RENDERED_PAIRINGS and not set(UNSHEARING).isdisjoint(networks))
        or (recorded.direct_taps == "rendered" and POSENET_SHEARED in networks)
        or (pins and not set(TAP_NETWORKS).isdisjoint(networks))
    )


def list_required_networks(experiment: Experiment, network: str) -> tuple[str, ...]:
    """List the networks that must be trained in a folder, in this order, to have `network`."""
    return list_trained_networks(replace(experiment, networks=(network,)))


def get_training_data(experiment: Experiment, network: str) -> PairedData | PoseData | Recorded:
    """Return the data set that `network` learns from."""
    if isinstance(experiment.pose, PoseData) and network in TAP_NETWORKS:
        return experiment.pose
    return experiment.paired


def takes_taps(experiment: Experiment) -> bool:
    """Return whether a network of a simulated experiment learns from the taps of `pose`."""
    return any(
        name in TAP_NETWORKS or "tap_identity" in get_training(experiment, name).losses
        for name in list_trained_networks(experiment)
    )


def get_training(experiment: Experiment, network: str) -> Training:
    """Return how `network` is trained."""
    if network == RENDERER:
        return drop_pair_losses(experiment.train_pins, pins=1.0)
    if uses_pins(experiment) and network in POSENETS:
        return drop_pair_losses(
            experiment.train_pins, **_get_pin_posenet_losses(experiment, network)
        )
    if uses_pins(experiment):
        return experiment.train_pins
    if network == TEACHER:
        return experiment.train_teacher
    return experiment.train_posenet if network in POSENETS else experiment.train


def _get_pin_posenet_losses(experiment: Experiment, network: str) -> dict[str, float]:
    """Return the losses of a PoseNet over pins, which also learns from rendered taps, if any."""
    recorded = get_recorded(experiment)
    if network in TAP_NETWORKS:
        rendered = RENDERER in list_trained_networks(experiment)
    else:
        rendered = recorded is not None and recorded.direct_taps == "rendered"
    return {"pose": 1.0} | ({"rendered_pose": 1.0} if rendered else {})


def list_further_tests(experiment: Experiment) -> dict[str, PairedData]:
    """Return the settings of further test sets by the names of the tests.

    All splits of such a set are for testing, so it has a fifth of the poses, like a test split.
    """
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
