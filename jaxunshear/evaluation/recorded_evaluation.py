"""Score the networks of a run on the recorded contacts that were kept out of their training."""

import dataclasses
from pathlib import Path

from jaxunshear.config.experiment import Experiment
from jaxunshear.data.sources import open_source
from jaxunshear.evaluation.conformal import compute_coverage, compute_half_widths
from jaxunshear.evaluation.pose_estimators import fit_estimators, make_batch_estimators
from jaxunshear.evaluation.recorded_results import build_results
from jaxunshear.evaluation.recorded_scores import (
    choose_test,
    collect_recorded_scores,
    convert_montage_labels,
    list_pose_errors,
    load_recorded_run,
)
from jaxunshear.evaluation.score_files import EvaluatedRun


def evaluate_recorded(experiment: Experiment, run_dir: Path, data_dir: Path) -> EvaluatedRun:
    """Score networks on the test split of a recorded set, with conformal intervals.

    Raises `UserError` if nothing can be scored, or a network or the data set is missing or damaged.
    """
    stored = open_source(experiment).open_stored(data_dir)
    targets = stored.make_targets(experiment.targets)
    test = choose_test(experiment, stored, targets, run_dir, data_dir)
    estimators = {}
    if stored.count_contacts("taps", "train"):
        estimators = fit_estimators(experiment, data_dir, run_dir)
    run = load_recorded_run(experiment, run_dir, stored)
    scores = collect_recorded_scores(
        experiment, run, test, targets, make_batch_estimators(estimators)
    )
    results = build_results(experiment, stored, targets, scores, test)
    validation = collect_recorded_scores(experiment, run, test, targets, split="validation")
    half_widths = compute_half_widths(list_pose_errors(validation))
    taps = {name: estimator.taps for name, estimator in estimators.items()}
    results = dataclasses.replace(
        results,
        half_width=half_widths,
        coverage=compute_coverage(half_widths, list_pose_errors(scores)),
        counts=dataclasses.replace(results.counts, reader_taps=taps),
    )
    if scores.slides is None:
        return EvaluatedRun(results, scores.taps, {}, ())
    further = {} if scores.taps is None else {"taps": scores.taps}
    montage_names = ("recorded",) if test.paired else ()
    return EvaluatedRun(results, convert_montage_labels(scores.slides), further, montage_names)
