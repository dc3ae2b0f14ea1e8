"""Readers of poses that are no neural networks: kernel ridge on pixels, and on pins.

A network that is taught by a PoseNet, and judged by one of its make, might please the make. These have nothing in common with it but
the taps that they learn from, those of PoseNet's training split.

>>> reader = fit_estimator(PIXELS, examples.reader, examples.targets)
>>> estimate_poses(reader, compute_pixel_features(images))["edge_mm"]

In simulation the one on pins learns from the taps' true pins, and reads those that are found in images.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxunshear.config.experiment import Experiment, get_recorded, uses_pins
from jaxunshear.config.registry import POSENET, UNSHEARING
from jaxunshear.config.targets import Targets, list_label_fields
from jaxunshear.data.reader import Reader
from jaxunshear.evaluation.kernel_ridge import FEWEST, Ridge, answers, fitted
from jaxunshear.evaluation.score import Outputs, score_poses
from jaxunshear.models.posenet import scale_poses, unscale_outputs
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_tracking import measure_motions
from jaxunshear.selection import select_evenly
from jaxunshear.training.examples import open_examples

PIXELS, PIN_PLACES = "pixels", "pins"
MAX_TAPS = 3000  # are learnt from, evenly chosen
SIDE_PX = 32  # px to which images are averaged
ESTIMATED_KINDS = ("tap", "sheared", *UNSHEARING)  # kinds of contacts
INPUT_FIELDS = {PIXELS: "image", PIN_PLACES: "pins"}  # of a tap


class RidgeEstimator(NamedTuple):
    ridge: Ridge
    targets: Targets
    taps: int  # that it learnt from


Poses = dict[str, np.ndarray]  # (B,) mm or deg by target
BatchEstimator = Callable[[Outputs], dict[str, Poses]]  # of a batch, by kind


def compute_pixel_features(images: np.ndarray) -> np.ndarray:
    """(B, F) of images (B, S, S, 1): means over squares, SIDE along each side or as many as there are pixels."""
    images = np.asarray(images, np.float64)[..., 0] / (255 if images.dtype == np.uint8 else 1)
    cell = max(1, images.shape[1] // SIDE_PX)
    side = images.shape[1] // cell
    full = images[:, : side * cell, : side * cell].reshape(len(images), side, cell, side, cell)
    return full.mean(axis=(2, 4)).reshape(len(images), -1)


def compute_pin_features(pins: np.ndarray) -> np.ndarray:
    """(B, F) of pins (B, P, 2) px, NaN where one is not seen."""
    return np.asarray(pins, np.float64).reshape(len(pins), -1)


FEATURES = {PIXELS: compute_pixel_features, PIN_PLACES: compute_pin_features}


def fit_estimator(
    name: str, taps: Reader, targets: Targets, max_taps: int = MAX_TAPS
) -> RidgeEstimator | None:
    """PIXELS or PIN_PLACES from training taps alone, at most so many; None where there are too few."""
    rows = select_evenly(taps.length("train"), max_taps)
    fields = list_label_fields(targets)
    batch = taps.take("train", rows, (INPUT_FIELDS[name], *fields))
    return fit_to_features(
        FEATURES[name](batch[INPUT_FIELDS[name]]),
        {field: batch[field] for field in fields},
        targets,
    )


def fit_to_features(
    features: np.ndarray, labels: Mapping[str, np.ndarray], targets: Targets
) -> RidgeEstimator | None:
    """From features (N, F), NaN where nothing is seen, and the labels by field, (N, columns) each; None where there are too few. What
    shows nothing at all is not learnt from."""
    some = np.isfinite(features).any(axis=1)
    features, labels = features[some], {field: values[some] for field, values in labels.items()}
    if len(features) < FEWEST or not targets:
        return None
    seen = np.isfinite(features)
    mean = np.where(seen, features, 0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    outputs = np.asarray(scale_poses(labels, targets))
    return RidgeEstimator(fitted(np.where(seen, features, mean), outputs), targets, len(features))


def estimate_poses(reader: RidgeEstimator, features: np.ndarray) -> Poses:
    """Poses by features (B, F); what is not seen counts as it is on average."""
    found = answers(reader.ridge, np.where(np.isfinite(features), features, reader.ridge.middle))
    return {
        name: np.asarray(value)
        for name, value in unscale_outputs(jnp.asarray(found), reader.targets).items()
    }


def fit_estimators(
    experiment: Experiment, data_dir: Path, run_dir: Path
) -> dict[str, RidgeEstimator]:
    """By name, from the taps that the run's PoseNet learnt from: none where it has no PoseNet, or too few taps. Networks over pins have
    no images but drawn ones; what networks over recorded images draw has no pins known by name."""
    if POSENET not in experiment.networks:
        return {}
    examples = open_examples(experiment, POSENET, data_dir, run_dir)
    images = not uses_pins(experiment)
    names = [PIXELS] * images + [PIN_PLACES] * (not images or get_recorded(experiment) is None)
    found = {name: fit_estimator(name, examples.reader, examples.targets) for name in names}
    return {name: reader for name, reader in found.items() if reader}


def make_batch_estimators(readers: Mapping[str, RidgeEstimator]) -> dict[str, BatchEstimator]:
    """The same readers as functions of what the networks make of a batch: of its images or of its pins."""
    return {name: partial(_read_batch, name, reader) for name, reader in readers.items()}


def _read_batch(name: str, reader: RidgeEstimator, outputs: Outputs) -> dict[str, Poses]:
    seen = outputs.images if name == PIXELS else outputs.pins
    return {
        kind: estimate_poses(reader, FEATURES[name](np.asarray(seen[kind])))
        for kind in ESTIMATED_KINDS
        if kind in seen
    }


def score_detected_pins(
    reader: RidgeEstimator,
    lattice: Lattice,
    images: Mapping[str, np.ndarray],
    true: Mapping[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Errors (N,) by `estimate_poses/pins/<kind>/<quantity>` of the poses that pins found in images (N, S, S) uint8 give; NaN of images whose pins
    are not identified for sure."""
    errors: dict[str, np.ndarray] = {}
    for kind in (kind for kind in ESTIMATED_KINDS if kind in images):
        found = compute_pin_features(lattice.rest + measure_motions(lattice, images[kind]))
        scores = score_poses({kind: estimate_poses(reader, found)}, true, f"read/{PIN_PLACES}")
        errors |= {
            name: np.where(np.isfinite(found[:, 0]), score, np.nan)
            for name, score in scores.items()
        }
    return errors
