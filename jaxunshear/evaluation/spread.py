"""How far a mean would move if the test had drawn other contacts: bootstrap intervals.

Slides at one pose share their tap, so they are no independent draws: whole poses are drawn, each with all its slides.
"""

import numpy as np

LEVEL = 0.95
RESAMPLES = 1000


def intervals(values: dict[str, np.ndarray], poses: np.ndarray, seed: int) -> dict[str, list[float]]:
    """[low, high] of the mean of each (N,) array, at 95 %, over 1,000 draws of the poses (N,) they belong to.

    All arrays see the same draws, so a group's figures do not depend on which others are asked for. A single pose gives
    an interval of no width. Raises `ValueError` where nothing is given or lengths differ.
    """
    if poses.ndim != 1 or not len(poses) or any(value.shape != poses.shape for value in values.values()):
        raise ValueError("values and poses must be arrays (N,) of one length, at least 1")
    _, group = np.unique(poses, return_inverse=True)
    counts = np.bincount(group).astype(np.float64)
    draws = np.random.default_rng(seed).multinomial(len(counts), np.full(len(counts), 1 / len(counts)), size=RESAMPLES)
    found = {}
    for name, value in values.items():
        means = (draws @ np.bincount(group, value.astype(np.float64))) / (draws @ counts)
        found[name] = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2]).tolist()
    return found
