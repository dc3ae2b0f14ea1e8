"""How far a mean would move with other seeds and other test contacts: a bootstrap over both, crossed. Pure functions.

Every seed is scored at the same test poses, so a resample draws seeds, and draws poses, and takes every drawn pose with every
drawn seed. Draws follow from how many seeds and poses there are alone: cells of a sweep see the same, and so differences
between cells are those of pairs.
"""

import functools

import numpy as np

from jaxunshear.evaluation import spread

SEED = 0
OVER = "training seeds and test poses"  # what the intervals of several seeds are over


def spread_of(seeds: int) -> dict[str, str | int]:
    """Of sweep.json: what its intervals are."""
    slides = "each drawn pose with all its slides"
    drawn = (
        f"seeds and test poses, {slides} and with every drawn seed" if seeds > 1 else f"the seed's test poses, {slides}"
    )
    return {
        "what": f"{spread.LEVEL:.0%} bootstrap interval of the mean over {drawn}; the same draws in all cells",
        "over": OVER if seeds > 1 else spread.OVER,
        "resamples": spread.RESAMPLES,
        "seed": SEED,
    }


def interval(values: np.ndarray, poses: np.ndarray) -> list[float]:
    """[low, high] of the mean of `values` (seeds, N) at 95 %; `poses` (N,) are the poses that the N contacts belong to.

    With one seed it is that of the evaluation: over poses alone. Raises `ValueError` where shapes do not fit.
    """
    if values.ndim != 2 or not values.size or values.shape[1:] != poses.shape:
        raise ValueError("values must be an array (seeds, N), poses (N,), neither of them empty")
    return spread.interval(resampled(values, poses))


def resampled(values: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """The mean of `values` (seeds, N) in each of the resamples, (resamples,)."""
    _, group = np.unique(poses, return_inverse=True)
    counts = np.bincount(group).astype(np.float64)
    sums = np.stack([np.bincount(group, row) for row in values.astype(np.float64)])  # (seeds, poses)
    of_seeds, of_poses = draws(len(values), SEED + 1), draws(len(counts), SEED)
    return np.sum((of_seeds @ sums) * of_poses, axis=1) / (len(values) * (of_poses @ counts))


@functools.cache
def draws(things: int, seed: int) -> np.ndarray:
    """How often each of `things` is drawn, with replacement, in each resample: (resamples, things)."""
    equal = np.full(things, 1 / things)
    return np.random.default_rng(seed).multinomial(things, equal, size=spread.RESAMPLES).astype(np.float64)
