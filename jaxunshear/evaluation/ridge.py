"""Kernel ridge regression: pure functions of arrays, the same bits for the same examples.

>>> answers(fitted(features, outputs), others)  # (M, K)

Kernel and ridge are those that do best on every fifth example, after a fit to the others.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg

from jaxunshear.evenly import evenly

FEWEST = 10  # examples
TRIED_ON = 1000  # examples at most, by which kernel and ridge are chosen
WIDTHS = (None, 0.25, 0.5, 1.0, 2.0)  # of a Gaussian, over the median square distance of two examples; None: linear
RIDGES = (1e-10, 1e-6, 1e-4, 1e-3, 1e-2, 1e-1)


class Ridge(NamedTuple):
    """What was learnt from N examples of F features, K outputs each."""

    middle: np.ndarray  # (F,)
    scale: float
    known: np.ndarray  # (N, F), scaled
    width: float | None  # of the Gaussian, a square distance; None: linear
    weights: np.ndarray  # (N, K)
    mean: np.ndarray  # (K,)


def fitted(features: np.ndarray, outputs: np.ndarray) -> Ridge:
    """Features (N, F) without NaN, outputs (N, K). Raises `ValueError` of fewer than FEWEST examples."""
    if len(features) < FEWEST:
        raise ValueError(f"{len(features)} examples are too few for a ridge: {FEWEST} at least")
    features, outputs = features.astype(np.float64), outputs.astype(np.float64)
    middle = features.mean(axis=0)
    known = features - middle
    scale = float(np.sqrt(np.mean(np.sum(known**2, axis=1)))) or 1.0
    known /= scale
    some = evenly(len(known), TRIED_ON)
    width, ridge = _chosen(known[some], outputs[some])
    mean = outputs.mean(axis=0)
    weights = _solved(_kernel(known, known, width), outputs - mean, ridge)
    return Ridge(middle, scale, known, width, weights, mean)


def answers(ridge: Ridge, features: np.ndarray) -> np.ndarray:
    """(M, K) for features (M, F)."""
    scaled = (features.astype(np.float64) - ridge.middle) / ridge.scale
    return _kernel(scaled, ridge.known, ridge.width) @ ridge.weights + ridge.mean


def _chosen(known: np.ndarray, outputs: np.ndarray) -> tuple[float | None, float]:
    """Width and ridge by the squared error on every fifth example."""
    judged = np.arange(len(known)) % 5 == 4
    mean = outputs[~judged].mean(axis=0)
    usual = float(np.median(_squares(known, known))) or 1.0
    chosen: tuple[float | None, float] = (None, RIDGES[-1])
    best = np.inf
    for width in (None if share is None else share * usual for share in WIDTHS):
        kernel = _kernel(known, known, width)
        for ridge in RIDGES:
            try:
                weights = _solved(kernel[np.ix_(~judged, ~judged)], outputs[~judged] - mean, ridge)
            except linalg.LinAlgError:  # equal examples and next to no ridge
                continue
            error = float(np.mean((kernel[np.ix_(judged, ~judged)] @ weights + mean - outputs[judged]) ** 2))
            if error < best:
                best, chosen = error, (width, ridge)
    return chosen


def _solved(kernel: np.ndarray, outputs: np.ndarray, ridge: float) -> np.ndarray:
    ridged = kernel + ridge * np.eye(len(kernel))
    return linalg.cho_solve(linalg.cho_factor(ridged, lower=True), outputs)


def _kernel(one: np.ndarray, other: np.ndarray, width: float | None) -> np.ndarray:
    return one @ other.T if width is None else np.exp(-_squares(one, other) / width)


def _squares(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(N, M) squared distances of rows."""
    apart = np.sum(one**2, axis=1)[:, None] + np.sum(other**2, axis=1) - 2 * one @ other.T
    return np.maximum(apart, 0)
