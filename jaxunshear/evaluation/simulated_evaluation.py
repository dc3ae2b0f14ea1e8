"""Score the networks of a run on simulated contacts: held-out poses, and further tests.

Networks over pins are given the simulator's true ones, and in a test of their own those that are
detected in the images, as on a real sensor: each image is tracked by itself, and unsheared pins are
compared with the tap's true ones.
"""

import dataclasses
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, cast

import numpy as np

from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.experiment import Experiment, list_further_tests
from jaxunshear.config.networks import DISENTANGLED
from jaxunshear.config.splits import SPLITS
from jaxunshear.config.targets import make_range_targets, read_true_values
from jaxunshear.data.reader import Batch, Reader
from jaxunshear.data.sources import Examples
from jaxunshear.data.stored_sets import open_set, read_metadata
from jaxunshear.errors import UserError
from jaxunshear.evaluation.contact_scores import (
    BATCH,
    FIELDS,
    QUALITY,
    ContactScores,
    Scorer,
    TestSet,
    score_test,
)
from jaxunshear.evaluation.evaluate import EvaluatedRun
from jaxunshear.evaluation.measurements import BARS
from jaxunshear.evaluation.network_outputs import collect_training_taps, load_run
from jaxunshear.evaluation.pose_estimators import (
    PIN_PLACES,
    PIXELS,
    RidgeEstimator,
    fit_estimators,
    score_detected_pins,
)
from jaxunshear.evaluation.result_tables import (
    SEED,
    build_tables,
    describe_run,
    describe_similarity,
    tabulate_by_size,
    tabulate_part,
)
from jaxunshear.evaluation.score import SMOOTH
from jaxunshear.metrics.errors import measure_pin_errors
from jaxunshear.models.modality import IMAGES, PINS, get_modality
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.perception.pin_tracking import track_images
from jaxunshear.results.run import Counts, FurtherTest, Results, Tables
from jaxunshear.selection import select_evenly
from jaxunshear.simulator.scene import NEAR_MM, TURN_DEG, has_one_edge
from jaxunshear.training.examples import open_examples

# contacts whose pins are detected (50 ms an image), and from which the montage is chosen
KEPT_CONTACTS = 72
DETECTED = "found"  # the name of the test with detected pins
MAX_PAIRS = 480  # slides of it, evenly chosen, each with its tap: some 15 ms an image
DETECTED_TAP = "seen_tap"
INPUTS = (*PINS.pair, DETECTED_TAP)  # the true tap, the detected slide and the detected tap
EDGE = "edge_deg"
METRIC_NOTES = {
    "pose_mae": "mean absolute error of a PoseNet trained on taps (sheared_learnt: on slides)",
    "pose_smooth": f"pose_mae of {EDGE} where the direction of the nearest edge turns by at most "
    f"{TURN_DEG:g} deg within {NEAR_MM:g} mm",
    "difference": "disentangled less this network, contact by contact",
    "pins": "root mean square distance of pins, by identity, from the tap's; mean over slides",
    "followed": "of test images: share whose pins were identified for sure, and how far these "
    "were from the true ones",
    "readers": "mean absolute error of kernel ridges that learnt from PoseNet's training taps: "
    "pixels: their images; pins: their true pins, to read those found, and known by name, in "
    "the images that pin_error is of",
}


class DetectedPairs(NamedTuple):
    """Test pairs in whose tap and slide all pins were identified."""

    # detected `sheared_pins` and DETECTED_TAP, NaN if a pin is missing; true `canonical_pins`
    pairs: Batch
    # by "tap" and "sheared": share of images, error of their pins, number of missing ones
    reported: dict[str, dict[str, float]]

    def make_test(self) -> TestSet:
        count = len(self.pairs[DETECTED_TAP])
        batches: list[Batch] = []
        for start in range(0, count, BATCH):
            rows = slice(start, start + BATCH)
            batches.append({name: values[rows] for name, values in self.pairs.items()})
        return TestSet(batches, count, INPUTS, title="evaluate found pins")


def evaluate_simulation(experiment: Experiment, run_dir: Path, data_dir: Path) -> EvaluatedRun:
    """Score networks on the test split of the simulated pairs, and on further tests.

    Raises `UserError` if the test split is empty, or a network or a data set is missing or damaged.
    """
    paired = experiment.paired.require_simulation("this")
    modality = get_modality(experiment)
    examples = open_examples(experiment, DISENTANGLED, data_dir, run_dir)
    pairs = examples.reader
    total = pairs.length("test")
    if not total:
        raise UserError(
            f"the test split in {data_dir} is empty: nothing to evaluate; raise paired.poses"
        )
    estimators = fit_estimators(experiment, data_dir, run_dir, (PIXELS, PIN_PLACES))
    scorer = _load_scorer(experiment, run_dir, examples, estimators)
    batches = pairs.split("test", BATCH, FIELDS)
    test = TestSet(batches, total, modality.pair, keep=KEPT_CONTACTS)
    scores = mark_smooth(score_test(scorer, test), paired)
    further = _score_further_tests(experiment, scorer, data_dir)
    lattice = compute_rest_lattice(experiment.sensor, paired.camera, paired.preprocess)
    followed = {}
    if modality is IMAGES and PIN_PLACES in estimators:
        labels = {name: value[scores.kept_rows] for name, value in scores.labels.items()}
        true = read_true_values(scorer.targets, labels)
        found = score_detected_pins(estimators[PIN_PLACES], lattice, scores.images, true)
        scores = scores._replace(estimates=found)
    elif modality is PINS and (detected := detect_pairs(pairs, lattice)):
        found_scores = score_test(scorer, detected.make_test())
        further[DETECTED] = mark_smooth(found_scores, paired)
        followed[DETECTED] = detected.reported
    results = build_simulated_results(experiment, scores, further, followed)
    stored = read_metadata(paired, experiment.sensor, data_dir)["counts"]
    counts = dataclasses.replace(
        results.counts,
        train=pairs.length("train"),
        validation=pairs.length("validation"),
        test=total,
        contacts=stored["contacts"],
        retried=stored["retried"],
        dropped=stored["dropped"],
        reader_taps={name: estimator.taps for name, estimator in estimators.items()},
    )
    results = dataclasses.replace(results, counts=counts)
    return EvaluatedRun(results, scores, further, paired.names)


def _load_scorer(
    experiment: Experiment,
    run_dir: Path,
    examples: Examples,
    estimators: Mapping[str, RidgeEstimator],
) -> Scorer:
    modality, taps = get_modality(experiment), None
    if modality is IMAGES:  # the baselines need them
        batches = examples.reader.split("train", BATCH, ("canonical", "stimulus", "pose_id"))
        taps = collect_training_taps(batches)
    run = load_run(run_dir, experiment.networks, modality, examples.pins, taps)
    # networks over images give no pins: these are detected in images afterwards
    own = PIN_PLACES if modality is PINS else PIXELS
    applied = {name: estimator for name, estimator in estimators.items() if name == own}
    return Scorer(run, examples.targets, applied)


def _score_further_tests(
    experiment: Experiment, scorer: Scorer, data_dir: Path
) -> dict[str, ContactScores]:
    """Score the data sets that are for tests alone, with all of their splits."""
    further = {}
    for name, settings in list_further_tests(experiment).items():
        reader = open_set(settings, data_dir, experiment.sensor)
        total = sum(reader.length(split) for split in SPLITS)
        batches = chain.from_iterable(reader.split(split, BATCH, FIELDS) for split in SPLITS)
        inputs = get_modality(experiment).pair
        test = TestSet(batches, total, inputs, title=f"evaluate {name}")
        further[name] = mark_smooth(score_test(scorer, test), settings)
    return further


def build_simulated_results(
    experiment: Experiment,
    scores: ContactScores,
    further: Mapping[str, ContactScores] = MappingProxyType({}),
    followed: Mapping[str, Mapping[str, Mapping[str, float]]] = MappingProxyType({}),
) -> Results:
    """Build the results that follow from the scores; the same scores give the same bits.

    By name of further tests, `further` are their scores, `followed` what detection gave of pins.
    """
    paired, pose = experiment.paired.require_simulation("this"), cast(PoseData, experiment.pose)
    size, images, labels = paired.preprocess.size, len(scores.kept_rows), scores.labels
    similarity = describe_similarity(size)
    metric = similarity | METRIC_NOTES
    metric["swap"] = f"{similarity['swap']} with its target"
    metric["pin_error"] = f"matched centroids of {images} images against the tap's true pins"
    targets = make_range_targets(experiment.targets, paired.ranges)
    return Results(
        **describe_run(experiment, scores, targets, _build_tables(paired, scores)),
        metric=metric,
        pin_error=measure_pin_errors(
            scores.images,
            scores.pins[PINS.canonical],
            scores.pins[PINS.sheared],
            paired.camera.mm_across / size,
        ),
        tests=_build_further_tests(experiment, further, followed),
        contact=summarise_contact_quality({name: labels[name] for name in QUALITY}),
        counts=Counts(
            test_poses=len(np.unique(scores.poses)),
            test_by_stimulus={
                name: int(np.sum(labels["stimulus"] == index))
                for index, name in enumerate(paired.names)
            },
            test_smooth=int(labels[SMOOTH].sum()) if SMOOTH in labels else None,
            pin_images=len(scores.kept_rows),
        ),
        bars=BARS,
        seeds={
            "experiment": experiment.seed,
            "paired": paired.seed,
            "pose": pose.seed,
            "bootstrap": SEED,
        },
    )


def _build_further_tests(
    experiment: Experiment,
    further: Mapping[str, ContactScores],
    followed: Mapping[str, Mapping[str, Mapping[str, float]]],
) -> dict[str, FurtherTest]:
    paired = experiment.paired.require_simulation("this")
    settings = list_further_tests(experiment) | {DETECTED: paired}
    tests = {}
    for name, scores in further.items():
        tests[name] = FurtherTest(
            stimuli=settings[name].names,
            tap_depth_jitter_mm=settings[name].tap_depth_jitter_mm,
            ranges=dataclasses.asdict(settings[name].ranges),
            contacts=scores.total,
            followed=followed.get(name),
            **vars(_build_tables(settings[name], scores)),
        )
    return tests


def _build_tables(settings: PairedData, contacts: ContactScores) -> Tables:
    scores, labels, ranges = contacts.scores, contacts.labels, settings.ranges
    pin_errors, edge_angles = {}, {}
    for name, score in scores.items():
        if name.startswith("pins/"):
            mean = float(np.mean(score, dtype=np.float64))
            pin_errors[name.removeprefix("pins/")] = {"rms_px": mean}
        elif name.startswith("pose/") and name.endswith(f"/{EDGE}"):
            edge_angles[name] = score
    smooth = None
    if edge_angles and SMOOTH in labels:
        smooth = tabulate_part(edge_angles, contacts.poses, labels[SMOOTH])
    return dataclasses.replace(
        build_tables(contacts, settings.names),
        pins=pin_errors,
        pose_by_depth=tabulate_by_size(
            contacts, labels["pose"][:, 3], ranges.depth_min_mm, ranges.depth_max_mm
        ),
        pose_smooth=smooth,
    )


def mark_smooth(contacts: ContactScores, settings: PairedData) -> ContactScores:
    """Add the label SMOOTH (N,): whether the nearest edge has one direction.

    Only there is the edge angle unambiguous.
    """
    labels = contacts.labels
    smooth = has_one_edge(settings.stimuli, labels["stimulus"], labels["pose"])
    return contacts._replace(labels=labels | {SMOOTH: smooth})


def summarise_contact_quality(fields: Mapping[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """Summarise what the simulator reports of its contacts, each field (N,)."""
    return {
        name: {
            "mean": float(np.mean(values, dtype=np.float64)),
            "median": float(np.median(values)),
            "p95": float(np.quantile(values, 0.95)),
            "max": float(np.max(values)),
        }
        for name, values in fields.items()
    }


def detect_pairs(reader: Reader, lattice: Lattice) -> DetectedPairs | None:
    """Detect the pins of test pairs; None if no pair is identified, as in images without pins."""
    rows = select_evenly(reader.length("test"), MAX_PAIRS)
    batch = reader.take("test", rows, FIELDS)
    reported: dict[str, dict[str, float]] = {}
    detected: dict[str, np.ndarray] = {}
    both_identified = np.ones(len(rows), bool)
    fields_by_kind = zip(("tap", "sheared"), IMAGES.pair, PINS.pair, strict=True)
    for kind, image_field, pin_field in fields_by_kind:
        motion, identified = track_images(lattice, batch[image_field][..., 0], independent=True)
        pins = (lattice.rest + motion).astype(np.float32)
        reported[kind] = _measure_detection(pins[identified], batch[pin_field][identified], rows)
        detected[kind] = pins
        both_identified &= identified
    if not both_identified.any():
        return None
    pairs = {name: values for name, values in batch.items() if name not in IMAGES.pair}
    pairs |= {PINS.sheared: detected["sheared"], DETECTED_TAP: detected["tap"]}
    return DetectedPairs(
        {name: values[both_identified] for name, values in pairs.items()}, reported
    )


def _measure_detection(
    detected: np.ndarray, true: np.ndarray, images: np.ndarray
) -> dict[str, float]:
    present = np.isfinite(detected).all(-1)
    squares = np.sum(np.square(detected - true), axis=-1)[present]
    return {
        "images": len(images),
        "followed": len(detected) / len(images),
        "rms_px": float(np.sqrt(squares.mean())) if len(squares) else float("nan"),
        "missing_per_image": float((~present).sum() / max(len(detected), 1)),
    }
