"""How much one set of numbers says about another: pure functions of arrays."""

import numpy as np
from jaxtyping import Float

PERMUTATIONS = 199


def compute_r2(squares: Float[np.ndarray, "*N"], scatter: Float[np.ndarray, "*N"]) -> float:
    """1 - SSE / SST of squared errors and squared distances from the mean: 1 where all is known, 0 where nothing is, below where a guess
    misleads; NaN where nothing varies."""
    total = float(np.sum(scatter, dtype=np.float64))
    return 1 - float(np.sum(squares, dtype=np.float64)) / total if total > 0 else float("nan")


def compute_hsic(
    one: Float[np.ndarray, "N F"], other: Float[np.ndarray, "M K"], seed: int = 0
) -> tuple[float, float]:
    """Hilbert-Schmidt independence criterion of N = M paired rows, with Gaussian kernels as wide as the median distance,
    over the root of each one's criterion with itself (0: independent, 1: the same); and the p-value of independence.

    Gretton et al. 2005, the biased estimate; p by PERMUTATIONS permutations, so never below 1 / (1 + PERMUTATIONS). Rows must be
    independent draws: one a pose. `ValueError` below four rows.
    """
    if len(one) < 4 or len(one) != len(other):
        raise ValueError("HSIC takes two arrays of one length, at least 4")
    k, m = _centre_kernel(_kernel(one)), _centre_kernel(_kernel(other))
    scale = float(np.sqrt(np.sum(k * k) * np.sum(m * m)))
    if not scale:
        return 0.0, 1.0
    found = float(np.sum(k * m))
    generator = np.random.default_rng(seed)
    orders = (generator.permutation(len(one)) for _ in range(PERMUTATIONS))
    higher = sum(float(np.sum(k * m[np.ix_(order, order)])) >= found for order in orders)
    return found / scale, (1 + higher) / (1 + PERMUTATIONS)


def _kernel(values: np.ndarray) -> np.ndarray:
    """(N, N)"""
    values = values.reshape(len(values), -1).astype(np.float64)
    squares = np.sum(values**2, axis=1)
    apart = np.maximum(squares[:, None] + squares - 2 * values @ values.T, 0)
    middle = float(np.median(apart[np.triu_indices(len(values), 1)]))
    return np.exp(-apart / middle) if middle > 0 else np.ones_like(apart)


def _centre_kernel(kernel: np.ndarray) -> np.ndarray:
    return kernel - kernel.mean(axis=0) - kernel.mean(axis=1, keepdims=True) + kernel.mean()
