"""Score a finished run on recordings that it was not trained on: other days, other poses.

>>> recordings, data = Path("other_day"), Path("datasets")
>>> results = score_recordings(experiment, Path("runs/recorded"), recordings, data, command)
>>> results.pose_mae["unsheared"]["y_mm"]

The recordings are of the same sensor. All of them are scored, and nothing is fitted to them. Pins
are identified by their rest positions in the training taps.
"""

import shutil
import time
from dataclasses import replace
from pathlib import Path

from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment
from jaxunshear.data.digests import compute_digest
from jaxunshear.data.preprocessing import prepare_chunks
from jaxunshear.data.recorded_contacts import RecordedContacts, read_test_contacts
from jaxunshear.data.recorded_set import RecordedSet, UnstoredSet, parse_frame
from jaxunshear.errors import UserError
from jaxunshear.evaluation.conformal import compute_coverage
from jaxunshear.evaluation.measurements import round_values
from jaxunshear.evaluation.recorded_descriptions import describe_test
from jaxunshear.evaluation.recorded_results import build_results
from jaxunshear.evaluation.recorded_scores import (
    choose_test,
    collect_recorded_scores,
    list_pose_errors,
    load_recorded_run,
)
from jaxunshear.files import read_object
from jaxunshear.metrics.machine import describe_provenance
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import EVALUATE_REMEDY, FullTable, Results, Table
from jaxunshear.results.training_summaries import read_training_facts
from jaxunshear.training.checkpoint import check_finished, read_targets
from jaxunshear.training.examples import FRAME
from jaxunshear.training.initial_weights import check_unseen

POSE_ROWS = ("tap", "sheared", "unsheared", "sheared_learnt")


def score_recordings(
    experiment: Experiment, run_dir: Path, recordings: Path, data_dir: Path, command: str
) -> Results:
    """Score a run on other recordings; return results in the form of results.json.

    Raises UserError if the run is about simulated touches, has learned from these recordings, or
    nothing can be read or scored.
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
    settings = replace(
        settings, tap_folder=str(recordings), slide_folder=str(recordings), digest=digest, pairs=""
    )
    contacts = read_test_contacts(settings)
    folder = Path(data_dir) / ".partial" / f"unseen-{digest}"
    stored = _prepare_set(experiment, run_dir, contacts, settings, folder)
    targets = read_targets(run_dir / experiment.networks[-1])
    unseen = replace(experiment, paired=settings)
    test = choose_test(unseen, stored, targets, run_dir)
    run = load_recorded_run(unseen, run_dir, stored)
    scores = collect_recorded_scores(unseen, run, test, targets)
    results = build_results(unseen, stored, targets, scores, test)
    half_widths: FullTable = {}
    if (run_dir / "results.json").exists():
        run_results = read_record(run_dir / "results.json", Results, EVALUATE_REMEDY)
        half_widths = run_results.half_width or {}
    shutil.rmtree(folder, ignore_errors=True)
    return round_values(
        replace(
            results,
            half_width=half_widths,
            coverage=compute_coverage(half_widths, list_pose_errors(scores)),
            trained_in=run_dir.name,
            time_s={"evaluate": time.perf_counter() - started},
            **read_training_facts(run_dir, experiment.networks),
            **describe_provenance(command),
        )
    )


def _check_not_learned_from(
    experiment: Experiment, settings: Recorded, run_dir: Path, recordings: Path
) -> str:
    """Return the digest of recordings. Raises UserError if the run learned from them."""
    digest = compute_digest((str(recordings),))
    if digest == settings.digest:
        raise UserError(
            f"{recordings} is what {run_dir} learnt from: its held-out tenth is scored by "
            f"`jaxunshear evaluate {run_dir}`"
        )
    if _overlap(recordings, (settings.tap_folder, settings.slide_folder)):
        raise UserError(
            f"{recordings} shares its files with what {run_dir} learnt from: "
            "name recordings that it has not seen"
        )
    for network in experiment.networks:
        check_unseen(run_dir / network, [digest])
    return digest


def _overlap(recordings: Path, training_folders: tuple[str, ...]) -> bool:
    """Say whether recordings lie in a folder of the training, or contain one."""
    here = Path(recordings).resolve()
    for name in training_folders:
        if name and Path(name).is_dir():
            folder = Path(name).resolve()
            if here.is_relative_to(folder) or folder.is_relative_to(here):
                return True
    return False


def _prepare_set(
    experiment: Experiment,
    run_dir: Path,
    contacts: RecordedContacts,
    settings: Recorded,
    folder: Path,
) -> RecordedSet:
    """Prepare recordings as a set, with crop and rest positions of the run's own sensor."""
    stored_frame = read_object(run_dir / FRAME)
    frame = parse_frame(stored_frame)
    paths = prepare_chunks(contacts, settings, frame, folder, f"read {settings.slide_folder}")
    return RecordedSet(settings, UnstoredSet(contacts, paths, stored_frame))


def format_table(results: Results) -> str:
    """Format pose errors, PoseNet's and those of other estimators, for people."""
    names = [target.name for target in results.targets or ()]
    lines = _format_errors("error", results.pose_mae, names)
    recovery = results.pose_recovery.get("unsheared")
    if recovery:
        lines.append(_format_row("recovery", [recovery[name] for name in names], 2))
    for estimator, errors in results.readers.items():
        lines += _format_errors(f"reader {estimator}", errors, names)
    if results.coverage:
        lines.append(
            f"95 % half-widths of the run's own session, tried on {describe_test(results)}:"
        )
    for kind, shares in (results.coverage or {}).items():
        widths = (results.half_width or {})[kind]
        covered = [
            f"{name} {share:.1%} within {widths[name]:.3g}" for name, share in shares.items()
        ]
        lines.append(f"{kind}: {', '.join(covered)}")
    counts = results.counts
    lines.append(
        f"test, {describe_test(results)}: {counts.test_taps} taps, {counts.test_poses} slides; "
        f"left out: {counts.unread_taps or 0} taps and {counts.test_unsure or 0} slides "
        "were not understood"
    )
    return "\n".join(lines)


def _format_errors(title: str, errors: Table, names: list[str]) -> list[str]:
    lines = [f"{title:<16}" + "".join(f"{name:>10}" for name in names)]
    for kind in POSE_ROWS:
        if kind in errors:
            lines.append(_format_row(kind, [errors[kind][name] for name in names], 3))
    return lines


def _format_row(title: str, values: list[float | None], digits: int) -> str:
    figures = ["none" if value is None else f"{value:.{digits}f}" for value in values]
    return f"{title:<16}" + "".join(f"{figure:>10}" for figure in figures)
