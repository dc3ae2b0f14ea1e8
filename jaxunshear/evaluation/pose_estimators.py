"""Pose estimators that are no neural networks: kernel ridge regression on pixels and on pins.

A network that a PoseNet supervises, and that another PoseNet evaluates, may exploit the weaknesses
of that architecture. These estimators share with PoseNet only the taps of its training split.

>>> estimator = fit_estimator(PIXELS, examples.reader, examples.targets)
>>> estimator.estimate(compute_pixel_features(images))["edge_mm"]

In simulation the estimator over pins learns from the true pins of taps, and is given the pins that
are detected in images.
"""

import warnings
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from sklearn.kernel_ridge import KernelRidge
from sklearn.metrics.pairwise import euclidean_distances
from sklearn.model_selection import GridSearchCV, PredefinedSplit

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import POSENET, UNSHEARING
from jaxunshear.config.targets import Targets, list_label_fields
from jaxunshear.data.reader import Reader
from jaxunshear.evaluation.score import Outputs, score_poses
from jaxunshear.models.modality import IMAGES, PINS, get_modality
from jaxunshear.models.posenet import scale_poses, unscale_outputs
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_tracking import measure_motions
from jaxunshear.selection import select_evenly
from jaxunshear.training.examples import open_examples

PIXELS, PIN_PLACES = "pixels", "pins"
MAX_TAPS = 3000  # training taps, evenly chosen
SIDE_PX = 32  # px to which images are averaged
MIN_EXAMPLES = 10
MAX_SEARCH_EXAMPLES = 1000  # by which kernel and ridge are chosen
WIDTHS = (0.25, 0.5, 1.0, 2.0)  # of a Gaussian, over the median square distance of two examples
RIDGES = (1e-10, 1e-6, 1e-4, 1e-3, 1e-2, 1e-1)

Poses = dict[str, np.ndarray]  # (B,) mm or deg by target


class Ridge(NamedTuple):
    """A fit to examples of F features and K outputs each."""

    feature_mean: np.ndarray  # (F,)
    scale: float
    model: KernelRidge  # of scaled features, and of outputs less their mean
    output_mean: np.ndarray  # (K,)

    def predict(self, features: np.ndarray) -> np.ndarray:
        """Predict (M, K) for features (M, F)."""
        scaled = (features.astype(np.float64) - self.feature_mean) / self.scale
        return self.model.predict(scaled) + self.output_mean


def fit_ridge(features: np.ndarray, outputs: np.ndarray) -> Ridge:
    """Fit outputs (N, K) to features (N, F) without NaN; the same examples give the same bits.

    Kernel and ridge are those that do best on every fifth example after a fit to the others.
    Raises ValueError if there are fewer than MIN_EXAMPLES.
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


def _search_model(features: np.ndarray, outputs: np.ndarray) -> KernelRidge:
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


class RidgeEstimator(NamedTuple):
    ridge: Ridge
    targets: Targets
    taps: int  # training taps

    def estimate(self, features: np.ndarray) -> Poses:
        """Estimate poses from features (B, F); those that are NaN count as their training mean."""
        filled = np.where(np.isfinite(features), features, self.ridge.feature_mean)
        poses = unscale_outputs(jnp.asarray(self.ridge.predict(filled)), self.targets)
        return {name: np.asarray(value) for name, value in poses.items()}


def compute_pixel_features(images: np.ndarray) -> np.ndarray:
    """Average images (B, S, S, 1) over squares: (B, F), SIDE_PX squares along each side."""
    images = np.asarray(images, np.float64)[..., 0] / (255 if images.dtype == np.uint8 else 1)
    cell = max(1, images.shape[1] // SIDE_PX)
    side = images.shape[1] // cell
    full = images[:, : side * cell, : side * cell].reshape(len(images), side, cell, side, cell)
    return full.mean(axis=(2, 4)).reshape(len(images), -1)


def compute_pin_features(pins: np.ndarray) -> np.ndarray:
    """Flatten pins (B, P, 2) px to (B, F), NaN where one is missing."""
    return np.asarray(pins, np.float64).reshape(len(pins), -1)


FEATURES = {PIXELS: compute_pixel_features, PIN_PLACES: compute_pin_features}
INPUT_FIELDS = {PIXELS: IMAGES.single, PIN_PLACES: PINS.single}  # of a tap


def fit_estimators(
    experiment: Experiment, data_dir: Path, run_dir: Path, of_images: Sequence[str]
) -> dict[str, RidgeEstimator]:
    """Fit estimators, by name, to the taps that the run's PoseNet learned from.

    There is none if the run has no PoseNet, or too few taps. `of_images` are those that the images
    of networks over images can be given to; images of networks over pins are drawn from the pins,
    and show nothing else.
    """
    if POSENET not in experiment.networks:
        return {}
    examples = open_examples(experiment, POSENET, data_dir, run_dir)
    names = (PIN_PLACES,) if get_modality(experiment) is PINS else of_images
    fits = {name: fit_estimator(name, examples.reader, examples.targets) for name in names}
    return {name: estimator for name, estimator in fits.items() if estimator is not None}


def fit_estimator(
    name: str, taps: Reader, targets: Targets, max_taps: int = MAX_TAPS
) -> RidgeEstimator | None:
    """Fit PIXELS or PIN_PLACES to training taps; None if there are too few."""
    rows = select_evenly(taps.length("train"), max_taps)
    batch = taps.take("train", rows, (INPUT_FIELDS[name], *list_label_fields(targets)))
    inputs = batch.pop(INPUT_FIELDS[name])
    return fit_to_features(FEATURES[name](inputs), batch, targets)


def fit_to_features(
    features: np.ndarray, labels: Mapping[str, np.ndarray], targets: Targets
) -> RidgeEstimator | None:
    """Fit poses to features (N, F) of contacts; None if there are too few contacts or no target.

    Features that are NaN count as their mean, and contacts without any feature are left out.
    `labels` are (N, columns) by field.
    """
    usable = np.isfinite(features).any(axis=1)
    features = features[usable]
    labels = {field: values[usable] for field, values in labels.items()}
    if len(features) < MIN_EXAMPLES or not targets:
        return None
    finite = np.isfinite(features)
    mean = np.where(finite, features, 0).sum(axis=0) / np.maximum(finite.sum(axis=0), 1)
    outputs = np.asarray(scale_poses(labels, targets))
    ridge = fit_ridge(np.where(finite, features, mean), outputs)
    return RidgeEstimator(ridge, targets, len(features))


def estimate_poses(name: str, estimator: RidgeEstimator, outputs: Outputs) -> dict[str, Poses]:
    """Estimate poses from the networks' outputs for a batch, by kind."""
    inputs = outputs.images if name == PIXELS else outputs.pins
    return {
        kind: estimator.estimate(FEATURES[name](np.asarray(inputs[kind])))
        for kind in _select_kinds(inputs)
    }


def _select_kinds(inputs: Container[str]) -> list[str]:
    return [kind for kind in ("tap", "sheared", *UNSHEARING) if kind in inputs]


def score_detected_pins(
    estimator: RidgeEstimator,
    lattice: Lattice,
    images: Mapping[str, np.ndarray],
    true: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Score the poses estimated from the pins that are detected in images (N, S, S) uint8.

    Errors (N,) are named `read/pins/<kind>/<quantity>`. They are NaN for images whose pins could
    not be identified.
    """
    errors: dict[str, np.ndarray] = {}
    for kind in _select_kinds(images):
        features = compute_pin_features(lattice.rest + measure_motions(lattice, images[kind]))
        poses = {kind: estimator.estimate(features)}
        for name, score in score_poses(poses, true, f"read/{PIN_PLACES}").items():
            errors[name] = np.where(np.isfinite(features[:, 0]), score, np.nan)
    return errors
