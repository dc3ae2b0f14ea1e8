"""Kernel ridge regression that chooses its kernel and its ridge.

>>> predict(fit(features, outputs), other_features)  # (M, K)

The same examples give the same bits. Kernel and ridge are those that do best on every fifth example
after a fit to the others.
"""

import warnings
from typing import NamedTuple

import numpy as np
from sklearn.kernel_ridge import KernelRidge
from sklearn.metrics.pairwise import euclidean_distances
from sklearn.model_selection import GridSearchCV, PredefinedSplit

from jaxunshear.selection import select_evenly

MIN_EXAMPLES = 10
MAX_SEARCH_EXAMPLES = 1000  # by which kernel and ridge are chosen
WIDTHS = (0.25, 0.5, 1.0, 2.0)  # of a Gaussian, over the median square distance of two examples
RIDGES = (1e-10, 1e-6, 1e-4, 1e-3, 1e-2, 1e-1)


class Ridge(NamedTuple):
    """A fit to examples of F features and K outputs each."""

    feature_mean: np.ndarray  # (F,)
    scale: float
    model: KernelRidge  # of scaled features, and of outputs less their mean
    output_mean: np.ndarray  # (K,)


def fit(features: np.ndarray, outputs: np.ndarray) -> Ridge:
    """Fit outputs (N, K) to features (N, F) without NaN.

    Raises `ValueError` if there are fewer than MIN_EXAMPLES.
    """
    if len(features) < MIN_EXAMPLES:
        raise ValueError(
            f"{len(features)} examples are too few for a ridge: {MIN_EXAMPLES} at least"
        )
    features, outputs = features.astype(np.float64), outputs.astype(np.float64)
    feature_mean = features.mean(axis=0)
    scaled = features - feature_mean
    scale = float(np.sqrt(np.mean(np.sum(scaled**2, axis=1)))) or 1.0
    scaled /= scale
    some = select_evenly(len(scaled), MAX_SEARCH_EXAMPLES)
    model = _search_model(scaled[some], outputs[some])
    output_mean = outputs.mean(axis=0)
    return Ridge(feature_mean, scale, model.fit(scaled, outputs - output_mean), output_mean)


def predict(ridge: Ridge, features: np.ndarray) -> np.ndarray:
    """Predict (M, K) for features (M, F)."""
    scaled = (features.astype(np.float64) - ridge.feature_mean) / ridge.scale
    return ridge.model.predict(scaled) + ridge.output_mean


def _search_model(features: np.ndarray, outputs: np.ndarray) -> KernelRidge:
    """Choose kernel and ridge by the squared error on every fifth example."""
    held_out = np.arange(len(features)) % 5 == 4
    median = float(np.median(euclidean_distances(features, squared=True))) or 1.0
    grid = [
        {"kernel": ["linear"], "alpha": RIDGES},
        {"kernel": ["rbf"], "gamma": [1 / (share * median) for share in WIDTHS], "alpha": RIDGES},
    ]
    split = PredefinedSplit(np.where(held_out, 0, -1))
    search = GridSearchCV(
        KernelRidge(), grid, cv=split, scoring="neg_mean_squared_error", refit=False
    )
    with warnings.catch_warnings():  # equal examples and next to no ridge
        warnings.simplefilter("ignore")
        search.fit(features, outputs - outputs[~held_out].mean(axis=0))
    return KernelRidge(**search.best_params_)
