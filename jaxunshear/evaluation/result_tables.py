"""Build the tables of results from the scores of contacts, by pure functions of arrays."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.targets import Targets, read_true_values
from jaxunshear.evaluation.contact_scores import ContactScores
from jaxunshear.evaluation.intervals import (
    INTERVALS_OVER,
    LEVEL,
    RESAMPLES,
    compute_interval,
    compute_recovery,
    compute_recovery_interval,
    resample_means,
)
from jaxunshear.evaluation.measurements import PAPER, round_values
from jaxunshear.evaluation.score import (
    CELL_METRICS,
    CELLS,
    compute_chance_errors,
    get_cell_target,
    list_kinds,
    list_pose_kinds,
)
from jaxunshear.files import Json
from jaxunshear.metrics import count_scales, format_ms_ssim_name
from jaxunshear.results.provenance import describe_provenance, read_training_facts
from jaxunshear.results.run import (
    CodeSwapScore,
    PartPoses,
    Parts,
    PoseSpread,
    Results,
    Span,
    Spread,
    Tables,
)

Figure = TypeVar("Figure")
OVERALL = "overall"
PARTS = 3  # equal parts of the range of a size
SEED = 0  # of the bootstrap


class Resampled(NamedTuple):
    """Scores (N,) of some contacts by the names of `score`, with their resampled means."""

    scores: Mapping[str, np.ndarray]
    means: Mapping[str, np.ndarray]  # (RESAMPLES,)

    def compute_mean(self, name: str) -> float | None:
        values = self.scores[name]
        return float(np.mean(values, dtype=np.float64)) if len(values) else None

    def compute_interval(self, name: str) -> list[float]:
        return compute_interval(self.means[name])


def resample(
    scores: Mapping[str, np.ndarray], poses: np.ndarray, inside: np.ndarray | None = None
) -> Resampled | None:
    """Resample the scores (N,) of all contacts, or of those `inside`; None if there is none."""
    if inside is not None:
        scores = {name: score[inside] for name, score in scores.items()}
        poses = poses[inside]
    return Resampled(scores, resample_means(scores, poses, SEED)) if len(poses) else None


def build_tables(
    contacts: ContactScores, stimuli: Sequence[str] = (), taps: ContactScores | None = None
) -> Tables:
    """Build the tables of a test, with their 95 % intervals under `spread`.

    `stimuli` are names, indexed by the label `stimulus`; one without test contacts is None. `taps`
    join the tables of poses. `pose_ratio` is the error over that on sheared images; `pose_recovery`
    is None if the slide does no damage; `difference` is disentangled less another network, contact
    by contact. `readers` are the errors of pose estimators other than PoseNet, and `reader_images`
    the number of images that they come from.
    """
    scores, poses, stimulus = contacts.scores, contacts.poses, contacts.labels["stimulus"]
    parts = {name: resample(scores, poses, stimulus == index) for index, name in enumerate(stimuli)}
    overall = Resampled(scores, resample_means(scores, poses, SEED))
    tested_poses = overall
    if taps is not None and taps.scores:  # resampled separately, as they are no pairs
        means = resample_means(taps.scores, taps.poses, SEED + 1)
        tested_poses = Resampled({**scores, **taps.scores}, {**overall.means, **means})
    pose_table = tabulate_poses(tested_poses)
    groups = {**parts, OVERALL: overall}
    differences = _group_names(scores, "difference")
    readers = _tabulate_estimators([contacts] if taps is None else [taps, contacts])
    return Tables(
        ms_ssim=_tabulate_similarity(groups, Resampled.compute_mean),
        pose_mae=pose_table.pose_mae,
        pose_ratio=pose_table.pose_ratio,
        pose_recovery=pose_table.pose_recovery,
        pose_by_stimulus={
            name: None if part is None else tabulate_poses(part) for name, part in parts.items()
        },
        difference=_map_names(differences, overall.compute_mean),
        swap=_tabulate_swaps(overall),
        readers=readers.means,
        reader_images=readers.counts,
        spread=Spread(
            what=f"{LEVEL:.0%} bootstrap interval of the mean over test poses, "
            "each with all its slides",
            over=INTERVALS_OVER,
            resamples=RESAMPLES,
            seed=SEED,
            ms_ssim=_tabulate_similarity(groups, Resampled.compute_interval),
            pose_mae=pose_table.spread.pose_mae,
            pose_recovery=pose_table.spread.pose_recovery,
            difference=_map_names(differences, overall.compute_interval),
            readers=readers.intervals,
        ),
    )


def describe_run(
    experiment: Experiment, contacts: ContactScores, targets: Targets, tables: Tables
) -> Json:
    """Return the fields that results of every test have."""
    chance = compute_chance_errors(read_true_values(targets, contacts.labels), targets)
    return {
        "experiment": experiment.name,
        "claim": experiment.claim,
        "baselines": {"pose_chance": chance},
        "paper": PAPER,
        "settings": dataclasses.asdict(experiment),
        **vars(tables),
    }


def finish_results(
    results: Results, experiment: Experiment, run_dir: Path, command: str
) -> Results:
    """Add what evaluated and trained the networks in `run_dir`, and round all numbers."""
    facts = read_training_facts(run_dir, experiment.networks) | describe_provenance(command)
    return round_values(dataclasses.replace(results, **facts))


def describe_similarity(size: int) -> dict[str, str | int]:
    """Say what the names of tables stand for that all tests have, over images of `size` px."""
    scales = count_scales(size)
    ms_ssim = format_ms_ssim_name(scales)
    return {
        "ms_ssim": ms_ssim,
        "image_px": size,
        "scales": scales,
        "pose_ratio": "error over the error on sheared images",
        "pose_recovery": "(sheared - unsheared) / (sheared - tap)",
        "swap": f"mean squared error, SSIM and {ms_ssim} of a decoder's image",
    }


def _tabulate_similarity(
    groups: Mapping[str, Resampled | None], compute: Callable[[Resampled, str], Figure]
) -> dict[str, dict[str, Figure | None]]:
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


def _tabulate_swaps(overall: Resampled) -> dict[str, CodeSwapScore]:
    table = {}
    for cell in CELLS:
        if f"swap/{cell}/mse" in overall.scores:
            means = {name: overall.compute_mean(f"swap/{cell}/{name}") for name in CELL_METRICS}
            table[cell] = CodeSwapScore(target=get_cell_target(cell), **means)
    return table


class _EstimatorTables(NamedTuple):
    """By estimator, kind and quantity; counts of images by estimator and kind."""

    means: dict[str, dict[str, dict[str, float | None]]]
    intervals: dict[str, dict[str, dict[str, Span]]]
    counts: dict[str, dict[str, dict[str, int]]]


def _tabulate_estimators(tests: Sequence[ContactScores]) -> _EstimatorTables:
    """Tabulate `read/<estimator>/<kind>/<quantity>`, NaN for images without an estimate."""
    tables = _EstimatorTables({}, {}, {})
    scored = []
    for test in tests:
        poses = test.poses
        scored += [(name, score, poses) for name, score in test.scores.items()]
        kept = poses[test.kept_rows]
        scored += [(name, score, kept) for name, score in test.estimates.items()]
    for name, score, poses in scored:
        if not name.startswith("read/"):
            continue
        _, estimator, kind, quantity = name.split("/")
        finite = np.isfinite(score)
        part = resample({name: score}, poses, finite)
        mean = None if part is None else part.compute_mean(name)
        interval = None if part is None else part.compute_interval(name)
        tables.means.setdefault(estimator, {}).setdefault(kind, {})[quantity] = mean
        tables.intervals.setdefault(estimator, {}).setdefault(kind, {})[quantity] = interval
        tables.counts.setdefault(estimator, {})[kind] = {
            "read": int(finite.sum()),
            "left_out": int((~finite).sum()),
        }
    return tables


def tabulate_by_size(contacts: ContactScores, size: np.ndarray, least: float, most: float) -> Parts:
    """Tabulate poses by a size (N,) of the slides, mm, in PARTS equal parts of its range.

    The size is an indentation depth, as a shallow touch shows little of a pose even as a tap, or a
    length. A part without test contacts is None; a range of zero has no parts, nor has a test
    without poses.
    """
    scores = {name: score for name, score in contacts.scores.items() if name.startswith("pose/")}
    if least == most or not scores:
        return {}
    bounds = np.linspace(least, most, PARTS + 1)
    part = np.digitize(size, bounds[1:-1])
    # as many digits as distinguish the parts
    digits = max(1, 1 - math.floor(math.log10(bounds[1] - bounds[0])))
    table: dict[str, PartPoses | None] = {}
    for index, (low, high) in enumerate(itertools.pairwise(bounds)):
        name = f"{low:.{digits}f}-{high:.{digits}f} mm"
        table[name] = tabulate_part(scores, contacts.poses, part == index)
    return table


def tabulate_part(
    scores: Mapping[str, np.ndarray], poses: np.ndarray, inside: np.ndarray
) -> PartPoses | None:
    """Tabulate poses over the contacts `inside` (N,) alone; None if there is none."""
    part = resample(scores, poses, inside)
    return None if part is None else tabulate_poses(part)


def tabulate_poses(part: Resampled) -> PartPoses:
    """Tabulate pose errors, their ratios and recoveries, with intervals."""
    names = _group_names(part.scores, "pose")
    names = {kind: names[kind] for kind in list_pose_kinds() if kind in names}
    errors = _map_names(names, part.compute_mean)
    resampled = _map_names(names, part.means.__getitem__)
    ratios: dict[str, dict[str, float | None]] = {}
    recoveries: dict[str, dict[str, float | None]] = {}
    intervals: dict[str, dict[str, Span]] = {}

    def compute_ratio(error: float | None, sheared: float | None) -> float | None:
        return error / sheared if error is not None and sheared else None

    for kind in errors if "sheared" in errors else ():
        if kind in ("tap", "sheared"):
            continue
        ratios[kind] = combine_kinds(compute_ratio, errors, (kind, "sheared"))
        if "tap" in errors:
            kinds = (kind, "sheared", "tap")
            recoveries[kind] = combine_kinds(compute_recovery, errors, kinds)
            intervals[kind] = combine_kinds(compute_recovery_interval, resampled, kinds)
    return PartPoses(
        pose_mae=errors,
        pose_ratio=ratios,
        pose_recovery=recoveries,
        spread=PoseSpread(
            pose_mae=_map_names(names, part.compute_interval), pose_recovery=intervals
        ),
    )


def _group_names(scores: Iterable[str], table: str) -> dict[str, dict[str, str]]:
    """Group the names `<table>/<kind>/<quantity>` of scores by kind and quantity."""
    names: dict[str, dict[str, str]] = {}
    for name in scores:
        if name.startswith(f"{table}/"):
            _, kind, quantity = name.split("/")
            names.setdefault(kind, {})[quantity] = name
    return names


def _map_names(
    names: Mapping[str, Mapping[str, str]], compute: Callable[[str], Figure]
) -> dict[str, dict[str, Figure]]:
    table = {}
    for kind, quantities in names.items():
        table[kind] = {quantity: compute(name) for quantity, name in quantities.items()}
    return table


def combine_kinds(
    compute: Callable[..., Figure], table: Mapping[str, Mapping[str, object]], kinds: Sequence[str]
) -> dict[str, Figure]:
    """Compute a figure of each quantity from its values for several kinds."""
    rows = [table[kind] for kind in kinds]
    return {name: compute(*map(itemgetter(name), rows)) for name in rows[0]}
