"""What an experiment file holds: one frozen dataclass for the whole way of the data. Imports no JAX."""

from dataclasses import dataclass, field, replace

from jaxunshear.dataset.settings import PairedData, PoseData
from jaxunshear.model.settings import PoseNet, UnshearNet
from jaxunshear.scene.sensor import TACTIP_331, Sensor
from jaxunshear.training.settings import Training

NETWORKS = ("entangled", "disentangled", "posenet")  # the paper's
RIVALS = ("entangled_large", "unet", "posenet_sheared")  # entangled with as many parameters; a U-Net; PoseNet on slides
TEACHER = "posenet_teacher"  # the PoseNet of `train.pose_weight`: trained first, from another seed, and never evaluated
ALL_NETWORKS = (*NETWORKS, *RIVALS)
UNSHEARING = ("entangled", "entangled_large", "unet", "disentangled")  # the last that a run has is the one it is about
TRAINABLE = (TEACHER, *ALL_NETWORKS)
POSENETS = ("posenet", "posenet_sheared", TEACHER)


@dataclass(frozen=True)
class Experiment:
    """One run: `jaxunshear run FILE` reads the variable `experiment` of FILE. Results go to runs/<name>/."""

    name: str
    claim: str
    seed: int = 0
    networks: tuple[str, ...] = NETWORKS  # trained and evaluated, of ALL_NETWORKS
    unseen: tuple[str, ...] = ()  # stimuli that no network sees in training, evaluated as a test of their own
    other_jitters_mm: tuple[float, ...] = ()  # tests of their own, with taps that miss the slide's depth by up to this
    sensor: Sensor = TACTIP_331
    targets: tuple[str, ...] = ()  # of a pose, as targets.py writes them; none: all usual ones that the data vary
    paired: PairedData = field(default_factory=PairedData)
    pose: PoseData = field(default_factory=PoseData)
    unshear: UnshearNet = field(default_factory=UnshearNet)
    posenet: PoseNet = field(default_factory=PoseNet)
    train: Training = field(default_factory=Training)  # UnshearNets, and the U-Net of the same widths
    train_posenet: Training = field(default_factory=Training)  # both PoseNets that are evaluated
    train_teacher: Training = field(default_factory=Training)  # the PoseNet of `train.pose_weight`


def trained(experiment: Experiment) -> tuple[str, ...]:
    """The networks to train, in this order: those of the results, after a teacher where one of them is taught."""
    taught = experiment.train.pose_weight and set(experiment.networks) - set(POSENETS)
    return (TEACHER, *experiment.networks) if taught else experiment.networks


def learnt_from(experiment: Experiment, network: str) -> PairedData | PoseData:
    """The data set that `network` learns from."""
    return experiment.pose if network in ("posenet", TEACHER) else experiment.paired


def training_of(experiment: Experiment, network: str) -> Training:
    """How `network` is trained."""
    if network == TEACHER:
        return experiment.train_teacher
    return experiment.train_posenet if network in POSENETS else experiment.train


def further_tests(experiment: Experiment) -> dict[str, PairedData]:
    """Data sets that are for tests alone, all of their splits: a fifth of the poses, as the test split has."""
    paired = experiment.paired
    fifth = replace(paired, poses=max(5, round(0.2 * paired.poses)), seed=paired.seed + 1000)
    tests = {}
    if experiment.unseen:
        tests["unseen"] = replace(fifth, stimuli=experiment.unseen)
    for jitter in experiment.other_jitters_mm:
        tests[f"depth_{jitter:g}mm"] = replace(fifth, tap_depth_jitter_mm=jitter)
    return tests
