"""The slides that probes learn from and are tested on, with the quantities that they predict."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.data import PairedData, Ranges
from jaxunshear.config.experiment import Experiment, get_recorded
from jaxunshear.config.targets import (
    SIMULATED_FIELDS,
    Target,
    Targets,
    make_range_targets,
    read_true_values,
)
from jaxunshear.data.reader import Batch, Reader
from jaxunshear.errors import UserError
from jaxunshear.evaluation.bootstrap import number_poses
from jaxunshear.evaluation.pose_estimators import compute_pin_features
from jaxunshear.models.modality import PINS, get_modality
from jaxunshear.selection import select_evenly
from jaxunshear.training.examples import Examples, open_recorded_set

MAX_TRAINING, MAX_TESTED = 4000, 2000  # slides, evenly chosen
LABELS = ("pose", "move", "stimulus", "pose_id")

Quantities = dict[str, np.ndarray]  # by name (N, 1), or (N, 2) if it is a circular angle


class ProbeSplit(NamedTuple):
    """Slides that probes learn from, or are tested on."""

    inputs: np.ndarray  # of the network
    pins: np.ndarray  # (N, 2 P) px, finite
    quantities: dict[str, Quantities]  # "pose" and "slide"
    poses: np.ndarray  # (N,) which pose a slide belongs to
    batch: Batch


def read_splits(
    experiment: Experiment, examples: Examples, data_dir: Path
) -> tuple[ProbeSplit, ProbeSplit]:
    """Read the slides that probes learn from, and those that they are tested on."""
    targets = _list_pose_targets(experiment, data_dir)
    train = _read_split(experiment, examples, targets, "train", MAX_TRAINING)
    test = _read_split(experiment, examples, targets, "test", MAX_TESTED)
    mean = np.nanmean(train.pins, axis=0)
    return _fill_pins(train, mean), _fill_pins(test, mean)


def _fill_pins(split: ProbeSplit, mean: np.ndarray) -> ProbeSplit:
    """Replace missing pins by their mean."""
    return split._replace(pins=np.where(np.isfinite(split.pins), split.pins, mean))


def _read_split(
    experiment: Experiment, examples: Examples, targets: Targets, split: str, most: int
) -> ProbeSplit:
    batch = read_labelled_slides(experiment, examples.reader, split, most)
    return ProbeSplit(
        batch[get_modality(experiment).sheared],
        compute_pin_features(batch[PINS.sheared]),
        {"pose": _scale_poses(targets, batch), "slide": read_slides(examples.slides, batch)},
        number_poses(batch["stimulus"], batch["pose_id"]),
        batch,
    )


def read_labelled_slides(experiment: Experiment, reader: Reader, split: str, most: int) -> Batch:
    """Read at most `most` slides, evenly chosen, that have labels and identified pins."""
    is_recorded = get_recorded(experiment) is not None
    fields = (*LABELS, "sure") if is_recorded else LABELS
    batch = reader.take(split, np.arange(reader.length(split)), fields)
    usable = np.isfinite(batch["pose"]).all(axis=1) & np.isfinite(batch["move"]).all(axis=1)
    if is_recorded:
        usable &= batch["sure"] == 1
    rows = np.flatnonzero(usable)
    if not len(rows):
        raise UserError(
            f"no {split} slide has labels of its pose and its slide: there is nothing to probe for"
        )
    rows = rows[select_evenly(len(rows), most)]
    inputs = dict.fromkeys((PINS.sheared, get_modality(experiment).sheared))
    contact_state = () if is_recorded else ("felt", "edge", "stuck", "slipping")
    return reader.take(split, rows, (*inputs, *LABELS, *contact_state))


def read_slides(slides: Targets, batch: Batch) -> Quantities:
    """Read the slides (N, 1) in mm and deg.

    Simulated slides are in the sensor's frame, recorded ones in the frame of their labels.
    """
    return {name: value[:, None] for name, value in read_true_values(slides, batch).items()}


def _list_pose_targets(experiment: Experiment, data_dir: Path) -> Targets:
    """List all components of the pose that the data vary."""
    if not isinstance(experiment.paired, PairedData):
        return open_recorded_set(experiment, data_dir).make_targets(())
    targets: list[Target] = []
    for name in SIMULATED_FIELDS:
        targets += _list_varied_targets(name, experiment.paired.ranges)
    return tuple(targets)


def _list_varied_targets(name: str, ranges: Ranges) -> Targets:
    try:
        return make_range_targets((name,), ranges)
    except UserError:  # it does not vary
        return ()


def _scale_poses(targets: Targets, batch: Batch) -> Quantities:
    poses = {}
    for target in targets:
        value = batch[target.field][:, target.column].astype(np.float64)
        if target.is_circular:
            angle = np.radians(value)
            scaled = [np.cos(angle), np.sin(angle)]
        else:
            scaled = [(value - target.centre) / target.half_range]
        poses[target.name] = np.stack(scaled, axis=-1)
    return poses
