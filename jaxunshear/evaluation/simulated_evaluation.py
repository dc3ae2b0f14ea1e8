"""Score the networks of a run on simulated contacts: held-out poses, and further tests."""

import dataclasses
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import cast

import numpy as np

from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.experiment import Experiment, list_further_tests
from jaxunshear.config.networks import DISENTANGLED
from jaxunshear.config.splits import SPLITS
from jaxunshear.config.targets import make_range_targets, read_true_values
from jaxunshear.data.generation import read_metadata
from jaxunshear.data.reader import open_set
from jaxunshear.data.sources import Examples
from jaxunshear.errors import UserError
from jaxunshear.evaluation.baselines import collect_training_taps
from jaxunshear.evaluation.contact_scores import (
    BATCH,
    FIELDS,
    QUALITY,
    ContactScores,
    Scorer,
    TestSet,
    score_test,
)
from jaxunshear.evaluation.detected_pins import DETECTED, detect_pairs
from jaxunshear.evaluation.measurements import BARS
from jaxunshear.evaluation.network_outputs import load_run
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
from jaxunshear.evaluation.score_files import SMOOTH, EvaluatedRun
from jaxunshear.metrics.pin_error import measure_pin_errors
from jaxunshear.models.modality import IMAGES, PINS, get_modality
from jaxunshear.perception.rest_positions import compute_rest_lattice
from jaxunshear.results.run import Counts, FurtherTest, ResultBar, Results, Tables
from jaxunshear.simulator.scene import NEAR_MM, TURN_DEG, has_one_edge
from jaxunshear.training.examples import open_examples

# contacts whose pins are detected (50 ms an image), and from which the montage is chosen
KEPT_CONTACTS = 72
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


def evaluate_simulation(experiment: Experiment, run_dir: Path, data_dir: Path) -> EvaluatedRun:
    """Score networks on the test split of the simulated pairs, and on further tests.

    Raises `UserError` if the test split is empty, or a network or a data set is missing or damaged.
    """
    paired = experiment.paired.get_simulated("this")
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
    elif modality is PINS and (detected := detect_pairs(pairs, lattice, FIELDS)):
        found_scores = score_test(scorer, detected.make_test(BATCH))
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

    Args:
        experiment: The run's.
        scores: Of the main test.
        further: Scores of further tests, by name.
        followed: What detection gave of the pins of further tests, by name.
    """
    paired, pose = experiment.paired.get_simulated("this"), cast(PoseData, experiment.pose)
    settings = list_further_tests(experiment) | {DETECTED: paired}
    size, images = paired.preprocess.size, len(scores.kept_rows)
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
        tests={
            name: _build_further_test(settings[name], test, followed.get(name))
            for name, test in further.items()
        },
        contact=summarise_contact_quality({name: scores.labels[name] for name in QUALITY}),
        counts=_count_contacts(paired, scores),
        bars={name: ResultBar(*bar) for name, bar in BARS.items()},
        seeds={
            "experiment": experiment.seed,
            "paired": paired.seed,
            "pose": pose.seed,
            "bootstrap": SEED,
        },
    )


def _count_contacts(paired: PairedData, scores: ContactScores) -> Counts:
    labels = scores.labels
    return Counts(
        test_poses=len(np.unique(scores.poses)),
        test_by_stimulus={
            name: int(np.sum(labels["stimulus"] == index))
            for index, name in enumerate(paired.names)
        },
        test_smooth=int(labels[SMOOTH].sum()) if SMOOTH in labels else None,
        pin_images=len(scores.kept_rows),
    )


def _build_further_test(
    settings: PairedData,
    scores: ContactScores,
    followed: Mapping[str, Mapping[str, float]] | None,
) -> FurtherTest:
    """Build the tables of a further test, with the settings of its data."""
    return FurtherTest(
        stimuli=settings.names,
        tap_depth_jitter_mm=settings.tap_depth_jitter_mm,
        ranges=dataclasses.asdict(settings.ranges),
        contacts=scores.total,
        followed=followed,
        **vars(_build_tables(settings, scores)),
    )


def _build_tables(settings: PairedData, contacts: ContactScores) -> Tables:
    """Build all tables of one test."""
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
