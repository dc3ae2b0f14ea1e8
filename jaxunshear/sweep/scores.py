"""The scores of a cell's rows, by seed, test and name, and intervals of their means.

Intervals are over training seeds and test poses, by a crossed bootstrap. Every seed is scored at
the same test poses. A resample weights the seeds, draws poses, and takes every drawn pose with
every seed. Poses are many, so they are drawn with replacement. Seeds are few: a bootstrap of three
holds their mean in three cases of four, not in 95 of 100. Their weights are therefore normal, with
a spread that makes the interval Student's t where seeds alone vary.

Draws follow from the numbers of seeds and poses alone. Cells of a sweep see the same draws, so
differences between cells are those of pairs.
"""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

from jaxunshear.config.stimuli import list_stimulus_names
from jaxunshear.errors import UserError
from jaxunshear.evaluation import intervals
from jaxunshear.evaluation.score import SMOOTH
from jaxunshear.files import BROKEN_NPZ, explain_os_error, read_npz
from jaxunshear.results.run import Notes, Results
from jaxunshear.results.sweep import Outcome
from jaxunshear.selection import number_poses

SCORES = "scores.npz"  # of an evaluation, beside scores-<test>.npz
SEED = 0
INTERVALS_OVER = "training seeds and test poses"  # what the intervals of several seeds are over

# settings of the paired data that do not decide which contacts there are: names, the appearance
# of contacts, and the use of recorded ones
NON_CONTACT_SETTINGS = (
    *("config", "camera", "nuisance", "preprocess"),
    *("pairing", "pairs", "labelled", "direct_taps", "tap_folder", "slide_folder"),
)


class RowScores(NamedTuple):
    """The outcome of a row that has ended, and the scores of its test contacts.

    `tests` is by test, "" for the main one; it is empty if the row failed. It holds arrays (N,) by
    the names of the scores, which have a slash, and the labels `stimulus` and `pose_id`.
    """

    outcome: Outcome
    tests: Mapping[str, Mapping[str, np.ndarray]]


def read_tests(folder: Path, remedy: str) -> dict[str, dict[str, np.ndarray]]:
    """Read the scores that an evaluation wrote to `folder`, by test. Raises UserError."""
    tests = {}
    for path in (folder / SCORES, *sorted(folder.glob("scores-*.npz"))):
        name = path.stem.removeprefix("scores").removeprefix("-")
        try:
            tests[name] = read_npz(path)
        except OSError as error:
            raise explain_os_error(path, error, "read") from error
        except BROKEN_NPZ as error:
            raise UserError(f"{path} is damaged ({error}): {remedy}") from error
    return tests


def stack_scores(rows: Mapping[int, RowScores]) -> dict[tuple[str, str], np.ndarray]:
    """Stack the scores that all rows have by (test, name), (seeds, N)."""
    first, *others = [row.tests for row in rows.values()] or [{}]
    stacks = {}
    for test, scores in first.items():
        for name in scores:
            if "/" in name and all(name in tests.get(test, {}) for tests in others):
                by_seed = [row.tests[test][name] for row in rows.values()]
                stacks[test, name] = np.stack(by_seed).astype(np.float64)
    return stacks


def get_metric_notes(rows: Mapping[int, RowScores]) -> Notes:
    """Return the exact meaning of metrics such as MS-SSIM in the evaluation of the rows."""
    return _get_results(rows).metric if rows else {}


def _get_results(rows: Mapping[int, RowScores]) -> Results:
    return next(iter(rows.values())).outcome.evaluated_results


def format_name(test: str, name: str, part: str = "") -> str:
    """Format `<test>, <part>: <name>`, without what is empty."""
    prefix = ", ".join(filter(None, (test, part)))
    return f"{prefix}: {name}" if prefix else name


def select_by_shape(rows: Mapping[int, RowScores], test: str) -> dict[str, np.ndarray]:
    """Select the contacts (N,) of a test on each shape; the shapes of recordings are unknown."""
    results = _get_results(rows)
    stimuli = results.settings["paired"].get("stimuli", ())
    if test:
        stimuli = results.tests[test].stimuli if test in results.tests else ()
    stimulus, selected = _get_labels(rows, test)["stimulus"], {}
    for index, name in enumerate(list_stimulus_names(stimuli)):
        if np.any(stimulus == index):
            selected[name] = stimulus == index
    return selected


def select_smooth(rows: Mapping[int, RowScores], test: str) -> dict[str, np.ndarray]:
    """Select the contacts (N,) whose nearest edge has one direction, if the scores say so."""
    smooth = _get_labels(rows, test).get(SMOOTH)
    return {SMOOTH: smooth.astype(bool)} if smooth is not None and smooth.any() else {}


def has_same_contacts(
    rows: Mapping[int, RowScores], other: Mapping[int, RowScores], test: str
) -> bool:
    """Say whether both were tested on the same contacts, from equal settings."""
    if _get_contact_settings(rows, test) != _get_contact_settings(other, test):
        return False
    labels, other_labels = _get_labels(rows, test), _get_labels(other, test)
    return all(np.array_equal(labels[name], other_labels[name]) for name in ("stimulus", "pose_id"))


def _get_contact_settings(rows: Mapping[int, RowScores], test: str) -> dict[str, object]:
    results = _get_results(rows)
    settings, further_test = results.settings, results.tests.get(test)
    paired = {}
    for name, value in settings["paired"].items():
        if name not in NON_CONTACT_SETTINGS:
            changed = getattr(further_test, name, None)
            paired[name] = value if changed is None else changed
    return paired | {"sensor": settings["sensor"]}


def number_contact_poses(rows: Mapping[int, RowScores], test: str) -> np.ndarray:
    """Count up the poses of all stimuli and return the number of each contact, (N,)."""
    labels = _get_labels(rows, test)
    return number_poses(labels["stimulus"], labels["pose_id"])


def _get_labels(rows: Mapping[int, RowScores], test: str) -> Mapping[str, np.ndarray]:
    return next(iter(rows.values())).tests[test]


def describe_intervals(seeds: int) -> dict[str, str | int]:
    """Describe the intervals in sweep.json."""
    poses = "bootstrap over test poses, each with all its slides"
    kind = f"Student's t over {seeds} seeds and {poses}" if seeds > 1 else poses
    return {
        "interval": kind,
        "what": f"{intervals.LEVEL:.0%} interval of the mean: {kind}; the same draws in all cells",
        "over": INTERVALS_OVER if seeds > 1 else intervals.INTERVALS_OVER,
        "resamples": intervals.RESAMPLES,
        "seed": SEED,
    }


def compute_interval(values: np.ndarray, poses: np.ndarray) -> list[float]:
    """Compute the 95 % interval [low, high] of the mean of `values` (seeds, N).

    `poses` (N,) are the poses of the N contacts. With one seed the interval is over poses alone,
    as in an evaluation. Raises `ValueError` if shapes do not fit.
    """
    if values.ndim != 2 or not values.size or values.shape[1:] != poses.shape:
        raise ValueError("values must be an array (seeds, N), poses (N,), neither of them empty")
    return intervals.compute_interval(resample_means(values, poses))


def resample_means(values: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Compute the mean of `values` (seeds, N) in each of the resamples, (resamples,)."""
    _, group = np.unique(poses, return_inverse=True)
    counts = np.bincount(group).astype(np.float64)
    by_seed = [np.bincount(group, row) for row in values.astype(np.float64)]
    sums = np.stack(by_seed)  # (seeds, poses)
    seed_weights = draw_seed_weights(len(values), SEED + 1)
    pose_counts = draw_counts(len(counts), SEED)
    total = np.sum((seed_weights @ sums) * pose_counts, axis=1)
    return total / (len(values) * (pose_counts @ counts))


@functools.cache
def draw_seed_weights(seeds: int, seed: int) -> np.ndarray:
    """Draw the weight of each training seed in each resample, (resamples, seeds); mean 1.

    The weighted mean of numbers x, one per training seed, is normal about mean(x). Its standard
    deviation is that of the mean, s / sqrt(seeds), times t / z: the 97.5 % quantiles of Student's t
    with seeds - 1 degrees of freedom and of the normal distribution. A single seed counts 1.
    """
    upper = (1 + intervals.LEVEL) / 2
    ratio = stdtrit(seeds - 1, upper) / ndtri(upper) if seeds > 1 else 0.0
    normal = np.random.default_rng(seed).normal(size=(intervals.RESAMPLES, seeds))
    centred = normal - normal.mean(axis=1, keepdims=True)
    return 1 + ratio * np.sqrt(seeds / max(seeds - 1, 1)) * centred


@functools.cache
def draw_counts(items: int, seed: int) -> np.ndarray:
    """Draw how often each item occurs in each resample with replacement, (resamples, items)."""
    shares, generator = np.full(items, 1 / items), np.random.default_rng(seed)
    return generator.multinomial(items, shares, size=intervals.RESAMPLES).astype(np.float64)
