"""Score networks that learned in simulation on recordings of an edge.

>>> results = score_transfer(experiment, Path("weights"), Path("recordings"), command)
>>> results.pose_mae["unsheared"]["Rz_deg"]

The labels are of taps on a straight edge. What a network predicts of them, edge distance, edge
angle and depth, has an offset and a sign of its own. Half of the recorded taps, drawn at random,
align predictions with labels by these two. The other half is scored, and every slide; nothing is
fitted to slides. Unsheared slides have an alignment of their own, by unsheared taps, because the
network moves all real taps a little and alike. With the alignment of taps as recorded, unsheared
slides are scored once more (`UNSHEARED_RAW_OFFSET`). For networks over pins, the rest positions are
the mean over some of the contacts themselves: of taps for taps, of slides for slides.

Networks over pins are also evaluated by kernel ridge regression, which learns the pose from the
pins of those same taps. It has nothing in common with the networks or with their simulator.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.targets import (
    MIN_VARIATION,
    RECORDED_FIELDS,
    Target,
    list_target_names,
    make_label_targets,
)
from jaxunshear.data.recorded_contacts import RecordedContacts, compute_digest, read_test_contacts
from jaxunshear.data.recordings import read_image
from jaxunshear.data.sensor_frame import MIN_FRAMES, find_sensor_frame, find_training_view
from jaxunshear.errors import UserError
from jaxunshear.evaluation.intervals import compute_recovery
from jaxunshear.evaluation.pose_estimators import PIN_PLACES, compute_pin_features, fit_to_features
from jaxunshear.evaluation.result_tables import combine_kinds, finish_results
from jaxunshear.inference.forward import AS_RECORDED, UNSHEARED
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.metrics.errors import compute_pose_errors
from jaxunshear.perception.preprocess import prepare_frame
from jaxunshear.progress import Progress
from jaxunshear.results.run import Counts, Results

BATCH = 32
SEED = 0  # of the taps that align predictions with labels
UNSHEARED_RAW_OFFSET = "unsheared_raw_zero"  # unsheared slides, aligned by taps as recorded
METRIC = {
    "pose_mae": "mean absolute error of a PoseNet that learnt from simulated taps, sign and offset "
    "of each reading by half of the recorded taps, which are unsheared where slides are; "
    f"{UNSHEARED_RAW_OFFSET}: by these taps as recorded",
    "pose_recovery": "(sheared - unsheared) / (sheared - tap)",
    "readers": "mean absolute error of a kernel ridge that learnt from the pins of half of the "
    "recorded taps",
}
LABEL_TARGETS = {  # the predicted quantity that belongs to a label
    "x_mm": "edge_mm",
    "y_mm": "edge_mm",
    "z_mm": "depth_mm",
    "Rz_deg": "edge_deg",
}
Errors = dict[str, float]  # mean absolute errors by label


class LabelAlignment(NamedTuple):
    """label = sign * predicted target + offset."""

    target: str
    sign: int
    offset: float

    def apply(self, poses: dict[str, np.ndarray]) -> np.ndarray:
        return self.sign * poses[self.target] + self.offset


class ContactPredictions(NamedTuple):
    """Predictions for N labelled contacts, from their images as recorded and unsheared.

    All predictions are NaN for a contact that the networks rejected.
    """

    labels: np.ndarray  # (N, 6)
    poses: dict[str, dict[str, np.ndarray]]  # (N,) by kind of image and quantity
    pins: dict[str, np.ndarray]  # (N, P, 2) px by kind of image, of networks over pins

    def select(self, rows: np.ndarray) -> "ContactPredictions":
        return jax.tree.map(lambda values: values[rows], self)

    @property
    def has_prediction(self) -> np.ndarray:
        """Which contacts (N,) have a prediction."""
        return np.isfinite(next(iter(self.poses[AS_RECORDED].values())))

    def select_pins(self, kind: str) -> tuple[np.ndarray, np.ndarray]:
        """Select features and labels of the contacts whose pins were identified."""
        identified = np.isfinite(self.pins[kind]).all(axis=(1, 2))
        return compute_pin_features(self.pins[kind][identified]), self.labels[identified]


class _Predictions(NamedTuple):
    """Predictions for the taps that align them with labels, for other taps, and for slides."""

    alignment_taps: ContactPredictions
    test_taps: ContactPredictions
    slides: ContactPredictions


def score_transfer(
    experiment: Experiment,
    model: Path,
    recordings: Path,
    command: str,
    network: TrainedModel | None = None,
) -> Results:
    """Score the networks at `model`, or `network`, on recordings of an edge.

    Returns results in the form of results.json. Raises UserError if the recordings hold no labelled
    taps and slides of one edge.
    """
    started = time.perf_counter()
    paired = experiment.paired.require_simulation("this")
    digest = compute_digest((str(recordings),))
    settings = Recorded(str(recordings), str(recordings), digest, preprocess=paired.preprocess)
    predictions = _predict_all(experiment, model, network, settings)
    labels = choose_scored_labels(
        predictions.alignment_taps.poses[AS_RECORDED], predictions.alignment_taps.labels
    )
    pose_mae = _score_networks(labels, predictions)
    recovery = combine_kinds(compute_recovery, pose_mae, ("unsheared", "sheared", "tap"))
    results = Results(
        experiment=experiment.name,
        trained_in=model.name,
        metric=METRIC,
        settings=asdict(experiment),
        pin_error={},
        test_data="other recordings",
        targets=tuple(Target(name, *RECORDED_FIELDS[name]) for name in labels),
        pose_mae=pose_mae,
        pose_recovery={"unsheared": recovery},
        readers=_score_ridge(labels, predictions),
        counts=_count_contacts(predictions),
        time_s={"evaluate": time.perf_counter() - started},
    )
    return finish_results(results, experiment, model, command)


def _predict_all(
    experiment: Experiment, model: Path, network: TrainedModel | None, settings: Recorded
) -> _Predictions:
    """Predict all labelled contacts. Raises UserError if there are too few, or no predictions."""
    contacts = read_test_contacts(settings)
    contacts = contacts.take(np.flatnonzero(np.isfinite(contacts.pose).all(axis=1)))
    # crop and rest positions are found in contacts of the training split: here in all of them
    contacts = contacts._replace(split=np.zeros(len(contacts.files), int))
    groups = {
        "taps": contacts.take(np.flatnonzero(~contacts.is_slide)),
        "slides": contacts.take(np.flatnonzero(contacts.is_slide)),
    }
    for kind, group in groups.items():
        if len(group.files) < MIN_FRAMES:
            raise UserError(
                f"{settings.slide_folder} holds {len(group.files)} labelled {kind}: "
                f"at least {MIN_FRAMES} are needed to score by"
            )
    predictions = {}
    for kind, group in groups.items():
        trained = network or TrainedModel(model, experiment)
        if network is None and trained.reads_pins:  # rest positions are found in the contacts
            trained.frame = find_sensor_frame(group, settings, experiment.sensor)
        predictions[kind] = predict_contacts(trained, group, f"read {kind}")
        if not predictions[kind].poses:
            raise UserError(
                f"{model} holds no trained PoseNet: what it reads off recordings is what is scored"
            )
    taps, slides = predictions["taps"], predictions["slides"]
    if UNSHEARED not in slides.poses:
        raise UserError(f"{model} holds no network that unshears and PoseNet beside it: train both")
    aligns = np.random.default_rng(SEED).random(len(taps.labels)) < 0.5
    return _Predictions(taps.select(aligns), taps.select(~aligns), slides)


def _score_networks(labels: Sequence[str], predictions: _Predictions) -> dict[str, Errors]:
    alignment_taps, taps, slides = predictions

    def align(kind: str) -> dict[str, LabelAlignment]:
        poses = alignment_taps.poses[kind]
        return {name: align_to_labels(name, poses, alignment_taps.labels) for name in labels}

    raw, unsheared = align(AS_RECORDED), align(UNSHEARED)
    return {
        "tap": _compute_network_errors(raw, taps, AS_RECORDED),
        "sheared": _compute_network_errors(raw, slides, AS_RECORDED),
        "unsheared": _compute_network_errors(unsheared, slides, UNSHEARED),
        UNSHEARED_RAW_OFFSET: _compute_network_errors(raw, slides, UNSHEARED),
    }


def _compute_network_errors(
    alignments: dict[str, LabelAlignment], contacts: ContactPredictions, kind: str
) -> Errors:
    accepted = contacts.has_prediction
    poses = {name: values[accepted] for name, values in contacts.poses[kind].items()}
    aligned = {name: alignment.apply(poses) for name, alignment in alignments.items()}
    return _compute_mean_errors(aligned, contacts.labels[accepted])


def _score_ridge(labels: Sequence[str], predictions: _Predictions) -> dict[str, dict[str, Errors]]:
    """Compute the errors of kernel ridge regression over pins, by kind of contact.

    Empty for networks over images, or if there are too few taps to learn from.
    """
    alignment_taps, taps, slides = predictions
    if not alignment_taps.pins:
        return {}
    features, poses = alignment_taps.select_pins(AS_RECORDED)
    estimator = fit_to_features(features, {"pose": poses}, make_label_targets(labels, poses))
    if estimator is None:
        return {}
    errors = {}
    for name, contacts, kind in (
        ("tap", taps, AS_RECORDED),
        ("sheared", slides, AS_RECORDED),
        ("unsheared", slides, UNSHEARED),
    ):
        features, poses = contacts.select_pins(kind)
        estimates = dict.fromkeys(list_target_names(estimator.targets), np.zeros(0))
        if len(features):
            estimates = estimator.estimate(features)
        errors[name] = _compute_mean_errors(estimates, poses)
    return {PIN_PLACES: errors}


def _compute_mean_errors(poses: dict[str, np.ndarray], labels: np.ndarray) -> Errors:
    if not len(labels):
        return dict.fromkeys(poses, float("nan"))
    true = {name: get_label(name, labels) for name in poses}
    return {name: float(error.mean()) for name, error in compute_pose_errors(poses, true).items()}


def _count_contacts(predictions: _Predictions) -> Counts:
    accepted, rejected = [], []
    for contacts in predictions:
        accepted.append(int(contacts.has_prediction.sum()))
        rejected.append(len(contacts.labels) - accepted[-1])
    return Counts(
        known_taps=accepted[0],
        test_taps=accepted[1],
        test_poses=accepted[2],
        unread_taps=rejected[0] + rejected[1],
        test_unsure=rejected[2],
    )


def predict_contacts(
    network: TrainedModel, contacts: RecordedContacts, title: str
) -> ContactPredictions:
    """Predict poses and pins of all contacts, a batch at a time."""
    preprocess = network.preprocess
    view = network.view or find_training_view(contacts, preprocess)
    count = len(contacts.files)
    batches = []
    with Progress(title, count, "frames") as progress:
        for start in range(0, count, BATCH):
            files = contacts.files[start : start + BATCH]
            # frames that cannot be read stay black, which networks reject
            images = np.zeros((BATCH, preprocess.size, preprocess.size), np.uint8)
            for index, file in enumerate(files):
                with suppress(UserError):
                    images[index] = prepare_frame(preprocess, read_image(file), view)
            predictions = network.predict(images)
            batches.append((predictions.poses, predictions.pins))
            progress.advance(len(files))

    def join(*parts: np.ndarray) -> np.ndarray:
        return np.concatenate(parts, dtype=np.float64)[:count]

    return ContactPredictions(contacts.pose, *jax.tree.map(join, *batches))


def choose_scored_labels(poses: dict[str, np.ndarray], labels: np.ndarray) -> tuple[str, ...]:
    """Choose the labels (N, 6) that vary and that a predicted quantity (N,) belongs to.

    Raises UserError if none does, or if both x and y vary: along an edge the pose is not defined.
    """
    names = []
    for name, target in LABEL_TARGETS.items():
        if target in poses and np.ptp(get_label(name, labels)) > MIN_VARIATION:
            names.append(name)
    if not names or {"x_mm", "y_mm"} <= set(names):
        raise UserError(
            "these labels are not of a straight edge, across which x or y varies: "
            "only such can be scored"
        )
    return tuple(names)


def get_label(name: str, labels: np.ndarray) -> np.ndarray:
    """Return one label (N,) of labels (N, 6)."""
    _, column = RECORDED_FIELDS[name]
    return labels[:, column]


def align_to_labels(name: str, poses: dict[str, np.ndarray], labels: np.ndarray) -> LabelAlignment:
    """Find the sign with the least scatter of one label, and the offset.

    The offset is the median of the differences, or the mean direction of an angle's. `poses` (N,)
    are NaN for taps without a prediction. Raises UserError if all are.
    """
    target = LABEL_TARGETS[name]
    predicted, label = poses[target], get_label(name, labels)
    finite = np.isfinite(predicted)
    if not finite.any():
        raise UserError("no tap could be read: these are not images of the model's sensor")
    candidates = []
    for sign in (1, -1):
        offsets = label[finite] - sign * predicted[finite]
        if name.endswith("_deg"):
            mean = np.mean(np.exp(1j * np.radians(offsets)))
            scatter, offset = 1 - abs(mean), float(np.degrees(np.angle(mean)))
        else:
            scatter, offset = float(np.std(offsets)), float(np.median(offsets))
        candidates.append((scatter, LabelAlignment(target, sign, offset)))
    _, best = min(candidates, key=lambda candidate: candidate[0])
    return best
