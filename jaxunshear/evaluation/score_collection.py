"""Score all test contacts in one pass, and keep the images of a few.

Memory stays that of one batch and of the contacts whose images are kept.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jax import Array

from jaxunshear.config.targets import Targets, read_true_values
from jaxunshear.evaluation.score import BASELINES, Outputs, compute_differences, score_poses
from jaxunshear.models.modality import IMAGES, PINS
from jaxunshear.perception.png import to_uint8
from jaxunshear.progress import Progress
from jaxunshear.selection import select_evenly

BATCH = 32  # contacts that are scored at once
LABELS = (
    "stimulus",
    "pose_id",
    "pose",
    "edge",
    "move",
    "residual_mm",
    "iterations",
    "stuck",
    "slipping",
    "free",
)
FIELDS = (*IMAGES.pair, *PINS.pair, *LABELS)  # what a batch must hold

PosesByKind = Mapping[str, Mapping[str, np.ndarray | Array]]  # (B,) by kind and target


class Scorer(NamedTuple):
    """Networks and further pose estimators that score batches of test contacts."""

    run: Callable[..., tuple[Outputs, Mapping[str, Array]]]  # networks -> outputs, image scores
    targets: Targets  # of the poses that are scored
    inputs: Sequence[str] = IMAGES.pair  # fields that `run` takes: tap, sheared, and what else
    labels: Sequence[str] = LABELS  # fields that are collected as labels
    # pose estimators that are no networks, by name
    estimators: Mapping[str, Callable[[Outputs], PosesByKind]] = MappingProxyType({})

    def score_batch(self, batch: Mapping[str, np.ndarray]) -> tuple[Outputs, dict[str, np.ndarray]]:
        """Compute outputs, which may be padded, and scores (B,) of a batch.

        A shorter batch is padded to BATCH contacts by its first one, so that `run` compiles once.
        """
        size = len(batch[self.inputs[1]])
        inputs = [_pad_batch(batch[name], max(BATCH, size)) for name in self.inputs]
        outputs, image_scores = self.run(*inputs)
        scores = {name: np.asarray(score)[:size] for name, score in image_scores.items()}
        true = read_true_values(self.targets, batch)
        scores |= score_poses(_cut_poses(outputs.poses, size), true)
        for name, estimate in self.estimators.items():
            scores |= score_poses(_cut_poses(estimate(outputs), size), true, f"read/{name}")
        return outputs, scores


class CollectedScores(NamedTuple):
    """Scores of N test contacts in the order of the data, and images of K of them."""

    scores: dict[str, np.ndarray]  # (N,) by the names of score.py
    labels: dict[str, np.ndarray]  # (N, ...) by LABELS
    kept_rows: np.ndarray  # (K,) indices of the contacts with images
    images: dict[str, np.ndarray]  # (K, S, S) uint8 by kind, without the baselines
    pins: dict[str, np.ndarray]  # (K, P, 2) px by PINS.pair
    # (K,) errors of an estimator over detected pins, see `pose_estimators.score_detected_pins`
    estimates: Mapping[str, np.ndarray] = MappingProxyType({})


def collect_scores(
    scorer: Scorer,
    batches: Iterable[Mapping[str, np.ndarray]],
    total: int,
    keep: int = 0,
    title: str = "evaluate",
) -> CollectedScores:
    """Score `total` contacts in batches, and keep the images of `keep` of them, evenly spaced."""
    kept_rows = select_evenly(total, keep)
    scores: list[dict[str, np.ndarray]] = []
    labels: list[dict[str, np.ndarray]] = []
    images: list[dict[str, np.ndarray]] = []
    pins: list[dict[str, np.ndarray]] = []
    start = 0
    with Progress(title, total) as progress:
        for batch in batches:
            outputs, batch_scores = scorer.score_batch(batch)
            size = len(batch[scorer.inputs[1]])
            inside = kept_rows[(kept_rows >= start) & (kept_rows < start + size)] - start
            scores.append(batch_scores)
            labels.append({name: np.asarray(batch[name]) for name in scorer.labels})
            images.append(_select_images(outputs, inside))
            pins.append({name: np.asarray(batch[name])[inside] for name in PINS.pair})
            start += size
            progress.advance(size)
    all_scores = concatenate_batches(scores)
    return CollectedScores(
        all_scores | compute_differences(all_scores),
        concatenate_batches(labels),
        kept_rows[kept_rows < start],
        concatenate_batches(images),
        concatenate_batches(pins),
    )


def _pad_batch(values: np.ndarray, size: int) -> np.ndarray:
    missing = size - len(values)
    return np.concatenate([values, np.repeat(values[:1], missing, axis=0)]) if missing else values


def _cut_poses(poses: PosesByKind, size: int) -> dict[str, dict[str, np.ndarray]]:
    """Return the poses of the first `size` contacts of a padded batch."""
    cut: dict[str, dict[str, np.ndarray]] = {}
    for kind, pose in poses.items():
        cut[kind] = {name: np.asarray(values)[:size] for name, values in pose.items()}
    return cut


def _select_images(outputs: Outputs, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return images (K, S, S) uint8 of some contacts, by kind, without the baselines."""
    return {
        kind: to_uint8(np.asarray(image)[rows, ..., 0])
        for kind, image in outputs.images.items()
        if kind not in BASELINES
    }


def concatenate_batches(batches: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Concatenate the arrays of all batches, name by name."""
    arrays = {}
    for name in batches[0]:
        arrays[name] = np.concatenate([batch[name] for batch in batches])
    return arrays
