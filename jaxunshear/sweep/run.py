"""A full sweep: data sets, rows and summary. The same command continues where a sweep stopped."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from jaxunshear.cluster import Call, CallRunner, WorkerDied, run_locally
from jaxunshear.config.network_config import list_trained_networks
from jaxunshear.config.sweep import Sweep
from jaxunshear.errors import UserError
from jaxunshear.files import hold_lock, write_bytes
from jaxunshear.progress import Progress
from jaxunshear.report.sweep_figures import plot_frontier, plot_sweep
from jaxunshear.results.record_files import write_record
from jaxunshear.results.sweep import SweepResult
from jaxunshear.sweep import plan
from jaxunshear.sweep.grid import Row, find_reference, list_cells, list_rows
from jaxunshear.sweep.scores import RowScores, read_tests
from jaxunshear.sweep.summary import summarise
from jaxunshear.sweep.tasks import LOCK, WORKER, read_outcome, run_task, write_failure
from jaxunshear.training.provenance import start_folder

Item = TypeVar("Item")


def run_sweep(
    sweep: Sweep,
    out: Path,
    data: Path,
    command: str,
    run_calls: CallRunner = run_locally,
    retry_failed: bool = False,
    worker: Sequence[str] = WORKER,
) -> SweepResult:
    """Run the rows of a checked `sweep` that have no outcome; write out/<name>/sweep.json.

    `run_calls` runs the tasks, on this machine or on a cluster whose machines have the folders
    under the same paths; a task whose worker dies goes on from its checkpoint. Raises `UserError`
    if a cell cannot be run (before any work), the data sets cannot be made, or another sweep uses
    the folder.
    """
    cells = list_cells(sweep)
    rows, reference = list_rows(sweep, cells), find_reference(sweep, cells)
    folder = Path(out).absolute() / sweep.name
    with hold_lock(folder / LOCK, wait=False) as free:
        if not free:
            raise UserError(
                f"another sweep is at work in {folder}: wait for it, stop it, or give another --out"
            )
        if retry_failed:
            plan.forget_failures(folder, rows.values())
        order = list(rows.values())
        _run_rows(sweep, folder, order, Path(data).absolute(), command, run_calls, worker)
        folders = {key: plan.find_row_folder(folder, row) for key, row in rows.items()}
        scores = {key: _read_row_scores(path) for key, path in folders.items()}
        for cell in cells:
            keys = [(cell.label, seed) for seed in sweep.seeds]
            _check_contacts({folders[key]: scores[key] for key in keys})
        summary = summarise(sweep, cells, scores, reference)
        summary = _add_provenance(summary, scores.values(), command)
        picture = plot_sweep(summary) or (None if sweep.grid else plot_frontier(summary))
        if picture:
            write_bytes(folder / "sweep.png", picture)
        else:
            (folder / "sweep.png").unlink(missing_ok=True)  # an earlier one shows other rows
        write_record(folder / "sweep.json", summary)
    return summary


def _run_rows(
    sweep: Sweep,
    folder: Path,
    rows: list[Row],
    data: Path,
    command: str,
    run_calls: CallRunner,
    worker: Sequence[str],
) -> None:
    total = len({row.digest for row in rows})
    unfinished = plan.list_unfinished_rows(folder, rows)
    if not unfinished:
        return
    for row in unfinished:
        for network in list_trained_networks(row.experiment):
            start_folder(row.experiment, network)
    task = plan.make_data_task(folder, unfinished, data)
    run_task(task.folder, task.kind, worker, quiet=False)
    outcome = read_outcome(task.folder, task.kind)
    if outcome and outcome.status == "failed":
        raise UserError(str(outcome.reason))
    planned = plan.plan_tasks(folder, unfinished, sweep.ablation, data, command)
    tasks = {task.folder: task for task in planned}
    calls = (
        Call(task.folder, run_task, (task.folder, task.kind, tuple(worker)), task.needs)
        for task in planned
    )
    done = total - len(unfinished)
    with Progress(f"sweep {sweep.name}", total, unit="rows", done=done) as progress:
        for name, result in run_calls(calls):
            if isinstance(result, WorkerDied):
                write_failure(name, tasks[name].kind, result.reason)
            progress.advance(tasks[name].kind == "row")


def _read_row_scores(folder: Path) -> RowScores:
    outcome = read_outcome(folder, "row")
    if outcome is None:
        raise UserError(f"{folder} was not finished: run the same command again")
    if outcome.status == "failed":
        return RowScores(outcome, {})
    return RowScores(outcome, read_tests(folder, f"delete {folder} and run the same command"))


def _check_contacts(rows: Mapping[Path, RowScores]) -> None:
    """Raise UserError if the seeds of a cell were tested on different contacts."""
    done = [(folder, row) for folder, row in rows.items() if row.tests]
    for (first, row), (second, other) in itertools.pairwise(done):
        for test in row.tests.keys() & other.tests.keys():
            for name in ("stimulus", "pose_id"):
                if not np.array_equal(row.tests[test][name], other.tests[test][name]):
                    raise UserError(
                        f"{first} and {second} were tested on different contacts (the data were "
                        "made anew in between): delete both and run the same command"
                    )


def _add_provenance(summary: SweepResult, scores: Iterable[RowScores], command: str) -> SweepResult:
    """Add the command, and each different machine, version and source that made the rows."""
    results = [row.outcome.evaluated_results for row in scores if row.outcome.status == "done"]
    sources: Sequence = ()
    if all(result.sources for result in results):
        sources = _list_distinct(source for result in results for source in result.sources)
    trained_on = (machine for result in results for machine in result.trained_on.values())
    return replace(
        summary,
        command=command,
        machines=_list_distinct(result.machine for result in results),
        trained_on=_list_distinct(trained_on),
        versions=_list_distinct(result.versions for result in results),
        sources=sources,
    )


def _list_distinct(items: Iterable[Item]) -> list[Item]:
    return [item for item, _ in itertools.groupby(sorted(items, key=str))]
