"""A full sweep: data sets, rows, summary. Whatever is there already is kept, so the same command continues. No JAX here:
the rows' own processes need the device."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from jaxunshear.config.experiment import list_trained_networks
from jaxunshear.config.sweep import Sweep
from jaxunshear.errors import UserError
from jaxunshear.files import write_bytes
from jaxunshear.locks import hold_lock
from jaxunshear.progress import Progress
from jaxunshear.report.frontier_figure import plot_frontier
from jaxunshear.report.sweep_figure import plot_sweep
from jaxunshear.results.record_files import write_record
from jaxunshear.results.sweep import SweepResult
from jaxunshear.sweep import plan
from jaxunshear.sweep.engines import Engine, run_serially
from jaxunshear.sweep.grid import Row, find_reference, list_cells, list_rows
from jaxunshear.sweep.scores import RowScores, read_tests
from jaxunshear.sweep.summary import summarise
from jaxunshear.sweep.tasks import LOCK, WORKER, read_outcome, run_task
from jaxunshear.training.initial_weights import start_folder

Thing = TypeVar("Thing")


def run_sweep(
    sweep: Sweep,
    out: Path,
    data: Path,
    command: str,
    engine: Engine = run_serially,
    retry_failed: bool = False,
    worker: Sequence[str] = WORKER,
) -> SweepResult:
    """Runs the rows of a checked `sweep` that have no outcome yet; returns the summary that it writes to out/<name>/sweep.json.

    Raises `UserError` where a cell cannot work (before any work), the data sets cannot be made, or another sweep is at work there.
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
        _run_rows(
            sweep, folder, list(rows.values()), Path(data).absolute(), command, engine, worker
        )
        measured = {
            key: _read_measured(plan.find_row_folder(folder, row)) for key, row in rows.items()
        }
        for cell in cells:
            _check_contacts(
                {
                    plan.find_row_folder(folder, rows[cell.label, s]): measured[cell.label, s]
                    for s in sweep.seeds
                }
            )
        summary = _made_with(summarise(sweep, cells, measured, reference), measured, command)
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
    engine: Engine,
    worker: Sequence[str],
) -> None:
    total = len({row.digest for row in rows})
    left = plan.list_unfinished(folder, rows)
    if not left:
        return
    for row in left:
        for network in list_trained_networks(row.experiment):
            start_folder(row.experiment, network)
    task = plan.make_data_task(folder, left, data)
    run_task(task.folder, task.kind, worker, quiet=False)
    made = read_outcome(task.folder, task.kind)
    if made and made.status == "failed":
        raise UserError(str(made.reason))
    tasks = plan.plan_tasks(folder, left, sweep.ablation, data, command)
    with Progress(f"sweep {sweep.name}", total, unit="rows", done=total - len(left)) as progress:
        for task in engine(tasks, worker):
            progress.advance(task.kind == "row")


def _read_measured(folder: Path) -> RowScores:
    outcome = read_outcome(folder, "row")
    if outcome is None:
        raise UserError(f"{folder} was not finished: run the same command again")
    if outcome.status == "failed":
        return RowScores(outcome, {})
    return RowScores(outcome, read_tests(folder, f"delete {folder} and run the same command"))


def _check_contacts(rows: Mapping[Path, RowScores]) -> None:
    """Refuses seeds of a cell that were tested on different contacts: their scores cannot be put side by side."""
    done = [(folder, row) for folder, row in rows.items() if row.tests]
    for (first, one), (folder, other) in itertools.pairwise(done):
        labels = [
            (test, name)
            for test in one.tests.keys() & other.tests.keys()
            for name in ("stimulus", "pose_id")
        ]
        if not all(
            np.array_equal(one.tests[test][name], other.tests[test][name]) for test, name in labels
        ):
            raise UserError(
                f"{first} and {folder} were tested on different contacts (the data were made anew in between): "
                "delete both and run the same command"
            )


def _made_with(
    summary: SweepResult, measured: Mapping[tuple[str, int], RowScores], command: str
) -> SweepResult:
    """With command, machines, versions and sources: each different one of those that the rows were run on and with."""
    results = [
        row.outcome.evaluated_results for row in measured.values() if row.outcome.status == "done"
    ]
    return replace(
        summary,
        command=command,
        machines=_list_distinct(result.machine for result in results),
        trained_on=_list_distinct(
            machine for result in results for machine in result.trained_on.values()
        ),
        versions=_list_distinct(result.versions for result in results),
        sources=_list_distinct(found for result in results for found in result.sources)
        if all(result.sources for result in results)
        else (),
    )


def _list_distinct(things: Iterable[Thing]) -> list[Thing]:
    return [found for found, _ in itertools.groupby(sorted(things, key=str))]
