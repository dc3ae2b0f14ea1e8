"""Selects some of many, evenly."""

import numpy as np


def select_evenly(count: int, most: int) -> np.ndarray:
    """Return indices of at most `most` of `count` items, with the first and the last, in order."""
    return np.linspace(0, count - 1, min(most, count)).round().astype(int)
