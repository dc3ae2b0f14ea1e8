"""Evaluate networks that learned from recordings, on these recordings and on others.

>>> evaluate_recordings(experiment, Path("runs/recorded"), data)  # on their held-out part
>>> results = score_recordings(experiment, run_dir, Path("other_day"), data, command)
>>> results.pose_mae["unsheared"]["y_mm"]
"""

import dataclasses
import shutil
import time
from pathlib import Path

from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment
from jaxunshear.data.digests import compute_digest
from jaxunshear.data.preprocessing import prepare_chunks
from jaxunshear.data.recorded_contacts import read_test_contacts
from jaxunshear.data.recorded_set import RecordedSet, UnstoredSet, parse_frame
from jaxunshear.data.sources import open_source
from jaxunshear.errors import UserError
from jaxunshear.evaluation.conformal import compute_coverage, compute_half_widths
from jaxunshear.evaluation.pose_estimators import PIXELS, fit_estimators
from jaxunshear.evaluation.recorded_results import build_recorded_results
from jaxunshear.evaluation.recorded_scores import (
    choose_test,
    convert_montage_labels,
    load_scorer,
    score_contacts,
)
from jaxunshear.evaluation.result_tables import finish_results
from jaxunshear.evaluation.score_files import EvaluatedRun
from jaxunshear.files import read_object
from jaxunshear.models.modality import get_modality
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import EVALUATE_REMEDY, FullTable, Results
from jaxunshear.training.checkpoint import check_finished, read_targets
from jaxunshear.training.examples import FRAME
from jaxunshear.training.provenance import check_unseen


def evaluate_recordings(experiment: Experiment, run_dir: Path, data_dir: Path) -> EvaluatedRun:
    """Score networks on the test split of a recorded set, with conformal intervals.

    Raises `UserError` if nothing can be scored, or a network or the data set is missing or damaged.
    """
    stored = open_source(experiment).open_stored(data_dir)
    targets = stored.make_targets(experiment.targets)
    test = choose_test(experiment, stored, targets, run_dir, data_dir)
    scorer = load_scorer(experiment, run_dir, stored, targets)
    estimators = {}
    if stored.count_contacts("taps", "train"):
        # the pins in unsheared images of recordings have no identities
        estimators = fit_estimators(experiment, data_dir, run_dir, (PIXELS,))
    modality = get_modality(experiment)
    scores = score_contacts(scorer._replace(estimators=estimators), modality, test)
    results = build_recorded_results(experiment, stored, targets, scores, test)
    validation = score_contacts(scorer, modality, test, "validation")
    half_widths = compute_half_widths(validation.list_pose_errors())
    taps = {name: estimator.taps for name, estimator in estimators.items()}
    results = dataclasses.replace(
        results,
        half_width=half_widths,
        coverage=compute_coverage(half_widths, scores.list_pose_errors()),
        counts=dataclasses.replace(results.counts, reader_taps=taps),
    )
    if scores.slides is None:
        return EvaluatedRun(results, scores.taps, {}, ())
    further = {} if scores.taps is None else {"taps": scores.taps}
    montage_names = ("recorded",) if test.paired else ()
    return EvaluatedRun(results, convert_montage_labels(scores.slides), further, montage_names)


def score_recordings(
    experiment: Experiment, run_dir: Path, recordings: Path, data_dir: Path, command: str
) -> Results:
    """Score a run on other recordings of its sensor: other days, other poses.

    All contacts are scored, and nothing is fitted to them. Pins are identified by their rest
    positions in the training taps. Raises UserError if the run is about simulated touches, has
    learned from these recordings, or nothing can be read or scored.
    """
    settings = experiment.paired
    if not isinstance(settings, Recorded):
        raise UserError(
            f"{run_dir} learnt from simulated touches: score it with `jaxunshear evaluate`"
        )
    started = time.perf_counter()
    for network in experiment.networks:
        check_finished(run_dir / network)
    digest = _check_not_learned_from(experiment, settings, run_dir, recordings)
    settings = dataclasses.replace(
        settings, tap_folder=str(recordings), slide_folder=str(recordings), digest=digest, pairs=""
    )
    folder = Path(data_dir) / ".partial" / f"unseen-{digest}"
    stored = _prepare_set(run_dir, settings, folder)
    targets = read_targets(run_dir / experiment.networks[-1])
    unseen = dataclasses.replace(experiment, paired=settings)
    test = choose_test(unseen, stored, targets, run_dir)
    scorer = load_scorer(unseen, run_dir, stored, targets)
    scores = score_contacts(scorer, get_modality(unseen), test)
    results = build_recorded_results(unseen, stored, targets, scores, test)
    half_widths: FullTable = {}
    if (run_dir / "results.json").exists():
        run_results = read_record(run_dir / "results.json", Results, EVALUATE_REMEDY)
        half_widths = run_results.half_width or {}
    shutil.rmtree(folder, ignore_errors=True)
    results = dataclasses.replace(
        results,
        half_width=half_widths,
        coverage=compute_coverage(half_widths, scores.list_pose_errors()),
        trained_in=run_dir.name,
        time_s={"evaluate": time.perf_counter() - started},
    )
    return finish_results(results, experiment, run_dir, command)


def _check_not_learned_from(
    experiment: Experiment, settings: Recorded, run_dir: Path, recordings: Path
) -> str:
    """Return the digest of recordings. Raises UserError if the run learned from them."""
    digest, here = compute_digest((str(recordings),)), Path(recordings).resolve()
    names = (settings.tap_folder, settings.slide_folder)
    folders = [Path(name).resolve() for name in names if name and Path(name).is_dir()]
    overlap = any(here.is_relative_to(each) or each.is_relative_to(here) for each in folders)
    if digest == settings.digest or overlap:
        raise UserError(
            f"{recordings} shares its files with what {run_dir} learnt from: name recordings that "
            f"it has not seen; its held-out tenth is scored by `jaxunshear evaluate {run_dir}`"
        )
    for network in experiment.networks:
        check_unseen(run_dir / network, [digest])
    return digest


def _prepare_set(run_dir: Path, settings: Recorded, folder: Path) -> RecordedSet:
    """Prepare recordings as a set, with crop and rest positions of the run's own sensor."""
    contacts, stored_frame = read_test_contacts(settings), read_object(run_dir / FRAME)
    frame = parse_frame(stored_frame)
    paths = prepare_chunks(contacts, settings, frame, folder, f"read {settings.slide_folder}")
    return RecordedSet(settings, UnstoredSet(contacts, paths, stored_frame))
