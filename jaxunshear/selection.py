"""Rows of arrays: evenly spaced ones, and groups of equal ones."""

import numpy as np


def select_evenly(count: int, most: int) -> np.ndarray:
    """Return indices of at most `most` of `count` items, with the first and the last, in order."""
    return np.linspace(0, count - 1, min(most, count)).round().astype(int)


def number_poses(stimulus: np.ndarray, pose_id: np.ndarray) -> np.ndarray:
    """Count up the poses (N,) of contacts, by their stimulus (N,) and its pose (N,)."""
    pairs = np.stack([stimulus, pose_id], axis=1)
    return np.unique(pairs, axis=0, return_inverse=True)[1].reshape(-1)
