"""From one number an image to the tables: pure functions of arrays, so they are tested without networks or data."""

from collections.abc import Sequence

import numpy as np

from jaxunshear.evaluation.score import CELL_METRICS, CELLS, KINDS, UNSHEARED
from jaxunshear.evaluation.spread import LEVEL, RESAMPLES, intervals
from jaxunshear.metrics import QUANTITIES

CONTACT_FIELDS = ("residual_mm", "iterations", "stuck", "slipping", "free")


def tables(
    scores: dict[str, np.ndarray], names: Sequence[str], stimulus: np.ndarray, pose_id: np.ndarray, seed: int
) -> dict[str, dict]:
    """The tables `ms_ssim`, `pose_mae`, `pose_ratio`, `pose_recovery`, `swap` and their `spread` (95 % intervals).

    `scores`: arrays (N,) by the names of `score.py`; `names` of the stimuli, indexed by `stimulus` (N,); `pose_id`
    (N,). A stimulus without test contacts is null. Ratio: error over that on sheared images. Recovery: the part of the
    slide's damage undone, (sheared - unsheared) / (sheared - tap); null where the slide does no damage.
    """
    groups = {name: stimulus == index for index, name in enumerate(names)} | {"overall": np.ones(len(stimulus), bool)}
    poses = np.unique(np.stack([stimulus, pose_id], axis=1), axis=0, return_inverse=True)[1].reshape(-1)
    bands: dict[str, dict[str, list[float]]] = {
        group: intervals({name: score[inside] for name, score in scores.items()}, poses[inside], seed)
        for group, inside in groups.items()
        if inside.any()
    }
    similarity = {
        kind: {group: _mean(scores[f"ms_ssim/{kind}"][inside]) for group, inside in groups.items()}
        for kind in KINDS
        if kind != "tap"
    }
    pose = {kind: {name: _mean(scores[f"pose/{kind}/{name}"]) for name in QUANTITIES} for kind in KINDS}
    return {
        "ms_ssim": similarity,
        "pose_mae": pose,
        "pose_ratio": {kind: {q: _ratio(pose[kind][q], pose["sheared"][q]) for q in QUANTITIES} for kind in UNSHEARED},
        "pose_recovery": {
            kind: {q: _recovery(pose["sheared"][q], pose[kind][q], pose["tap"][q]) for q in QUANTITIES}
            for kind in UNSHEARED
        },
        "swap": {
            cell: {"target": target} | {m: _mean(scores[f"swap/{cell}/{m}"]) for m in CELL_METRICS}
            for cell, target in CELLS.items()
            if f"swap/{cell}/mse" in scores
        },
        "spread": {
            "what": f"{LEVEL:.0%} bootstrap interval of the mean over test poses, each with all its slides",
            "resamples": RESAMPLES,
            "seed": seed,
            "ms_ssim": {
                kind: {group: bands[group][f"ms_ssim/{kind}"] if group in bands else None for group in groups}
                for kind in similarity
            },
            "pose_mae": {kind: {q: bands["overall"][f"pose/{kind}/{q}"] for q in QUANTITIES} for kind in KINDS},
        },
    }


def contact_quality(fields: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """Mean, median, 95th percentile and largest of what the simulator says of its contacts, each field (N,)."""
    return {
        name: {
            "mean": float(np.mean(values, dtype=np.float64)),
            "median": float(np.median(values)),
            "p95": float(np.quantile(values, 0.95)),
            "max": float(np.max(values)),
        }
        for name, values in fields.items()
    }


def typical(scores: np.ndarray, stimulus: np.ndarray, quantiles: Sequence[float] = (0.1, 0.5, 0.9)) -> np.ndarray:
    """Indices of contacts to show: for each stimulus those at these quantiles of the score, worst first, none twice."""
    chosen: list[int] = []
    for index in np.unique(stimulus):
        inside = np.flatnonzero(stimulus == index)
        ranked = inside[np.argsort(scores[inside], kind="stable")]
        chosen += dict.fromkeys(int(ranked[round(q * (len(ranked) - 1))]) for q in quantiles)
    return np.array(chosen, np.int64)


def _mean(values: np.ndarray) -> float | None:
    return float(np.mean(values, dtype=np.float64)) if len(values) else None


def _ratio(error: float | None, sheared: float | None) -> float | None:
    return error / sheared if error is not None and sheared else None


def _recovery(sheared: float | None, unsheared: float | None, tap: float | None) -> float | None:
    if sheared is None or unsheared is None or tap is None or sheared <= tap:
        return None
    return (sheared - unsheared) / (sheared - tap)
