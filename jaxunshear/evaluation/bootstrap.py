"""Bootstrap intervals: how far a mean would move if the test had drawn other contacts.

Slides at one pose share their tap, so they are no independent draws. Poses are drawn, each with all
its slides.
"""

from collections.abc import Mapping

import numpy as np

LEVEL = 0.95
RESAMPLES = 1000
INTERVALS_OVER = "test poses of one training"


def number_poses(stimulus: np.ndarray, pose_id: np.ndarray) -> np.ndarray:
    """Count up the poses (N,) of contacts, by their stimulus (N,) and its pose (N,)."""
    pairs = np.stack([stimulus, pose_id], axis=1)
    return np.unique(pairs, axis=0, return_inverse=True)[1].reshape(-1)


def resample_means(
    values: Mapping[str, np.ndarray], poses: np.ndarray, seed: int
) -> dict[str, np.ndarray]:
    """Compute means (RESAMPLES,) of each array (N,) over resampled poses.

    `poses` (N,) says which pose each value belongs to. All arrays get the same draws, so the means
    of one do not depend on the others, and a figure made of several means can be computed draw by
    draw.
    """
    _, group = np.unique(poses, return_inverse=True)
    counts = np.bincount(group).astype(np.float64)
    draws = np.random.default_rng(seed).multinomial(
        len(counts), np.full(len(counts), 1 / len(counts)), size=RESAMPLES
    )
    return {
        name: (draws @ np.bincount(group, value.astype(np.float64))) / (draws @ counts)
        for name, value in values.items()
    }


def compute_interval(means: np.ndarray) -> list[float]:
    """Compute the interval [low, high] of 95 % of resampled figures (RESAMPLES,)."""
    return np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2]).tolist()


def compute_intervals(
    values: Mapping[str, np.ndarray], poses: np.ndarray, seed: int
) -> dict[str, list[float]]:
    """Compute the interval [low, high] of the mean of each array (N,), as `resample_means`.

    A single pose gives an interval without width.
    """
    resampled = resample_means(values, poses, seed)
    return {name: compute_interval(means) for name, means in resampled.items()}
