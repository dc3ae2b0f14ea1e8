"""Intervals of means over training seeds and test poses, by a crossed bootstrap.

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

from jaxunshear.evaluation import intervals

SEED = 0
INTERVALS_OVER = "training seeds and test poses"  # what the intervals of several seeds are over


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
