"""Standard scores of disentanglement, by block: pose code and shear code are the blocks.

The scores of the literature measure whether each *number* of a code contains one factor. A pose
code of 16 numbers need not separate x from yaw, so these versions measure whether each *block*
contains its own factors. MIG: Chen et al. 2018; SAP: Kumar et al. 2018; DCI: Eastwood and Williams
2018; bins and their number as in disentanglement_lib (Locatello et al. 2019).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from sklearn.ensemble import ExtraTreesRegressor
from sklearn.metrics import mutual_info_score
from sklearn.metrics.pairwise import euclidean_distances
from sklearn.preprocessing import KernelCenterer

BINS = 20
TREES = 100


class Blocks(NamedTuple):
    """Codes of N contacts with their factors; a block owns the factors that it should contain."""

    codes: Float[np.ndarray, "N D"]
    block: Int[np.ndarray, "D"]  # 0 or 1, of each number of the codes
    factors: Float[np.ndarray, "N K"]
    owner: Int[np.ndarray, "K"]  # the block that should contain each factor


def score_mig(data: Blocks) -> float:
    """Compute the mutual information gap of blocks.

    It is 1 if each factor is in its own block alone, 0 if it is in both. The information of a block
    is that of its best number, in shares of the factor's entropy.
    """
    codes, factors = _discretise(data.codes), _discretise(data.factors)
    information = np.zeros((2, data.factors.shape[1]))
    for number, block in enumerate(data.block):
        for k in range(information.shape[1]):
            shared = mutual_info_score(codes[:, number], factors[:, k])
            entropy = mutual_info_score(factors[:, k], factors[:, k])
            information[block, k] = max(information[block, k], shared / max(entropy, 1e-12))
    return _compute_gap(information, data.owner)


def score_sap(train: Blocks, test: Blocks) -> float:
    """Compute the separated attribute predictability of blocks.

    The predictability of a factor is the R2 of a line from the best single number of a block.
    """
    r2 = np.zeros((2, train.factors.shape[1]))
    for number, block in enumerate(train.block):
        for k in range(r2.shape[1]):
            slope, offset = np.polyfit(train.codes[:, number], train.factors[:, k], 1)
            truth = test.factors[:, k]
            error = np.mean((slope * test.codes[:, number] + offset - truth) ** 2)
            r2[block, k] = max(r2[block, k], 1 - error / max(truth.var(), 1e-12))
    return _compute_gap(r2, train.owner)


def score_dci(train: Blocks, test: Blocks) -> dict[str, float]:
    """Compute disentanglement, completeness and informativeness by extremely randomised trees.

    Disentanglement: a block serves one kind of factor. Completeness: a factor is served by one
    block. Informativeness: mean R2 on the test contacts.
    """
    importance = np.zeros((2, train.factors.shape[1]))
    r2 = []
    for k in range(importance.shape[1]):
        trees = ExtraTreesRegressor(TREES, min_samples_leaf=5, random_state=0, max_features=0.5)
        trees.fit(train.codes, train.factors[:, k])
        np.add.at(importance[:, k], train.block, trees.feature_importances_)
        r2.append(float(trees.score(test.codes, test.factors[:, k])))
    kinds = np.stack([importance[:, train.owner == owner].mean(axis=1) for owner in (0, 1)], axis=1)
    weights = kinds.sum(axis=1) / kinds.sum()
    return {
        "disentanglement": float(np.sum(weights * (1 - _compute_entropy(kinds)))),
        "completeness": float(np.mean(1 - _compute_entropy(importance.T))),
        "informativeness": float(np.mean(r2)),
    }


def _discretise(values: Float[np.ndarray, "N D"]) -> Int[np.ndarray, "N D"]:
    """Discretise each number to BINS of equal width over its range."""
    low, high = values.min(axis=0), values.max(axis=0)
    share = (values - low) / np.where(high > low, high - low, 1)
    return np.minimum((share * BINS).astype(int), BINS - 1)


def _compute_gap(scores: Float[np.ndarray, "2 K"], owner: Int[np.ndarray, "K"]) -> float:
    columns = np.arange(len(owner))
    return float(np.mean(scores[owner, columns] - scores[1 - owner, columns]))


def _compute_entropy(shares: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, "M"]:
    """Compute the entropy of each row, in bits; 0 for a row of zeros."""
    p = shares / np.maximum(shares.sum(axis=1, keepdims=True), 1e-12)
    return -np.sum(p * np.log2(np.maximum(p, 1e-12)), axis=1)


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
    k, m = _compute_centred_kernel(one), _compute_centred_kernel(other)
    scale = float(np.sqrt(np.sum(k * k) * np.sum(m * m)))
    if not scale:
        return 0.0, 1.0
    criterion = float(np.sum(k * m))
    generator = np.random.default_rng(seed)
    orders = (generator.permutation(len(one)) for _ in range(PERMUTATIONS))
    higher = sum(float(np.sum(k * m[np.ix_(order, order)])) >= criterion for order in orders)
    return criterion / scale, (1 + higher) / (1 + PERMUTATIONS)


def _compute_centred_kernel(values: np.ndarray) -> np.ndarray:
    rows = values.reshape(len(values), -1).astype(np.float64)
    distances = euclidean_distances(rows, squared=True)
    median = float(np.median(distances[np.triu_indices(len(values), 1)]))
    kernel = np.exp(-distances / median) if median > 0 else np.ones_like(distances)
    return KernelCenterer().fit_transform(kernel)
