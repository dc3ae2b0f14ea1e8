"""The slides that probes learn from and are tested on, with all that they may be asked for."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.data import PairedData, Ranges
from jaxunshear.config.experiment import Experiment, get_recorded, uses_pins
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
from jaxunshear.selection import select_evenly
from jaxunshear.training.examples import Examples, open_recorded_set

MOST_LEARNT, MOST_TESTED = 4000, 2000  # slides, evenly chosen
LABELS = ("pose", "move", "stimulus", "pose_id")
PINS = "sheared_pins"

Quantities = dict[str, np.ndarray]  # (N, 1), or (N, 2) of an angle over the full circle, by name


class ProbeSplit(NamedTuple):
    """Slides that probes learn from, or are tested on."""

    inputs: np.ndarray  # what the network is given
    pins: np.ndarray  # (N, 2 P) px, finite
    quantities: dict[str, Quantities]  # "pose" and "slide"
    poses: np.ndarray  # (N,) which pose a slide belongs to
    batch: Batch


def read_splits(
    experiment: Experiment, examples: Examples, data_dir: Path
) -> tuple[ProbeSplit, ProbeSplit]:
    pose = _pose(experiment, data_dir)
    train = _read_split(experiment, examples, pose, "train", MOST_LEARNT)
    test = _read_split(experiment, examples, pose, "test", MOST_TESTED)
    mean = np.nanmean(train.pins, axis=0)  # a pin that is not seen counts as it is on average
    train, test = (
        s._replace(pins=np.where(np.isfinite(s.pins), s.pins, mean)) for s in (train, test)
    )
    return train, test


def _read_split(
    experiment: Experiment, examples: Examples, pose: list[Target], split: str, most: int
) -> ProbeSplit:
    batch = take_labelled(experiment, examples.reader, split, most)
    wanted = {"pose": _values(pose, batch), "slide": compute_slides(examples.slides, batch)}
    seen = batch[PINS if uses_pins(experiment) else "sheared"]
    poses = number_poses(batch["stimulus"], batch["pose_id"])
    return ProbeSplit(seen, compute_pin_features(batch[PINS]), wanted, poses, batch)


def take_labelled(experiment: Experiment, reader: Reader, split: str, most: int) -> Batch:
    """Evenly chosen slides with labels, those whose pins are sure."""
    sure = ("sure",) if get_recorded(experiment) else ()
    batch = reader.take(split, np.arange(reader.length(split)), (*LABELS, *sure))
    kept = np.isfinite(batch["pose"]).all(axis=1) & np.isfinite(batch["move"]).all(axis=1)
    rows = np.flatnonzero(kept & (batch["sure"] == 1) if sure else kept)
    if not len(rows):
        raise UserError(
            f"no {split} slide has labels of its pose and its slide: there is nothing to probe for"
        )
    rows = rows[select_evenly(len(rows), most)]
    more = () if get_recorded(experiment) else ("felt", "edge", "stuck", "slipping")
    images = () if uses_pins(experiment) else ("sheared",)
    return reader.take(split, rows, (PINS, *images, *LABELS, *more))


def _pose(experiment: Experiment, data_dir: Path) -> list[Target]:
    """All of a pose that the data vary."""
    if isinstance(experiment.paired, PairedData):
        return [
            target
            for name in SIMULATED_FIELDS
            for target in _list_varied_targets(name, experiment.paired.ranges)
        ]
    return list(open_recorded_set(experiment, data_dir).make_targets(()))


def compute_slides(slides: Targets, batch: Batch) -> Quantities:
    """The slide in mm and deg: as the sensor feels it; of recordings as it is labelled."""
    return {name: value[:, None] for name, value in read_true_values(slides, batch).items()}


def _list_varied_targets(name: str, ranges: Ranges) -> tuple[Target, ...]:
    try:
        return make_range_targets((name,), ranges)
    except UserError:  # it does not vary
        return ()


def _values(targets: list[Target], batch: Batch) -> Quantities:
    values = {}
    for target in targets:
        value = batch[target.field][:, target.column].astype(np.float64)
        angle = np.radians(value)
        scaled = (
            [np.cos(angle), np.sin(angle)]
            if target.is_circular
            else [(value - target.centre) / target.half_range]
        )
        values[target.name] = np.stack(scaled, axis=-1)
    return values
