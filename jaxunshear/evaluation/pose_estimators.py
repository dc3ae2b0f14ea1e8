"""Pose estimators that are no neural networks: kernel ridge regression on pixels and on pins.

A network that a PoseNet supervises, and that another PoseNet evaluates, may exploit the weaknesses
of that architecture. These estimators share with PoseNet only the taps of its training split.

>>> estimator = fit_estimator(PIXELS, examples.reader, examples.targets)
>>> estimator.estimate(compute_pixel_features(images))["edge_mm"]

In simulation the estimator over pins learns from the true pins of taps, and is given the pins that
are detected in images.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import POSENET, UNSHEARING
from jaxunshear.config.targets import Targets, list_label_fields
from jaxunshear.data.reader import Reader
from jaxunshear.evaluation import kernel_ridge
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

Poses = dict[str, np.ndarray]  # (B,) mm or deg by target


class RidgeEstimator(NamedTuple):
    ridge: kernel_ridge.Ridge
    targets: Targets
    taps: int  # training taps

    def estimate(self, features: np.ndarray) -> Poses:
        """Estimate poses from features (B, F); those that are NaN count as their training mean."""
        filled = np.where(np.isfinite(features), features, self.ridge.feature_mean)
        outputs = jnp.asarray(kernel_ridge.predict(self.ridge, filled))
        poses = unscale_outputs(outputs, self.targets)
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
    input_field, label_fields = INPUT_FIELDS[name], list_label_fields(targets)
    batch = taps.take("train", rows, (input_field, *label_fields))
    labels = {field: batch[field] for field in label_fields}
    return fit_to_features(FEATURES[name](batch[input_field]), labels, targets)


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
    if len(features) < kernel_ridge.MIN_EXAMPLES or not targets:
        return None
    finite = np.isfinite(features)
    mean = np.where(finite, features, 0).sum(axis=0) / np.maximum(finite.sum(axis=0), 1)
    outputs = np.asarray(scale_poses(labels, targets))
    ridge = kernel_ridge.fit(np.where(finite, features, mean), outputs)
    return RidgeEstimator(ridge, targets, len(features))


def estimate_poses(name: str, estimator: RidgeEstimator, outputs: Outputs) -> dict[str, Poses]:
    """Estimate poses from the networks' outputs for a batch, by kind."""
    inputs = outputs.images if name == PIXELS else outputs.pins
    return {
        kind: estimator.estimate(FEATURES[name](np.asarray(inputs[kind])))
        for kind in ("tap", "sheared", *UNSHEARING)
        if kind in inputs
    }


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
    for kind in ("tap", "sheared", *UNSHEARING):
        if kind not in images:
            continue
        features = compute_pin_features(lattice.rest + measure_motions(lattice, images[kind]))
        poses = {kind: estimator.estimate(features)}
        for name, score in score_poses(poses, true, f"read/{PIN_PLACES}").items():
            errors[name] = np.where(np.isfinite(features[:, 0]), score, np.nan)
    return errors
