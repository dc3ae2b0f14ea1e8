"""How far a mean would move if the test had drawn other contacts: bootstrap intervals.

Slides at one pose share their tap, so they are no independent draws: entire poses are drawn, each with all its slides.
"""

import numpy as np

LEVEL = 0.95
RESAMPLES = 1000
INTERVALS_OVER = "test poses of one training"  # what the intervals of one run are over


def number_poses(stimulus: np.ndarray, pose_id: np.ndarray) -> np.ndarray:
    """(N,) which pose of which stimulus a contact belongs to; both (N,)."""
    return np.unique(np.stack([stimulus, pose_id], axis=1), axis=0, return_inverse=True)[1].reshape(
        -1
    )


def resample_means(
    values: dict[str, np.ndarray], poses: np.ndarray, seed: int
) -> dict[str, np.ndarray]:
    """Means (RESAMPLES,) of each (N,) array over as many draws of the poses (N,) that its numbers belong to.

    All arrays see the same draws, so a group's figures do not depend on which others are asked for, and figures made of several
    means can be made draw by draw. Raises `ValueError` where nothing is given or lengths differ.
    """
    if (
        poses.ndim != 1
        or not len(poses)
        or any(value.shape != poses.shape for value in values.values())
    ):
        raise ValueError("values and poses must be arrays (N,) of one length, at least 1")
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
    """[low, high] that holds 95 % of redrawn figures (RESAMPLES,)."""
    return np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2]).tolist()


def compute_intervals(
    values: dict[str, np.ndarray], poses: np.ndarray, seed: int
) -> dict[str, list[float]]:
    """[low, high] of the mean of each (N,) array, at 95 %; see `resample_means`. A single pose gives no width."""
    return {
        name: compute_interval(means) for name, means in resample_means(values, poses, seed).items()
    }
