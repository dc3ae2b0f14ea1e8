"""What an experiment file holds: one frozen dataclass for the entire path of the data."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from jaxunshear.config.data import PairedData, PoseData, RecordedTaps, Seed, SourceSettings
from jaxunshear.config.networks import NETWORKS, PinNet, PoseNet, UnshearNet, list_networks
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.config.stimuli import StimulusSetting, list_stimulus_names
from jaxunshear.config.training import POSENET_TRAINING, Training
from jaxunshear.config.types import Problem, replace_value

PIN_TRAINING = Training(
    epochs=100,
    batch=64,
    learning_rate=3e-3,
    beta1=0.9,
    ema_decay=0.999,
    shift=0.0,
    losses={"supervised": 1.0, "reconstruction": 0.3, "pose_label": 1.0},
    validate_every=500,
    validation_images=10_000,
)


@dataclass(frozen=True)
class Experiment:
    """One run: `jaxunshear run EXPERIMENT` uses the variable `experiment` of a file.

    Results go to runs/<name>/.
    """

    name: str  # name of the experiment, and of the folder of its results
    claim: str  # what the experiment is to show
    seed: Seed = 0  # seed of weights and batches
    # networks to train and evaluate: these, entangled_large, unet, posenet_sheared, and your own
    networks: tuple[str, ...] = NETWORKS
    # stimuli of a further test, which no network sees in training
    unseen: tuple[StimulusSetting, ...] = ()
    # one further test for each: taps miss the slide's depth by up to this
    other_jitters_mm: tuple[float, ...] = ()
    # one further test for each: slides twist by up to this
    other_twists_deg: tuple[float, ...] = ()
    # one further test for each: the sensor leans by up to this
    other_tilts_deg: tuple[float, ...] = ()
    sensor: Sensor = TACTIP_331  # one of those that `jaxunshear sensors` lists
    # pose targets, written as in targets.py; empty: all usual ones that vary in the data
    targets: tuple[str, ...] = ()
    paired: SourceSettings = field(default_factory=PairedData)
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

    def find_problems(self) -> Iterator[Problem]:
        if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}", self.name):
            remedy = "use letters, digits, '-', '_' and '.'; it names the folder of the results"
            yield "name", remedy
        known = ", ".join(list_networks())
        if not self.networks:
            yield "networks", f"name at least one of {known}"
        if len(set(self.networks)) < len(self.networks):
            yield "networks", "name each network once"
        if unknown := ", ".join(name for name in self.networks if name not in list_networks()):
            remedy = f"use one of {known}, or name the experiment file that registers it"
            yield "networks", f"{unknown} is unknown: {remedy}"
        if len(set(list_stimulus_names(self.unseen))) < len(self.unseen):
            yield "unseen", "name each stimulus once"


def uses_pins(experiment: Experiment) -> bool:
    """Return whether the networks that are evaluated read pins, not images."""
    return experiment.unshear.input == "pins"


# fields of an experiment that add further tests: the names of these tests, and what they set
FURTHER_TESTS = {
    "other_jitters_mm": ("depth_{:g}mm", "tap_depth_jitter_mm"),
    "other_twists_deg": ("twist_{:g}deg", "ranges.twist_deg"),
    "other_tilts_deg": ("tilt_{:g}deg", "ranges.tilt_deg"),
}


def list_further_tests(experiment: Experiment) -> dict[str, PairedData]:
    """Return the settings of further test sets by the names of the tests.

    All splits of such a set are for testing, so it has a fifth of the poses, like a test split.
    """
    paired = experiment.paired
    if not isinstance(paired, PairedData):
        return {}
    fifth = replace(paired, poses=max(5, round(0.2 * paired.poses)), seed=paired.seed + 1000)
    tests = {"unseen": replace(fifth, stimuli=experiment.unseen)} if experiment.unseen else {}
    for group, (name, setting) in FURTHER_TESTS.items():
        for value in getattr(experiment, group):
            tests[name.format(value)] = replace_value(fifth, setting, value)
    return tests
