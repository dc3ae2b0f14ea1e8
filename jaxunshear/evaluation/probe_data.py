"""The slides that probes learn from and are tested on, and estimates of how far they went."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.targets import read_true_values
from jaxunshear.data.reader import Batch, Reader
from jaxunshear.data.sources import Examples, open_source
from jaxunshear.errors import UserError
from jaxunshear.evaluation.codes import CodeNetwork, split_by_slip
from jaxunshear.evaluation.intervals import LEVEL, compute_interval, resample_means
from jaxunshear.evaluation.pose_estimators import compute_pin_features
from jaxunshear.evaluation.probes import fit_gaussian, prepare_task
from jaxunshear.files import Json
from jaxunshear.models.modality import PINS
from jaxunshear.selection import number_poses, select_evenly

MOST_SLIDES = {"train": 4000, "validation": 2000, "test": 2000}  # evenly chosen
LABELS = ("pose", "move", "stimulus", "pose_id")
OPTIONAL_LABELS = ("felt", "edge", "stuck", "slipping")  # of simulated slides

SEED = 0  # of the bootstrap
Quantity = tuple[str, str]  # "pose" or "slide", and the name


class ProbeSplit(NamedTuple):
    """Slides that probes learn from, or are tested on."""

    features: dict[str, np.ndarray]  # (N, F): "pins" px, finite; codes by name
    quantities: dict[Quantity, np.ndarray]  # (N, 1), or (N, 2) if it is a circular angle
    poses: np.ndarray  # (N,) which pose a slide belongs to
    batch: Batch

    def join_codes(self) -> np.ndarray:
        return np.concatenate([self.features["z_p"], self.features["z_s"]], axis=1)

    def list_slides(self) -> list[str]:
        return [name for part, name in self.quantities if part == "slide"]

    def stack_slides(self) -> np.ndarray:
        """Stack the slides (N, K), mm or deg."""
        names = self.list_slides()
        return np.concatenate([self.quantities["slide", name] for name in names], axis=1)


def read_splits(
    experiment: Experiment, examples: Examples, data_dir: Path, networks: dict[str, CodeNetwork]
) -> dict[str, ProbeSplit]:
    """Read the slides of each split, with codes by `networks`, whose names are prefixes.

    Slides of the pose are scaled by their range; slides are in mm and deg, simulated ones in the
    sensor's frame, recorded ones in the frame of their labels.
    """
    targets = open_source(experiment).make_pose_targets(data_dir)
    splits = {}
    for split, most in MOST_SLIDES.items():
        batch = _read_labelled_slides(examples.reader, split, most, networks[""].modality.sheared)
        quantities: dict[Quantity, np.ndarray] = {}
        for target in targets:
            quantities["pose", target.name] = target.scale(batch[target.field][:, target.column])
        for name, value in read_true_values(examples.slide_targets, batch).items():
            quantities["slide", name] = value[:, None]
        features = {"pins": compute_pin_features(batch[PINS.sheared])}
        for prefix, network in networks.items():
            codes = network.encode(batch[network.modality.sheared])
            for name, code in codes.items():
                features[prefix + name] = code.reshape(len(code), -1)
        poses = number_poses(batch["stimulus"], batch["pose_id"])
        splits[split] = ProbeSplit(features, quantities, poses, batch)
    mean = np.nanmean(splits["train"].features["pins"], axis=0)
    for each in splits.values():
        pins = each.features["pins"]
        each.features["pins"] = np.where(np.isfinite(pins), pins, mean)
    return splits


def _read_labelled_slides(reader: Reader, split: str, most: int, inputs: str) -> Batch:
    """Read at most `most` slides, evenly chosen, that have labels and identified pins."""
    stored = reader.rows(split)
    usable = np.isfinite(stored["pose"]).all(axis=1) & np.isfinite(stored["move"]).all(axis=1)
    if "sure" in stored:
        usable &= stored["sure"] == 1
    rows = np.flatnonzero(usable)
    if not len(rows):
        raise UserError(
            f"no {split} slide has labels of its pose and its slide: there is nothing to probe for"
        )
    rows = rows[select_evenly(len(rows), most)]
    optional = (name for name in OPTIONAL_LABELS if name in stored)
    return reader.take(
        split, rows, tuple(dict.fromkeys((PINS.sheared, inputs, *LABELS, *optional)))
    )


def estimate_slides(splits: Mapping[str, ProbeSplit]) -> list[Json]:
    """Estimate test slides from both codes; return errors by quantity and `split_by_slip`.

    A small network learns mean and deviation of each quantity from the codes of training slides.
    Its deviations are then scaled until the intervals contain 95 % of the validation slides (split
    conformal: no distribution is assumed). Once all the skin that touches slips, the camera does
    not show how far the sensor went: the commanded slide and the shear of the skin differ.
    """
    train, validation, test = splits["train"], splits["validation"], splits["test"]
    codes = np.concatenate([validation.join_codes(), test.join_codes()])
    task = prepare_task(train.join_codes(), train.stack_slides(), codes, train.poses)
    mean, deviation = fit_gaussian(task)
    count, true = len(validation.poses), test.stack_slides()
    scores = np.abs(mean[:count] - validation.stack_slides()) / deviation[:count]
    scale = np.quantile(scores, min(1.0, LEVEL * (1 + 1 / count)), axis=0)
    error, half_width = mean[count:] - true, scale * deviation[count:]
    parts = {"all": np.ones(len(true), bool), **split_by_slip(test.batch)}
    rows = []
    for column, name in enumerate(test.list_slides()):
        for part, inside in parts.items():
            if inside.any():
                row = {"name": name, "part": part, "slides": int(inside.sum())}
                errors = error[inside, column], half_width[inside, column]
                rows.append(row | _score_intervals(*errors, test.poses[inside]))
    return rows


def _score_intervals(error: np.ndarray, half_width: np.ndarray, poses: np.ndarray) -> Json:
    covered = (np.abs(error) <= half_width).astype(np.float64)
    scores = {"mae": np.abs(error), "square": error**2, "coverage": covered}
    means = resample_means(scores, poses, SEED)
    return {
        "mae": float(np.abs(error).mean()),
        "mae interval": compute_interval(means["mae"]),
        "rmse": float(np.sqrt(np.mean(error**2))),
        "rmse interval": compute_interval(np.sqrt(means["square"])),
        "coverage": float(covered.mean()),
        "coverage interval": compute_interval(means["coverage"]),
        "half_width": float(half_width.mean()),
    }
