"""Test whether two sets of numbers are independent, by pure functions of arrays."""

import numpy as np
from jaxtyping import Float

PERMUTATIONS = 199


def compute_hsic(
    one: Float[np.ndarray, "N F"], other: Float[np.ndarray, "M K"], seed: int = 0
) -> tuple[float, float]:
    """Compute the Hilbert-Schmidt independence criterion of N = M paired rows, and its p-value.

    Gaussian kernels are as wide as the median distance. The criterion is the biased estimate of
    Gretton et al. 2005, divided by the root of each set's criterion with itself (0: independent,
    1: the same). p is that of independence, by PERMUTATIONS permutations, so never below
    1 / (1 + PERMUTATIONS). Rows must be independent draws: one per pose.
    Raises `ValueError` below four rows.
    """
    if len(one) < 4 or len(one) != len(other):
        raise ValueError("HSIC takes two arrays of one length, at least 4")
    k, m = _centre_kernel(_compute_kernel(one)), _centre_kernel(_compute_kernel(other))
    scale = float(np.sqrt(np.sum(k * k) * np.sum(m * m)))
    if not scale:
        return 0.0, 1.0
    criterion = float(np.sum(k * m))
    generator = np.random.default_rng(seed)
    orders = (generator.permutation(len(one)) for _ in range(PERMUTATIONS))
    higher = sum(float(np.sum(k * m[np.ix_(order, order)])) >= criterion for order in orders)
    return criterion / scale, (1 + higher) / (1 + PERMUTATIONS)


def _compute_kernel(values: np.ndarray) -> np.ndarray:
    """Compute the kernel (N, N) of N rows."""
    values = values.reshape(len(values), -1).astype(np.float64)
    squares = np.sum(values**2, axis=1)
    distances = np.maximum(squares[:, None] + squares - 2 * values @ values.T, 0)
    median = float(np.median(distances[np.triu_indices(len(values), 1)]))
    return np.exp(-distances / median) if median > 0 else np.ones_like(distances)


def _centre_kernel(kernel: np.ndarray) -> np.ndarray:
    return kernel - kernel.mean(axis=0) - kernel.mean(axis=1, keepdims=True) + kernel.mean()
