"""Kernel ridge regression whose kernel and ridge are chosen: the same bits for the same examples.

>>> answers(fitted(features, outputs), others)  # (M, K)

Kernel and ridge are those that do best on every fifth example, after a fit to the others.
"""

import warnings
from typing import NamedTuple

import numpy as np
from sklearn.kernel_ridge import KernelRidge
from sklearn.metrics.pairwise import euclidean_distances
from sklearn.model_selection import GridSearchCV, PredefinedSplit

from jaxunshear.selection import select_evenly

FEWEST = 10  # examples
TRIED_ON = 1000  # examples at most, by which kernel and ridge are chosen
WIDTHS = (0.25, 0.5, 1.0, 2.0)  # of a Gaussian, over the median square distance of two examples
RIDGES = (1e-10, 1e-6, 1e-4, 1e-3, 1e-2, 1e-1)


class Ridge(NamedTuple):
    """What was learnt from N examples of F features, K outputs each."""

    middle: np.ndarray  # (F,)
    scale: float
    model: KernelRidge  # of scaled features, and of outputs less their mean
    mean: np.ndarray  # (K,)


def fitted(features: np.ndarray, outputs: np.ndarray) -> Ridge:
    """Fit features (N, F) without NaN to outputs (N, K). Raises `ValueError` of fewer than FEWEST."""
    if len(features) < FEWEST:
        raise ValueError(f"{len(features)} examples are too few for a ridge: {FEWEST} at least")
    features, outputs = features.astype(np.float64), outputs.astype(np.float64)
    middle = features.mean(axis=0)
    known = features - middle
    scale = float(np.sqrt(np.mean(np.sum(known**2, axis=1)))) or 1.0
    known /= scale
    some = select_evenly(len(known), TRIED_ON)
    model = _chosen(known[some], outputs[some])
    mean = outputs.mean(axis=0)
    return Ridge(middle, scale, model.fit(known, outputs - mean), mean)


def answers(ridge: Ridge, features: np.ndarray) -> np.ndarray:
    """Predict (M, K) for features (M, F)."""
    scaled = (features.astype(np.float64) - ridge.middle) / ridge.scale
    return ridge.model.predict(scaled) + ridge.mean


def _chosen(known: np.ndarray, outputs: np.ndarray) -> KernelRidge:
    """Kernel and ridge by the squared error on every fifth example."""
    judged = np.arange(len(known)) % 5 == 4
    usual = float(np.median(euclidean_distances(known, squared=True))) or 1.0
    grid = [
        {"kernel": ["linear"], "alpha": RIDGES},
        {"kernel": ["rbf"], "gamma": [1 / (share * usual) for share in WIDTHS], "alpha": RIDGES},
    ]
    split = PredefinedSplit(np.where(judged, 0, -1))
    search = GridSearchCV(
        KernelRidge(), grid, cv=split, scoring="neg_mean_squared_error", refit=False
    )
    with warnings.catch_warnings():  # equal examples and next to no ridge
        warnings.simplefilter("ignore")
        search.fit(known, outputs - outputs[~judged].mean(axis=0))
    return KernelRidge(**search.best_params_)
