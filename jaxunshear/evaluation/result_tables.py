"""Build the tables of results from one number per contact, by pure functions of arrays."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np

from jaxunshear.evaluation.bootstrap import (
    INTERVALS_OVER,
    LEVEL,
    RESAMPLES,
    compute_interval,
    resample_means,
)
from jaxunshear.evaluation.score import (
    CELL_METRICS,
    CELLS,
    get_cell_target,
    list_kinds,
    list_pose_kinds,
)
from jaxunshear.results.run import (
    CodeSwapScore,
    PartPoses,
    Parts,
    PoseSpread,
    Span,
    Spread,
    Tables,
)

Figure = TypeVar("Figure")
OVERALL = "overall"
PARTS = 3  # equal parts of the range of a size
QUANTILES = (0.1, 0.5, 0.9)  # of the score of the contacts that are shown
CONTACT_FIELDS = ("residual_mm", "iterations", "stuck", "slipping", "free")


class Resampled(NamedTuple):
    """Scores (N,) of some contacts by the names of `score.py`, with their resampled means."""

    scores: Mapping[str, np.ndarray]
    means: Mapping[str, np.ndarray]  # (RESAMPLES,)

    def compute_mean(self, name: str) -> float | None:
        values = self.scores[name]
        return float(np.mean(values, dtype=np.float64)) if len(values) else None

    def compute_interval(self, name: str) -> list[float]:
        return compute_interval(self.means[name])


def resample_part(
    scores: Mapping[str, np.ndarray], inside: np.ndarray, poses: np.ndarray, seed: int
) -> Resampled | None:
    """Resample the scores of the contacts `inside` (N,) alone; None if there is none."""
    if not inside.any():
        return None
    selected = {name: score[inside] for name, score in scores.items()}
    return Resampled(selected, resample_means(selected, poses[inside], seed))


def build_tables(
    scores: dict[str, np.ndarray],
    names: Sequence[str],
    stimulus: np.ndarray,
    poses: np.ndarray,
    seed: int,
    separate: Resampled | None = None,
) -> Tables:
    """Build the tables of a test, with their 95 % intervals under `spread`.

    A stimulus without test contacts is None. `pose_ratio` is the error over that on sheared images;
    `pose_recovery` is the part of the slide's damage undone, (sheared - unsheared) / (sheared -
    tap), None if the slide does no damage; `difference` is disentangled less another network,
    contact by contact.

    Args:
        scores: (N,) by the names of `score.py`, of whichever networks there are.
        names: Stimuli, indexed by `stimulus` (N,).
        poses: (N,) poses of the contacts, as `number_poses` numbers them.
        separate: Scores of other contacts that join the tables of poses.
    """
    parts = {
        name: resample_part(scores, stimulus == index, poses, seed)
        for index, name in enumerate(names)
    }
    overall = Resampled(scores, resample_means(scores, poses, seed))
    tested_poses = overall
    if separate is not None:
        tested_poses = Resampled({**scores, **separate.scores}, {**overall.means, **separate.means})
    pose_table = _tabulate_poses(tested_poses)
    groups = {**parts, OVERALL: overall}
    return Tables(
        ms_ssim=_tabulate_similarity(groups, Resampled.compute_mean),
        pose_mae=pose_table.pose_mae,
        pose_ratio=pose_table.pose_ratio,
        pose_recovery=pose_table.pose_recovery,
        pose_by_stimulus={
            name: None if part is None else _tabulate_poses(part) for name, part in parts.items()
        },
        difference=_tabulate_differences(overall, Resampled.compute_mean),
        swap=_tabulate_swaps(overall),
        spread=Spread(
            what=f"{LEVEL:.0%} bootstrap interval of the mean over test poses, "
            "each with all its slides",
            over=INTERVALS_OVER,
            resamples=RESAMPLES,
            seed=seed,
            ms_ssim=_tabulate_similarity(groups, Resampled.compute_interval),
            pose_mae=pose_table.spread.pose_mae,
            pose_recovery=pose_table.spread.pose_recovery,
            difference=_tabulate_differences(overall, Resampled.compute_interval),
        ),
    )


def _tabulate_similarity(
    groups: Mapping[str, Resampled | None], compute: Callable[[Resampled, str], Figure]
) -> dict[str, dict[str, Figure | None]]:
    """Tabulate a figure of the MS-SSIM by kind and group of contacts."""
    overall = groups[OVERALL]
    assert overall is not None
    table: dict[str, dict[str, Figure | None]] = {}
    for kind in list_kinds():
        name = f"ms_ssim/{kind}"
        if name in overall.scores:
            table[kind] = {
                group: None if part is None else compute(part, name)
                for group, part in groups.items()
            }
    return table


def _tabulate_differences(
    overall: Resampled, compute: Callable[[Resampled, str], Figure]
) -> dict[str, dict[str, Figure]]:
    """Tabulate a figure of `difference/<kind>/<quantity>` by kind and quantity."""
    table: dict[str, dict[str, Figure]] = {}
    for name in overall.scores:
        if name.startswith("difference/"):
            _, kind, quantity = name.split("/")
            table.setdefault(kind, {})[quantity] = compute(overall, name)
    return table


def _tabulate_swaps(overall: Resampled) -> dict[str, CodeSwapScore]:
    table = {}
    for cell in CELLS:
        if f"swap/{cell}/mse" in overall.scores:
            means = {name: overall.compute_mean(f"swap/{cell}/{name}") for name in CELL_METRICS}
            table[cell] = CodeSwapScore(target=get_cell_target(cell), **means)
    return table


def tabulate_by_size(
    scores: dict[str, np.ndarray],
    size: np.ndarray,
    least: float,
    most: float,
    poses: np.ndarray,
    seed: int,
) -> Parts:
    """Tabulate poses by a size (N,) of the slides, mm, in PARTS equal parts of its range.

    The size is an indentation depth, as a shallow touch shows little of a pose even as a tap, or a
    length. A part without test contacts is None; a range of zero has no parts, nor has a test
    without poses.
    """
    pose_scores = {name: score for name, score in scores.items() if name.startswith("pose/")}
    if least == most or not pose_scores:
        return {}
    bounds = np.linspace(least, most, PARTS + 1)
    part = np.digitize(size, bounds[1:-1])
    # as many digits as distinguish the parts
    digits = max(1, 1 - math.floor(math.log10(bounds[1] - bounds[0])))
    table: dict[str, PartPoses | None] = {}
    for index, (low, high) in enumerate(itertools.pairwise(bounds)):
        name = f"{low:.{digits}f}-{high:.{digits}f} mm"
        table[name] = tabulate_part(pose_scores, part == index, poses, seed)
    return table


def tabulate_part(
    scores: dict[str, np.ndarray], inside: np.ndarray, poses: np.ndarray, seed: int
) -> PartPoses | None:
    """Tabulate poses over the contacts `inside` (N,) alone; None if there is none."""
    part = resample_part(scores, inside, poses, seed)
    return None if part is None else _tabulate_poses(part)


def add_estimators(
    tables: Tables, scored: Sequence[tuple[Mapping[str, np.ndarray], np.ndarray]], seed: int
) -> Tables:
    """Add the errors of pose estimators other than PoseNet, with their intervals.

    `readers` are the errors by estimator, kind and quantity, and `reader_images` the number of
    images that they come from.

    Args:
        tables: The tables of `build_tables`.
        scored: Scores (N,) by `read/<estimator>/<kind>/<quantity>`, among others, NaN for images
            without an estimate; and the poses (N,) of these contacts.
        seed: Seed of the bootstrap.
    """
    means: dict[str, dict[str, dict[str, float | None]]] = {}
    spans: dict[str, dict[str, dict[str, Span]]] = {}
    counts: dict[str, dict[str, dict[str, int]]] = {}
    for scores, poses in scored:
        for name, score in scores.items():
            if not name.startswith("read/"):
                continue
            _, estimator, kind, quantity = name.split("/")
            finite = np.isfinite(score)
            part = resample_part({name: score}, finite, poses, seed)
            mean = None if part is None else part.compute_mean(name)
            span = None if part is None else part.compute_interval(name)
            means.setdefault(estimator, {}).setdefault(kind, {})[quantity] = mean
            spans.setdefault(estimator, {}).setdefault(kind, {})[quantity] = span
            counts.setdefault(estimator, {})[kind] = {
                "read": int(finite.sum()),
                "left_out": int((~finite).sum()),
            }
    return replace(
        tables, readers=means, reader_images=counts, spread=replace(tables.spread, readers=spans)
    )


class _PoseErrors(NamedTuple):
    """Errors of one kind of contact by quantity: their mean, and resampled means (RESAMPLES,)."""

    mean: dict[str, float | None]
    resampled: dict[str, np.ndarray]


def _tabulate_poses(part: Resampled) -> PartPoses:
    """Tabulate pose errors, their ratios and recoveries, with intervals."""
    errors = _group_pose_errors(part)
    ratios: dict[str, dict[str, float | None]] = {}
    recoveries: dict[str, dict[str, float | None]] = {}
    recovery_spans: dict[str, dict[str, Span]] = {}
    tap, sheared = errors.get("tap"), errors.get("sheared")
    for kind, unsheared in errors.items():
        if sheared is None or kind in ("tap", "sheared"):
            continue
        ratios[kind] = {
            name: _compute_ratio(error, sheared.mean[name])
            for name, error in unsheared.mean.items()
        }
        if tap is None:
            continue
        recoveries[kind] = {
            name: _compute_recovery(sheared.mean[name], error, tap.mean[name])
            for name, error in unsheared.mean.items()
        }
        recovery_spans[kind] = {
            name: _compute_recovery_interval(sheared.resampled[name], means, tap.resampled[name])
            for name, means in unsheared.resampled.items()
        }
    return PartPoses(
        pose_mae={kind: error.mean for kind, error in errors.items()},
        pose_ratio=ratios,
        pose_recovery=recoveries,
        spread=PoseSpread(
            pose_mae={kind: _compute_spans(error.resampled) for kind, error in errors.items()},
            pose_recovery=recovery_spans,
        ),
    )


def _group_pose_errors(part: Resampled) -> dict[str, _PoseErrors]:
    """Group pose errors by kind."""
    errors = {}
    for kind in list_pose_kinds():
        prefix = f"pose/{kind}/"
        names = {name.removeprefix(prefix): name for name in part.scores if name.startswith(prefix)}
        if names:
            errors[kind] = _PoseErrors(
                {quantity: part.compute_mean(name) for quantity, name in names.items()},
                {quantity: part.means[name] for quantity, name in names.items()},
            )
    return errors


def _compute_spans(resampled: Mapping[str, np.ndarray]) -> dict[str, Span]:
    return {name: compute_interval(means) for name, means in resampled.items()}


def summarise_contact_quality(fields: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """Summarise what the simulator reports of its contacts, each field (N,)."""
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
    """Select contacts to show: for each stimulus those at QUANTILES of the score, worst first.

    Returns indices, none twice.
    """
    chosen: list[int] = []
    for index in np.unique(stimulus):
        inside = np.flatnonzero(stimulus == index)
        ranked = inside[np.argsort(scores[inside], kind="stable")]
        chosen += dict.fromkeys(int(ranked[round(q * (len(ranked) - 1))]) for q in QUANTILES)
    return np.array(chosen, np.int64)


def _compute_ratio(error: float | None, sheared: float | None) -> float | None:
    return error / sheared if error is not None and sheared else None


def _compute_recovery(
    sheared: float | None, unsheared: float | None, tap: float | None
) -> float | None:
    if sheared is None or unsheared is None or tap is None or sheared <= tap:
        return None
    return (sheared - unsheared) / (sheared - tap)


def _compute_recovery_interval(sheared: np.ndarray, unsheared: np.ndarray, tap: np.ndarray) -> Span:
    """Compute the interval of the recovery from resampled errors.

    None if the slide does no damage in one of the resamples, as the recovery then has no bounds.
    """
    if np.any(sheared <= tap):
        return None
    return compute_interval((sheared - unsheared) / (sheared - tap))
