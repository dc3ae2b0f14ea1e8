"""Examples that a network learns from and is tested on: simulated or recorded, images or pins.

>>> examples = open_examples(experiment, "disentangled", data_dir, run_dir)
>>> examples.reader.train_batches(batch=8, seed=0, shift=0.0, fields=("canonical", "sheared"))
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxunshear.config.data import RENDERED_PAIRINGS, PairedData, PoseData
from jaxunshear.config.experiment import Experiment, get_recorded, get_training_data, uses_pins
from jaxunshear.config.registry import POSENET_SHEARED, RENDERER, TAP_NETWORKS
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.targets import (
    RECORDED_FIELDS,
    Targets,
    make_range_targets,
    make_slide_targets,
)
from jaxunshear.data.factorial import FactorialReader
from jaxunshear.data.reader import Batch, Reader, SetReader, open_set
from jaxunshear.data.recorded_set import (
    PoseEstimator,
    RecordedSet,
    SlideSimulator,
    TapRenderer,
    open_recorded,
)
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.models import pin_networks, posenet
from jaxunshear.models.weights import Net, Variables
from jaxunshear.training.checkpoint import SUMMARY, load_best, read_net, read_targets

POSES_AT_ONCE = 1024
IMAGES_AT_ONCE = 128
FRAME = "frame.json"  # in a run's folder: what all frames of its sensor have in common


class PinLayout(NamedTuple):
    """The pins of a sensor in its images, for networks over pins."""

    rest: np.ndarray  # (P, 2) px: the mean place over training taps
    radius_px: float
    size: int  # of the images, px


class Examples(NamedTuple):
    reader: Reader
    targets: Targets
    pins: PinLayout
    epoch: int  # examples that count as one epoch: unlabelled slides count, too
    taps: Reader | None = None  # recorded ones with labels, if there are any
    slides: Targets = ()  # what varies between the slides of the data


class TrainedNetwork(NamedTuple):
    net: Net
    variables: Variables
    targets: Targets


def open_examples(experiment: Experiment, network: str, data_dir: Path, run_dir: Path) -> Examples:
    """Open the examples of `network`.

    Raises UserError if the data set, or the renderer that its pairs take, is missing or damaged.
    """
    if get_recorded(experiment) is None:
        return _open_simulated_examples(experiment, network, data_dir)
    stored = open_recorded_set(experiment, data_dir)
    targets = stored.make_targets(experiment.targets)
    epoch = stored.count_contacts("slides", "train")
    if network in TAP_NETWORKS:
        reader, epoch = stored.read_taps(), stored.count_contacts("taps", "train")
    elif network == POSENET_SHEARED:
        reader = stored.read_slides(
            _make_slide_simulator(experiment, stored, data_dir), not uses_pins(experiment)
        )
        if stored.settings.direct_taps == "recorded":
            epoch += stored.count_contacts("taps", "train")
    else:
        reader = open_pairs(experiment, stored, targets, run_dir, data_dir)
    if stored.settings.pairing == "simulated":
        epoch = stored.count_contacts("taps", "train")
    taps = stored.read_taps() if stored.count_contacts("taps", "train") else None
    return Examples(
        reader, targets, read_pin_layout(stored.frame), epoch, taps, stored.make_slide_targets()
    )


def open_recorded_set(experiment: Experiment, data_dir: Path) -> RecordedSet:
    """Open the recorded set of an experiment. Raises UserError."""
    recorded = get_recorded(experiment)
    if recorded is None:
        raise UserError(f"'{experiment.name}' is about simulated touches, not recordings")
    return open_recorded(recorded, experiment.sensor, data_dir, experiment.seed)


def open_pairs(
    experiment: Experiment, stored: RecordedSet, targets: Targets, run_dir: Path, data_dir: Path
) -> Reader:
    """Open slides with the taps that they are paired with.

    If the pairing takes a renderer, it is that of the run. If the settings give unlabelled slides
    poses, the run's posenet_sheared estimates these.
    """
    settings, pins = stored.settings, uses_pins(experiment)
    render = estimate = None
    if settings.pairing in RENDERED_PAIRINGS:
        render = _load_tap_renderer(run_dir / RENDERER)
    simulate = _make_slide_simulator(experiment, stored, data_dir)
    if settings.unlabelled == "read":
        estimate = _load_pose_estimator(run_dir / POSENET_SHEARED, pins)
    return stored.read_pairs(targets, render, not pins, estimate, simulate)


def _make_slide_simulator(
    experiment: Experiment, stored: RecordedSet, data_dir: Path
) -> SlideSimulator | None:
    if stored.settings.pairing != "simulated":
        return None
    from jaxunshear.training.simulated_slides import make_slide_simulator

    return make_slide_simulator(stored, experiment.sensor, data_dir)


def read_pin_layout(frame: Json) -> PinLayout:
    return PinLayout(
        np.array(frame["place_px"], np.float32), float(frame["radius_px"]), int(frame["size"])
    )


def read_all_training(reader: Reader, *fields: str) -> Batch:
    """Read all training examples, in their order."""
    return reader.take("train", np.arange(reader.length("train")), fields)


def measure_pin_spread(reader: Reader, field: str, rest: np.ndarray) -> float:
    """Measure how far the pins of training examples have moved, root mean square in px."""
    pins = read_all_training(reader, field)[field]
    return float(np.sqrt(np.nanmean(np.square(pins - rest))))


def _measure_rest(reader: Reader, field: str) -> np.ndarray:
    """Average the pins of training taps, (P, 2) px.

    The rest positions of recordings are found in this way, too, for want of untouched pins.
    """
    return read_all_training(reader, field)[field].mean(axis=0, dtype=np.float64)


def _open_simulated_examples(experiment: Experiment, network: str, data_dir: Path) -> Examples:
    settings = get_training_data(experiment, network)
    assert isinstance(settings, PairedData | PoseData)
    reader = open_simulated_set(settings, experiment.sensor, data_dir)
    size, camera = settings.preprocess.size, settings.camera
    rest = np.zeros((0, 2), np.float32)
    if uses_pins(experiment):
        rest = _measure_rest(
            reader, "canonical_pins" if isinstance(settings, PairedData) else "pins"
        )
    radius = experiment.sensor.pin_radius_mm * size / camera.mm_across
    targets = make_range_targets(experiment.targets, settings.ranges)
    slides = make_slide_targets(settings.ranges) if isinstance(settings, PairedData) else ()
    return Examples(
        reader, targets, PinLayout(rest, radius, size), reader.length("train"), slides=slides
    )


def open_simulated_set(
    settings: PairedData | PoseData, sensor: Sensor, data_dir: Path
) -> SetReader:
    """Open a simulated set. Raises UserError if it is missing or was made with other settings."""
    shared = isinstance(settings, PairedData) and settings.poses_a_slide > 1
    return open_set(settings, data_dir, sensor, FactorialReader if shared else SetReader)


def _load_tap_renderer(folder: Path) -> TapRenderer:
    """Load the renderer in `folder` as a function of poses (N, 6). Raises UserError."""
    net, variables, targets = _load_network(folder, "pairs that are rendered")
    run = jax.jit(partial(pin_networks.render_pins, net, variables))

    def render_part(poses: np.ndarray) -> ArrayLike:
        return run(posenet.scale_poses({"pose": poses}, targets))

    def render(poses: np.ndarray) -> np.ndarray:
        return _run_in_parts(render_part, poses, POSES_AT_ONCE)

    return render


def _load_pose_estimator(folder: Path, uses_pins: bool) -> PoseEstimator:
    """Load the PoseNet in `folder`, over pins or images, as a function of images and pins.

    It returns poses (N, 6), 0 in columns that are not among its targets. Raises UserError.
    """
    net, variables, targets = _load_network(folder, "slides without labels that are read")
    predict = partial((pin_networks if uses_pins else posenet).predict, net, variables)
    run = jax.jit(lambda inputs: posenet.unscale_outputs(predict(inputs), targets))

    def estimate_part(inputs: np.ndarray) -> np.ndarray:
        if not uses_pins:
            inputs = inputs[..., None].astype(np.float32) / 255
        poses = run(inputs)
        zero = np.zeros(len(inputs), np.float32)
        return np.stack([np.asarray(poses.get(name, zero)) for name in RECORDED_FIELDS], axis=-1)

    def estimate(images: np.ndarray | None, pins: np.ndarray) -> np.ndarray:
        return _run_in_parts(estimate_part, pins if images is None else images, IMAGES_AT_ONCE)

    return estimate


def _load_network(folder: Path, what: str) -> TrainedNetwork:
    """Load a trained network that `what` needs. Raises UserError."""
    if not (folder / SUMMARY).exists():
        raise UserError(f"{folder} is missing, and {what} need it: train {folder.name} first")
    return TrainedNetwork(read_net(folder), load_best(folder), read_targets(folder))


def _run_in_parts(
    function: Callable[[np.ndarray], ArrayLike], values: np.ndarray, count: int
) -> np.ndarray:
    """Run `function` on `values` (N, ...), `count` at a time: one shape to compile."""
    results = []
    for start in range(0, max(1, len(values)), count):
        part = values[start : start + count]
        filled = np.zeros((count, *values.shape[1:]), values.dtype)
        filled[: len(part)] = part
        results.append(np.asarray(function(filled))[: len(part)])
    return np.concatenate(results)
