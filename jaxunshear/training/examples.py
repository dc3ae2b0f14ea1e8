"""What a network of an experiment learns from and is tested on: simulated or recorded, images or pins, by one interface.

>>> examples = open_examples(experiment, "disentangled", data_dir, run_dir)
>>> examples.reader.train_batches(batch=8, seed=0, shift=0.0, fields=("canonical", "sheared"))
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxunshear.dataset import configs
from jaxunshear.dataset.reading import Reader, open_set
from jaxunshear.dataset.recorded_reading import RecordedSet, Render, open_recorded
from jaxunshear.dataset.settings import PairedData, PoseData
from jaxunshear.errors import UserError
from jaxunshear.experiment import RENDERER, TEACHER, Experiment, learnt_from, over_pins, recorded_of
from jaxunshear.image.framing import undeformed
from jaxunshear.model import pinnets, posenet
from jaxunshear.targets import Targets, of_ranges
from jaxunshear.training.checkpoint import SUMMARY, load_best, read_net, read_targets

OF_TAPS = ("posenet", TEACHER, RENDERER)
POSES_AT_ONCE = 1024
FRAME = "frame.json"  # in a run's folder: what the frames of its sensor have in common, see `dataset.preparing.Frame`


class Pins(NamedTuple):
    """What networks over pins must know of a sensor's images."""

    rest: np.ndarray  # (P, 2) px, untouched
    radius_px: float
    size: int  # of the images, px


class Examples(NamedTuple):
    reader: Reader
    targets: Targets
    pins: Pins
    epoch: int  # examples that count as one epoch: where few slides are labelled, as many as if all were


def open_examples(experiment: Experiment, network: str, data_dir: Path, run_dir: Path) -> Examples:
    """Raises UserError where the data set, or the renderer that its pairs take, is missing or damaged."""
    if recorded_of(experiment) is None:
        return _simulated(experiment, network, data_dir)
    stored = stored_of(experiment, data_dir)
    targets = stored.targets(experiment.targets)
    epoch = stored.count("slides", "train")
    if network in OF_TAPS:
        reader, epoch = stored.taps(), stored.count("taps", "train")
    elif network == "posenet_sheared":
        reader = stored.slides()
    else:
        reader = pairs_of(experiment, stored, targets, run_dir)
    return Examples(reader, targets, pins_of(stored.frame), epoch)


def stored_of(experiment: Experiment, data_dir: Path) -> RecordedSet:
    """The recorded set of an experiment. Raises UserError."""
    recorded = recorded_of(experiment)
    if recorded is None:
        raise UserError(f"'{experiment.name}' is about simulated touches, not recordings")
    return open_recorded(recorded, experiment.sensor, data_dir, experiment.seed)


def pairs_of(experiment: Experiment, stored: RecordedSet, targets: Targets, run_dir: Path) -> Reader:
    """Slides with their partners, drawn by the run's renderer where the pairing asks for one."""
    recorded = recorded_of(experiment)
    rendered = recorded is not None and recorded.pairing == "rendered"
    return stored.pairs(targets, _render(run_dir / RENDERER) if rendered else None, not over_pins(experiment))


def pins_of(frame: dict[str, Any]) -> Pins:
    return Pins(np.array(frame["place_px"], np.float32), float(frame["radius_px"]), int(frame["size"]))


def spread_of(reader: Reader, field: str, rest: np.ndarray) -> float:
    """Root mean square px by which the pins of training examples have moved."""
    pins = reader.take("train", np.arange(reader.length("train")), (field,))[field]
    return float(np.sqrt(np.nanmean(np.square(pins - rest))))


def _simulated(experiment: Experiment, network: str, data_dir: Path) -> Examples:
    settings = learnt_from(experiment, network)
    assert isinstance(settings, PairedData | PoseData)
    reader = open_set(configs.set_name(settings), settings, data_dir, experiment.sensor)
    size, camera = settings.preprocess.size, settings.camera
    rest = np.zeros((0, 2), np.float32)
    if over_pins(experiment):
        rest = undeformed(experiment.sensor, camera, settings.preprocess).place.astype(np.float32)
    radius = experiment.sensor.pin_radius_mm * size / camera.mm_across
    targets = of_ranges(experiment.targets, settings.ranges)
    return Examples(reader, targets, Pins(rest, radius, size), reader.length("train"))


def _render(folder: Path) -> Render:
    """The trained renderer in `folder` as a function of poses (N, 6). Raises UserError."""
    if not (folder / SUMMARY).exists():
        raise UserError(f"{folder} is missing, and pairs that are rendered need it: train renderer first")
    net, variables, targets = read_net(folder), load_best(folder), read_targets(folder)
    run = jax.jit(partial(pinnets.render, net, variables))

    def render(poses: np.ndarray) -> np.ndarray:
        parts = []
        for start in range(0, max(1, len(poses)), POSES_AT_ONCE):
            here = poses[start : start + POSES_AT_ONCE]
            filled = np.zeros((POSES_AT_ONCE, poses.shape[1]), np.float32)  # one shape to compile
            filled[: len(here)] = here
            parts.append(np.asarray(run(posenet.pose_targets({"pose": filled}, targets)))[: len(here)])
        return np.concatenate(parts)

    return render
