"""Score all contacts of a test in one pass, as labelled arrays, and keep the images of a few.

>>> contacts = score_test(Scorer(run, targets), TestSet(batches, count, IMAGES.pair))
>>> contacts.scores["pose/disentangled/edge_mm"]  # (N,) mm

Memory stays that of one batch and of the contacts whose images are kept.
"""

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jax import Array

from jaxunshear.config.targets import Targets, read_true_values
from jaxunshear.data.reader import Batch, concatenate_batches
from jaxunshear.evaluation.network_outputs import Run
from jaxunshear.evaluation.pose_estimators import RidgeEstimator, estimate_poses
from jaxunshear.evaluation.score import (
    BASELINES,
    TRUE_KIND,
    Outputs,
    compute_differences,
    score_poses,
)
from jaxunshear.models.modality import IMAGES, PINS
from jaxunshear.perception.drawing import to_uint8
from jaxunshear.progress import Progress
from jaxunshear.selection import number_poses, select_evenly

BATCH = 32  # contacts that are scored at once
QUALITY = ("residual_mm", "iterations", "stuck", "slipping", "free")  # of simulated contacts
LABELS = ("stimulus", "pose_id", "pose", "edge", "move", *QUALITY)
FIELDS = (*IMAGES.pair, *PINS.pair, *LABELS)  # of a batch of simulated contacts


class TestSet(NamedTuple):
    """Contacts that networks are scored on."""

    batches: Iterable[Batch]  # with pins, inputs and labels
    total: int
    inputs: Sequence[str]  # fields that networks take: tap, sheared, and perhaps a detected tap
    labels: Sequence[str] = LABELS  # fields that are kept of all contacts
    keep: int = 0  # contacts, evenly spaced, whose images are kept
    title: str = "evaluate"


class ContactScores(NamedTuple):
    """Scores of N contacts of a test in the order of the data, and images of K of them."""

    scores: dict[str, np.ndarray]  # (N,) by the names of `score`
    labels: dict[str, np.ndarray]  # (N, ...) by field
    kept_rows: np.ndarray  # (K,) indices of the contacts with images
    images: dict[str, np.ndarray]  # (K, S, S) uint8 by kind, without the baselines
    pins: dict[str, np.ndarray]  # (K, P, 2) px by PINS.pair
    # (K,) errors of an estimator over detected pins, see `pose_estimators.score_detected_pins`
    estimates: Mapping[str, np.ndarray] = MappingProxyType({})

    @property
    def total(self) -> int:
        return len(self.labels["stimulus"])

    @property
    def poses(self) -> np.ndarray:
        """Which pose (N,) each contact belongs to: slides to one pose are drawn together."""
        return number_poses(self.labels["stimulus"], self.labels["pose_id"])


class Scorer(NamedTuple):
    """Networks, and pose estimators by name, that score batches of contacts."""

    run: Run
    targets: Targets  # of the poses that are scored
    estimators: Mapping[str, RidgeEstimator] = MappingProxyType({})

    def score_batch(
        self, batch: Batch, inputs: Sequence[str]
    ) -> tuple[Outputs, dict[str, np.ndarray]]:
        """Compute outputs, which may be padded, and scores (B,) of a batch.

        A shorter batch is padded to BATCH contacts by its first one, so that `run` compiles once.
        """
        size = len(batch[inputs[1]])
        padded = []
        for name in inputs:
            values = batch[name]
            padded.append(np.concatenate([values, np.repeat(values[:1], max(BATCH - size, 0), 0)]))
        outputs, image_scores = self.run(*padded)
        scores = {name: np.asarray(score)[:size] for name, score in image_scores.items()}
        true = read_true_values(self.targets, batch)
        scores |= score_poses(_cut_poses(outputs.poses, size), true)
        for name, estimator in self.estimators.items():
            poses = _cut_poses(estimate_poses(name, estimator, outputs), size)
            scores |= score_poses(poses, true, f"read/{name}")
        return outputs, scores

    def label_poses(self, batch: Batch, outputs: Outputs) -> dict[str, np.ndarray]:
        """Return the true and the predicted values (B,) as labels `pose.<kind>.<quantity>`."""
        if not outputs.poses:
            return {}
        poses = {TRUE_KIND: read_true_values(self.targets, batch)}
        poses |= _cut_poses(outputs.poses, len(batch["stimulus"]))
        return {
            f"pose.{kind}.{name}": np.asarray(values)
            for kind, pose in poses.items()
            if kind not in BASELINES
            for name, values in pose.items()
        }


def score_test(scorer: Scorer, test: TestSet) -> ContactScores:
    """Score all contacts of a test."""
    kept_rows = select_evenly(test.total, test.keep)
    parts: dict[str, list[dict[str, np.ndarray]]] = {}
    start = 0
    with Progress(test.title, test.total) as progress:
        for batch in test.batches:
            outputs, scores = scorer.score_batch(batch, test.inputs)
            size = len(batch[test.inputs[1]])
            inside = kept_rows[(kept_rows >= start) & (kept_rows < start + size)] - start
            arrays = {
                "scores": scores,
                "labels": {name: np.asarray(batch[name]) for name in test.labels}
                | scorer.label_poses(batch, outputs),
                "images": {
                    kind: to_uint8(np.asarray(image)[inside, ..., 0])
                    for kind, image in outputs.images.items()
                    if kind not in BASELINES
                },
                "pins": {name: np.asarray(batch[name])[inside] for name in PINS.pair},
            }
            for name, part in arrays.items():
                parts.setdefault(name, []).append(part)
            start += size
            progress.advance(size)
    joined = {name: concatenate_batches(batches) for name, batches in parts.items()}
    joined["scores"] |= compute_differences(joined["scores"])
    return ContactScores(kept_rows=kept_rows[kept_rows < start], **joined)


def _cut_poses(
    poses: Mapping[str, Mapping[str, np.ndarray | Array]], size: int
) -> dict[str, dict[str, np.ndarray]]:
    cut: dict[str, dict[str, np.ndarray]] = {}
    for kind, pose in poses.items():
        cut[kind] = {name: np.asarray(values)[:size] for name, values in pose.items()}
    return cut
