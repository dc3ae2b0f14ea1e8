"""Score the networks of a run on simulated contacts: held-out poses, and further tests."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import chain
from pathlib import Path

from jaxunshear.config.data import PairedData
from jaxunshear.config.experiment import (
    Experiment,
    list_further_tests,
    require_simulated,
    uses_pins,
)
from jaxunshear.config.registry import DISENTANGLED
from jaxunshear.config.splits import SPLITS
from jaxunshear.config.targets import read_true_values
from jaxunshear.data.generation import read_metadata
from jaxunshear.data.reader import Reader, open_set
from jaxunshear.errors import UserError
from jaxunshear.evaluation.baselines import collect_training_taps
from jaxunshear.evaluation.detected_pins import (
    DETECTED,
    INPUTS,
    DetectedPairs,
    detect_pairs,
    iterate_batches,
)
from jaxunshear.evaluation.network_outputs import Run, load_run
from jaxunshear.evaluation.pose_estimators import (
    PIN_PLACES,
    PIXELS,
    RidgeEstimator,
    fit_estimators,
    make_batch_estimators,
    score_detected_pins,
)
from jaxunshear.evaluation.score_collection import (
    BATCH,
    FIELDS,
    CollectedScores,
    Scorer,
    collect_scores,
)
from jaxunshear.evaluation.score_files import EvaluatedRun
from jaxunshear.evaluation.simulated_results import build_results
from jaxunshear.evaluation.unambiguous_edges import mark_smooth
from jaxunshear.models.modality import get_modality
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.rest_positions import compute_rest_lattice
from jaxunshear.results.run import Results
from jaxunshear.training.examples import Examples, open_examples

# contacts whose pins are detected (50 ms an image), and from which the montage is chosen
KEPT_CONTACTS = 72


def evaluate_simulated(experiment: Experiment, run_dir: Path, data_dir: Path) -> EvaluatedRun:
    """Score networks on the test split of the simulated pairs, and on further tests.

    Raises `UserError` if the test split is empty, or a network or a data set is missing or damaged.
    """
    paired, _ = require_simulated(experiment, "this")
    examples = open_examples(experiment, DISENTANGLED, data_dir, run_dir)
    pairs = examples.reader
    total = pairs.length("test")
    if not total:
        raise UserError(
            f"the test split in {data_dir} is empty: nothing to evaluate; raise paired.poses"
        )
    run = _load_networks(experiment, run_dir, examples)
    estimators = fit_estimators(experiment, data_dir, run_dir)
    scorer = _make_scorer(experiment, run, examples, estimators)
    lattice = compute_rest_lattice(experiment.sensor, paired.camera, paired.preprocess)
    scores = collect_scores(scorer, pairs.split("test", BATCH, FIELDS), total, KEPT_CONTACTS)
    scores = mark_smooth(scores, paired)
    further = _score_further_tests(experiment, scorer, data_dir)
    detected = None
    if uses_pins(experiment):
        detected = detect_pairs(pairs, lattice, FIELDS)
    elif PIN_PLACES in estimators:
        scores = _add_pin_estimates(scores, estimators[PIN_PLACES], lattice, scorer)
    if detected is not None:
        further[DETECTED] = _score_detected_pairs(scorer, detected, paired)
    results = build_results(experiment, scores, further)
    if detected is not None:
        test = replace(results.tests[DETECTED], followed=detected.reported)
        results = replace(results, tests={**results.tests, DETECTED: test})
    stored = read_metadata(paired, experiment.sensor, data_dir)["counts"]
    results = _add_counts(results, pairs, stored, estimators)
    return EvaluatedRun(results, scores, further, paired.names)


def _load_networks(experiment: Experiment, run_dir: Path, examples: Examples) -> Run:
    """Load the networks; over images the baselines, which need training taps, run with them."""
    if uses_pins(experiment):
        return load_run(run_dir, experiment.networks, pins=examples.pins)
    fields = ("canonical", "stimulus", "pose_id")
    taps = collect_training_taps(examples.reader.split("train", BATCH, fields))
    return load_run(run_dir, experiment.networks, taps)


def _make_scorer(
    experiment: Experiment,
    run: Run,
    examples: Examples,
    estimators: Mapping[str, RidgeEstimator],
) -> Scorer:
    """Make the scorer of all tests, with the estimators that can read the networks' outputs.

    Networks over images have no pins among their outputs: these are detected in images afterwards.
    """
    modality = get_modality(experiment)
    applicable = PIN_PLACES if uses_pins(experiment) else PIXELS
    selected = {name: value for name, value in estimators.items() if name == applicable}
    return Scorer(
        run,
        examples.targets,
        modality.pair,
        estimators=make_batch_estimators(selected),
    )


def _score_further_tests(
    experiment: Experiment, scorer: Scorer, data_dir: Path
) -> dict[str, CollectedScores]:
    """Score the data sets that are for tests alone, with all of their splits."""
    further = {}
    for name, settings in list_further_tests(experiment).items():
        reader = open_set(settings, data_dir, experiment.sensor)
        count = sum(reader.length(split) for split in SPLITS)
        batches = chain.from_iterable(reader.split(split, BATCH, FIELDS) for split in SPLITS)
        scores = collect_scores(scorer, batches, count, title=f"evaluate {name}")
        further[name] = mark_smooth(scores, settings)
    return further


def _add_pin_estimates(
    scores: CollectedScores, estimator: RidgeEstimator, lattice: Lattice, scorer: Scorer
) -> CollectedScores:
    """Add the errors of poses that are estimated from pins detected in the kept images."""
    labels = read_true_values(scorer.targets, scores.labels)
    true = {name: value[scores.kept_rows] for name, value in labels.items()}
    estimates = score_detected_pins(estimator, lattice, scores.images, true)
    return scores._replace(estimates=estimates)


def _score_detected_pairs(
    scorer: Scorer, detected: DetectedPairs, paired: PairedData
) -> CollectedScores:
    """Score networks over pins on pins that are detected in the test images."""
    scores = collect_scores(
        scorer._replace(inputs=INPUTS),
        iterate_batches(detected, BATCH),
        len(detected.pairs["pose"]),
        title="evaluate found pins",
    )
    return mark_smooth(scores, paired)


def _add_counts(
    results: Results,
    pairs: Reader,
    stored: Mapping[str, int],
    estimators: Mapping[str, RidgeEstimator],
) -> Results:
    counts = replace(
        results.counts,
        train=pairs.length("train"),
        validation=pairs.length("validation"),
        test=pairs.length("test"),
        contacts=stored["contacts"],
        retried=stored["retried"],
        dropped=stored["dropped"],
        reader_taps={name: estimator.taps for name, estimator in estimators.items()},
    )
    return replace(results, counts=counts)
