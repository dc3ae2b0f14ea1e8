"""From one number an image to the tables: pure functions of arrays, so they are tested without networks or data."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from jaxunshear.evaluation.bootstrap import (
    INTERVALS_OVER,
    LEVEL,
    RESAMPLES,
    compute_interval,
    compute_intervals,
    resample_means,
)
from jaxunshear.evaluation.score import CELL_METRICS, CELLS, KINDS, POSE_KINDS, get_cell_target
from jaxunshear.results.run import (
    CodeSwapScore,
    PartPoses,
    Parts,
    Poses,
    PoseSpread,
    Span,
    Spread,
    Tables,
)

Figure = TypeVar("Figure")
PARTS = 3  # equal parts of the range of a size
QUANTILES = (0.1, 0.5, 0.9)  # of the score of the contacts that are shown
CONTACT_FIELDS = ("residual_mm", "iterations", "stuck", "slipping", "free")


def build_tables(
    scores: dict[str, np.ndarray],
    names: Sequence[str],
    stimulus: np.ndarray,
    poses: np.ndarray,
    seed: int,
    separate_scores: tuple[dict[str, np.ndarray], dict[str, np.ndarray]] = ({}, {}),
) -> Tables:
    """The tables `ms_ssim`, `pose_mae`, `pose_ratio`, `pose_recovery`, `difference`, `swap` and their `spread` (95 % intervals).
    Poses of each stimulus alone stand under `pose_by_stimulus`.

    `scores`: arrays (N,) by the names of `score.py`, of whichever networks there are; `names` of the stimuli, indexed by
    `stimulus` (N,); `poses` (N,) as `numbered_poses`. A stimulus without test contacts is null. Ratio: error over that on sheared images.
    Recovery: the part of the slide's damage undone, (sheared - unsheared) / (sheared - tap); null where the slide does no damage.
    Difference: disentangled less another network, contact by contact. `separate_scores`: scores of other contacts (M,) that join the tables of poses,
    with their redrawn means.
    """
    groups = {name: stimulus == index for index, name in enumerate(names)} | {
        "overall": np.ones(len(stimulus), bool)
    }
    redrawn = {
        group: resample_means(
            {name: score[inside] for name, score in scores.items()}, poses[inside], seed
        )
        for group, inside in groups.items()
        if inside.any()
    }
    overall = redrawn["overall"]
    similar = [kind for kind in KINDS if f"ms_ssim/{kind}" in scores]
    pose, pose_spread = _poses(scores | separate_scores[0], overall | separate_scores[1])
    differences = {
        name.removeprefix("difference/"): name for name in scores if name.startswith("difference/")
    }
    return Tables(
        ms_ssim={
            kind: {
                group: _mean(scores[f"ms_ssim/{kind}"][inside]) for group, inside in groups.items()
            }
            for kind in similar
        },
        **vars(pose),
        pose_by_stimulus={
            name: _tabulate_poses(scores, groups[name], redrawn[name]) if name in redrawn else None
            for name in names
        },
        difference=_by_kind({place: _mean(scores[name]) for place, name in differences.items()}),
        swap={
            cell: CodeSwapScore(
                target=get_cell_target(cell),
                **{m: _mean(scores[f"swap/{cell}/{m}"]) for m in CELL_METRICS},
            )
            for cell in CELLS
            if f"swap/{cell}/mse" in scores
        },
        spread=Spread(
            what=f"{LEVEL:.0%} bootstrap interval of the mean over test poses, each with all its slides",
            over=INTERVALS_OVER,
            resamples=RESAMPLES,
            seed=seed,
            ms_ssim={
                kind: {
                    group: compute_interval(redrawn[group][f"ms_ssim/{kind}"])
                    if group in redrawn
                    else None
                    for group in groups
                }
                for kind in similar
            },
            **vars(pose_spread),
            difference=_by_kind(
                {place: compute_interval(overall[name]) for place, name in differences.items()}
            ),
        ),
    )


def tabulate_by_size(
    scores: dict[str, np.ndarray],
    size: np.ndarray,
    least: float,
    most: float,
    poses: np.ndarray,
    seed: int,
) -> Parts:
    """What `build_tables` says of poses, by a size (N,) of the slides, mm, in PARTS equal parts of its range: their indentation depth, as a
    shallow touch shows little of a pose even as a tap, or their length. A part without test contacts is null; a range of zero has no
    parts, nor has a test without poses."""
    felt = {name: score for name, score in scores.items() if name.startswith("pose/")}
    if least == most or not felt:
        return {}
    bounds = np.linspace(least, most, PARTS + 1)
    part = np.digitize(size, bounds[1:-1])
    digits = max(
        1, 1 - math.floor(math.log10(bounds[1] - bounds[0]))
    )  # as many as distinguish the parts
    found: dict[str, PartPoses | None] = {}
    for index, (low, high) in enumerate(itertools.pairwise(bounds)):
        found[f"{low:.{digits}f}-{high:.{digits}f} mm"] = tabulate_part(
            felt, part == index, poses, seed
        )
    return found


def tabulate_part(
    scores: dict[str, np.ndarray], inside: np.ndarray, poses: np.ndarray, seed: int
) -> PartPoses | None:
    """Give what `build_tables` says of poses, of the contacts `inside` (N,) alone; None if there is none."""
    if not inside.any():
        return None
    again = resample_means(
        {name: score[inside] for name, score in scores.items()}, poses[inside], seed
    )
    return _tabulate_poses(scores, inside, again)


def add_estimators(
    found: Tables, read: Sequence[tuple[Mapping[str, np.ndarray], np.ndarray]], seed: int
) -> Tables:
    """`build_tables` with what other readers than PoseNet err by: `readers`, by reader, kind and quantity; their intervals under `spread`; and
    of how many images they are, `reader_images`.

    `read`: scores (N,) by `read/<reader>/<kind>/<quantity>`, NaN of images that were not read, beside others; and their poses (N,).
    """
    means: dict[str, dict[str, dict[str, float | None]]] = {}
    spans: dict[str, dict[str, dict[str, Span]]] = {}
    counts: dict[str, dict[str, dict[str, int]]] = {}
    for scores, poses in read:
        for place in (place for place in scores if place.startswith("read/")):
            _, reader, kind, quantity = place.split("/")
            finite = np.isfinite(scores[place])
            values = {quantity: scores[place][finite]}
            span = (
                compute_intervals(values, poses[finite], seed)[quantity] if finite.any() else None
            )
            means.setdefault(reader, {}).setdefault(kind, {})[quantity] = _mean(values[quantity])
            spans.setdefault(reader, {}).setdefault(kind, {})[quantity] = span
            counted = {"read": int(finite.sum()), "left_out": int((~finite).sum())}
            counts.setdefault(reader, {})[kind] = counted
    return replace(
        found, readers=means, reader_images=counts, spread=replace(found.spread, readers=spans)
    )


def _tabulate_poses(
    scores: dict[str, np.ndarray], inside: np.ndarray, redrawn: dict[str, np.ndarray]
) -> PartPoses:
    """What `build_tables` says of poses, of the contacts `inside` (N,) alone."""
    found, spread = _poses({name: score[inside] for name, score in scores.items()}, redrawn)
    return PartPoses(**vars(found), spread=spread)


def _poses(
    scores: dict[str, np.ndarray], redrawn: dict[str, np.ndarray]
) -> tuple[Poses, PoseSpread]:
    """Errors, their ratios and recoveries, and the intervals of errors and recoveries."""
    names = {
        kind: [n.rpartition("/")[2] for n in scores if n.startswith(f"pose/{kind}/")]
        for kind in POSE_KINDS
    }
    felt = [kind for kind in POSE_KINDS if names[kind]]
    kinds_unsheared = (
        [kind for kind in felt if kind not in ("tap", "sheared")] if "sheared" in felt else []
    )
    error = {kind: {q: _mean(scores[f"pose/{kind}/{q}"]) for q in names[kind]} for kind in felt}
    redone = {kind: {q: redrawn[f"pose/{kind}/{q}"] for q in names[kind]} for kind in felt}
    found = Poses(
        pose_mae=error,
        pose_ratio={
            kind: {q: _ratio(error[kind][q], error["sheared"][q]) for q in names[kind]}
            for kind in kinds_unsheared
        },
        pose_recovery={
            kind: {
                q: _recovery(error["sheared"][q], error[kind][q], error["tap"][q])
                for q in names[kind]
            }
            for kind in kinds_unsheared
            if "tap" in felt
        },
    )
    return found, PoseSpread(
        pose_mae={
            kind: {q: compute_interval(redone[kind][q]) for q in names[kind]} for kind in felt
        },
        pose_recovery={
            kind: {
                q: _compute_recovery_interval(
                    redone["sheared"][q], redone[kind][q], redone["tap"][q]
                )
                for q in names[kind]
            }
            for kind in kinds_unsheared
            if "tap" in felt
        },
    )


def summarise_contact_quality(fields: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
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


def select_typical(scores: np.ndarray, stimulus: np.ndarray) -> np.ndarray:
    """Indices of contacts to show: for each stimulus those at QUANTILES of the score, worst first, none twice."""
    chosen: list[int] = []
    for index in np.unique(stimulus):
        inside = np.flatnonzero(stimulus == index)
        ranked = inside[np.argsort(scores[inside], kind="stable")]
        chosen += dict.fromkeys(int(ranked[round(q * (len(ranked) - 1))]) for q in QUANTILES)
    return np.array(chosen, np.int64)


def _mean(values: np.ndarray) -> float | None:
    return float(np.mean(values, dtype=np.float64)) if len(values) else None


def _ratio(error: float | None, sheared: float | None) -> float | None:
    return error / sheared if error is not None and sheared else None


def _recovery(sheared: float | None, unsheared: float | None, tap: float | None) -> float | None:
    if sheared is None or unsheared is None or tap is None or sheared <= tap:
        return None
    return (sheared - unsheared) / (sheared - tap)


def _compute_recovery_interval(
    sheared: np.ndarray, unsheared: np.ndarray, tap: np.ndarray
) -> list[float] | None:
    """Interval of the recovery; null where in some draw the slide does no damage, as the figure then has no bounds."""
    return (
        None
        if np.any(sheared <= tap)
        else compute_interval((sheared - unsheared) / (sheared - tap))
    )


def _by_kind(figures: Mapping[str, Figure]) -> dict[str, dict[str, Figure]]:
    """{"<kind>/<column>": ...} as {kind: {column: ...}}."""
    found: dict[str, dict[str, Figure]] = {}
    for place, figure in figures.items():
        kind, column = place.split("/")
        found.setdefault(kind, {})[column] = figure
    return found
