"""One pass over the test contacts: scores of all, images of a few. Memory stays that of one batch and of those few."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from jaxunshear.config.targets import Targets, read_true_values
from jaxunshear.evaluation.score import BASELINES, Outputs, compute_differences, score_poses
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
PINS = ("canonical_pins", "sheared_pins")
IMAGES = ("canonical", "sheared")
FIELDS = (*IMAGES, *PINS, *LABELS)  # what a batch must hold


class CollectedScores(NamedTuple):
    """N test contacts in the order of the data, of which K have their images kept."""

    scores: dict[str, np.ndarray]  # (N,) by the names of score.py
    labels: dict[str, np.ndarray]  # (N, ...) by LABELS
    kept_rows: np.ndarray  # (K,) indices of contacts
    images: dict[str, np.ndarray]  # (K, S, S) uint8 by kind, without the baselines
    pins: dict[str, np.ndarray]  # (K, P, 2) px by PINS
    # (K,) errors of a reader of found pins, see `pose_estimators.score_detected_pins`
    estimates: Mapping[str, np.ndarray] = MappingProxyType({})


def collect_scores(
    run: Callable[[np.ndarray, np.ndarray], tuple[Outputs, Mapping]],
    batches: Iterable[Mapping[str, np.ndarray]],
    total: int,
    keep: int,
    targets: Targets,
    title: str = "evaluate",
    inputs: Sequence[str] = IMAGES,
    named: Sequence[str] = LABELS,
    readers: Mapping[str, Callable[[Outputs], Mapping]] = MappingProxyType({}),
) -> CollectedScores:
    """Feeds (tap, sheared) of every batch to `run` and collects what it scores, poses by `targets`; keeps `keep` contacts, evenly spaced.
    `inputs`: the fields that are tap and sheared, and what else `run` takes; `named`: those that are kept as labels;
    `readers`: by name, poses by kind of what `run` puts out, scored beside its own.

    Shorter batches are filled up to BATCH by repeating their first contact, so `run` compiles once for all that it is fed; the surplus
    is dropped.
    """
    kept = select_evenly(total, keep)
    scores: list[dict[str, np.ndarray]] = []
    labels: list[dict[str, np.ndarray]] = []
    images: list[dict[str, np.ndarray]] = []
    pins: list[dict[str, np.ndarray]] = []
    start = 0
    with Progress(title, total) as progress:
        for batch in batches:
            size = len(batch[inputs[1]])
            outputs, similar = run(*(_pad_batch(batch[name], max(BATCH, size)) for name in inputs))
            poses = {
                k: {q: np.asarray(v)[:size] for q, v in pose.items()}
                for k, pose in outputs.poses.items()
            }
            scores.append({name: np.asarray(value)[:size] for name, value in similar.items()})
            true = read_true_values(targets, batch)
            scores[-1] |= score_poses(poses, true)
            for name, read in readers.items():
                reported = {
                    k: {q: v[:size] for q, v in pose.items()} for k, pose in read(outputs).items()
                }
                scores[-1] |= score_poses(reported, true, f"read/{name}")
            labels.append({name: np.asarray(batch[name]) for name in named})
            inside = kept[(kept >= start) & (kept < start + size)] - start
            images.append(
                {
                    k: to_uint8(np.asarray(x)[inside, ..., 0])
                    for k, x in outputs.images.items()
                    if k not in BASELINES
                }
            )
            pins.append({name: np.asarray(batch[name])[inside] for name in PINS})
            start += size
            progress.advance(size)
    every = _concatenate(scores)
    return CollectedScores(
        every | compute_differences(every),
        _concatenate(labels),
        kept[kept < start],
        _concatenate(images),
        _concatenate(pins),
    )


def _pad_batch(images: np.ndarray, size: int) -> np.ndarray:
    missing = size - len(images)
    return np.concatenate([images, np.repeat(images[:1], missing, axis=0)]) if missing else images


def _concatenate(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
