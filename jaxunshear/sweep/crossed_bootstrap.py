"""How far a mean would move with other seeds and other test contacts, crossed. Pure functions.

Every seed is scored at the same test poses. A resample weights the seeds, draws poses, and takes
every drawn pose with every seed. Poses are many, so they are drawn with replacement. Seeds are few:
a bootstrap of three holds their mean in three cases of four, not in 95 of 100. Their weights are
therefore normal, with a spread that makes the interval Student's t where seeds alone vary.

Draws follow from the numbers of seeds and poses alone. Cells of a sweep see the same draws, so
differences between cells are those of pairs.
"""

import functools

import numpy as np
from scipy.special import ndtri, stdtrit

from jaxunshear.evaluation import bootstrap

SEED = 0
INTERVALS_OVER = "training seeds and test poses"  # what the intervals of several seeds are over


def describe_intervals(seeds: int) -> dict[str, str | int]:
    """Say what the intervals in sweep.json are."""
    drawn = "bootstrap over test poses, each with all its slides"
    kind = f"Student's t over {seeds} seeds and {drawn}" if seeds > 1 else drawn
    return {
        "interval": kind,
        "what": f"{bootstrap.LEVEL:.0%} interval of the mean: {kind}; the same draws in all cells",
        "over": INTERVALS_OVER if seeds > 1 else bootstrap.INTERVALS_OVER,
        "resamples": bootstrap.RESAMPLES,
        "seed": SEED,
    }


def compute_interval(values: np.ndarray, poses: np.ndarray) -> list[float]:
    """[low, high] of the mean of `values` (seeds, N) at 95 %; `poses` (N,) are the poses that the N contacts belong to.

    With one seed it is that of the evaluation: over poses alone. Raises `ValueError` where shapes do not fit.
    """
    if values.ndim != 2 or not values.size or values.shape[1:] != poses.shape:
        raise ValueError("values must be an array (seeds, N), poses (N,), neither of them empty")
    return bootstrap.compute_interval(resample_means(values, poses))


def resample_means(values: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Give the mean of `values` (seeds, N) in each of the resamples, (resamples,)."""
    _, group = np.unique(poses, return_inverse=True)
    counts = np.bincount(group).astype(np.float64)
    sums = np.stack(
        [np.bincount(group, row) for row in values.astype(np.float64)]
    )  # (seeds, poses)
    of_seeds, of_poses = draw_seed_weights(len(values), SEED + 1), draw_counts(len(counts), SEED)
    return np.sum((of_seeds @ sums) * of_poses, axis=1) / (len(values) * (of_poses @ counts))


@functools.cache
def draw_seed_weights(seeds: int, seed: int) -> np.ndarray:
    """Draw how much each training seed counts in each resample, (resamples, seeds); 1 on average.

    The weighted mean of numbers x, one per training seed, is normal about mean(x). Its standard
    deviation is that of the mean, s / sqrt(seeds), times t / z: the 97.5 % quantiles of Student's t
    with seeds - 1 degrees of freedom and of the normal distribution. A single seed counts 1.
    """
    upper = (1 + bootstrap.LEVEL) / 2
    wider = stdtrit(seeds - 1, upper) / ndtri(upper) if seeds > 1 else 0.0
    drawn = np.random.default_rng(seed).normal(size=(bootstrap.RESAMPLES, seeds))
    apart = drawn - drawn.mean(axis=1, keepdims=True)
    return 1 + wider * np.sqrt(seeds / max(seeds - 1, 1)) * apart


@functools.cache
def draw_counts(things: int, seed: int) -> np.ndarray:
    """Draw how often each of `things` counts, with replacement, in each resample: (resamples, things)."""
    equal = np.full(things, 1 / things)
    return (
        np.random.default_rng(seed)
        .multinomial(things, equal, size=bootstrap.RESAMPLES)
        .astype(np.float64)
    )
