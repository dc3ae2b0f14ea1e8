"""A finished run scored on recordings that it has never seen: other days, other poses, of the same sensor.

>>> results = score_recordings(experiment, Path("runs/recorded"), Path("other_day"), Path("datasets"), command)
>>> results.pose_mae["unsheared"]["y_mm"]

All of them are scored; nothing is fitted to them. Pins are identified by the untouched ones of the training taps.
"""

import shutil
import time
from dataclasses import replace
from pathlib import Path

from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment, get_recorded
from jaxunshear.data.digests import compute_digest
from jaxunshear.data.preprocessing import prepare_chunks
from jaxunshear.data.recorded_contacts import RecordedContacts, read_test_contacts
from jaxunshear.data.recorded_set import RecordedSet, UnstoredSet, parse_frame
from jaxunshear.errors import UserError
from jaxunshear.evaluation import recorded_evaluation
from jaxunshear.evaluation.conformal import compute_coverage
from jaxunshear.evaluation.measurements import round_values
from jaxunshear.evaluation.recorded_descriptions import describe_test
from jaxunshear.files import read_object
from jaxunshear.metrics.machine import describe_provenance
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import EVALUATE_REMEDY, FullTable, Results, Table
from jaxunshear.results.training_summaries import read_training_facts
from jaxunshear.training.checkpoint import check_finished, read_targets
from jaxunshear.training.examples import FRAME
from jaxunshear.training.initial_weights import check_unseen


def score_recordings(
    experiment: Experiment, run_dir: Path, recordings: Path, data_dir: Path, command: str
) -> Results:
    """Results in the form of results.json. Raises UserError where the run is about simulated touches, or nothing can be read or scored."""
    settings = get_recorded(experiment)
    if settings is None:
        raise UserError(
            f"{run_dir} learnt from simulated touches: score it with `jaxunshear evaluate`"
        )
    started = time.perf_counter()
    for network in experiment.networks:
        check_finished(run_dir / network)
    digest = compute_digest((str(recordings),))
    if digest == settings.digest:
        raise UserError(
            f"{recordings} is what {run_dir} learnt from: its held-out tenth is scored by `jaxunshear evaluate {run_dir}`"
        )
    if _was_learnt_from(recordings, (settings.tap_folder, settings.slide_folder)):
        raise UserError(
            f"{recordings} shares its files with what {run_dir} learnt from: name recordings that it has not seen"
        )
    settings = replace(
        settings, tap_folder=str(recordings), slide_folder=str(recordings), digest=digest, pairs=""
    )
    for network in experiment.networks:
        check_unseen(run_dir / network, [digest])
    contacts = read_test_contacts(settings)
    folder = Path(data_dir) / ".partial" / f"unseen-{digest}"
    stored = _prepare_set(experiment, run_dir, contacts, settings, folder)
    targets = read_targets(run_dir / experiment.networks[-1])
    unseen = replace(experiment, paired=settings)
    test = recorded_evaluation.choose_test(unseen, stored, targets, run_dir)
    run = recorded_evaluation.load_recorded_run(unseen, run_dir, stored)
    slides, taps = recorded_evaluation.collect_recorded_scores(unseen, run, test, targets)
    results = recorded_evaluation.build_results(unseen, stored, targets, slides, taps, test)
    widths: FullTable = {}
    if (run_dir / "results.json").exists():
        widths = read_record(run_dir / "results.json", Results, EVALUATE_REMEDY).half_width or {}
    shutil.rmtree(folder, ignore_errors=True)
    return round_values(
        replace(
            results,
            half_width=widths,
            coverage=compute_coverage(widths, recorded_evaluation.list_pose_errors(slides, taps)),
            trained_in=run_dir.name,
            time_s={"evaluate": time.perf_counter() - started},
            **read_training_facts(run_dir, experiment.networks),
            **describe_provenance(command),
        )
    )


def _was_learnt_from(recordings: Path, folders: tuple[str, ...]) -> bool:
    """Whether they lie in one of the folders that were learnt from, or hold one."""
    here = Path(recordings).resolve()
    there = [Path(folder).resolve() for folder in folders if folder and Path(folder).is_dir()]
    return any(here.is_relative_to(folder) or folder.is_relative_to(here) for folder in there)


def _prepare_set(
    experiment: Experiment,
    run_dir: Path,
    contacts: RecordedContacts,
    settings: Recorded,
    folder: Path,
) -> RecordedSet:
    """The recordings as a set, seen as the run's sensor sees."""
    known = read_object(run_dir / FRAME)
    frame = parse_frame(known)
    paths = prepare_chunks(contacts, settings, frame, folder, f"read {settings.slide_folder}")
    return RecordedSet(settings, UnstoredSet(contacts, paths, known))


def format_table(results: Results) -> str:
    """What a person wants to know at once: errors of pose by what was read, PoseNet's and, where there are others, theirs."""
    names = [target.name for target in results.targets or ()]
    lines = _errors("error", results.pose_mae, names)
    recovery = results.pose_recovery.get("unsheared")
    if recovery:
        lines.append(f"{'recovery':<16}" + "".join(_figure(recovery[name], 2) for name in names))
    for reader, errors in results.readers.items():
        lines += _errors(f"reader {reader}", errors, names)
    if results.coverage:
        lines.append(
            f"95 % half-widths of the run's own session, tried on {describe_test(results)}:"
        )
    for way, shares in (results.coverage or {}).items():
        widths = (results.half_width or {})[way]
        lines.append(
            f"{way}: {', '.join(f'{name} {share:.1%} within {widths[name]:.3g}' for name, share in shares.items())}"
        )
    counts = results.counts
    left_out = (
        f"{counts.unread_taps or 0} taps and {counts.test_unsure or 0} slides were not understood"
    )
    tested = f"{counts.test_taps} taps, {counts.test_poses} slides"
    lines.append(f"test, {describe_test(results)}: {tested}; left out: {left_out}")
    return "\n".join(lines)


def _errors(reported: str, errors: Table, names: list[str]) -> list[str]:
    ways = [way for way in ("tap", "sheared", "unsheared", "sheared_learnt") if way in errors]
    rows = [f"{way:<16}" + "".join(_figure(errors[way][name], 3) for name in names) for way in ways]
    return [f"{reported:<16}" + "".join(f"{name:>10}" for name in names), *rows]


def _figure(value: float | None, digits: int) -> str:
    return f"{'none' if value is None else f'{value:.{digits}f}':>10}"
