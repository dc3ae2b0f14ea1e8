"""Some of many, evenly chosen."""

import numpy as np


def select_evenly(count: int, most: int) -> np.ndarray:
    """Indices of `most` of `count` things, in their order, the first and the last among them; of all where there are no more."""
    return np.linspace(0, count - 1, min(most, count)).round().astype(int)
