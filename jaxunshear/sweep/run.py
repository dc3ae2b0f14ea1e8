"""A full sweep: data sets, rows, summary. Whatever is there already is kept, so the same command continues. No JAX here:
the rows' own processes need the device."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from jaxunshear.errors import UserError
from jaxunshear.locks import locked
from jaxunshear.progress import Progress
from jaxunshear.report.frontier_figure import plot_frontier
from jaxunshear.report.sweep_figure import plot_sweep
from jaxunshear.results.record_files import write_record
from jaxunshear.results.sweep import SweepResult
from jaxunshear.settings.experiment import list_trained_networks
from jaxunshear.settings.sweep import Sweep
from jaxunshear.storage import write_bytes
from jaxunshear.sweep import plan
from jaxunshear.sweep.engines import Engine, serial
from jaxunshear.sweep.rows import Row, cells_of, reference_of, rows_of
from jaxunshear.sweep.scores import Measured, read_tests
from jaxunshear.sweep.summary import summarise
from jaxunshear.sweep.tasks import LOCK, WORKER, carry_out, read_outcome
from jaxunshear.training.initial_weights import start_folder

Thing = TypeVar("Thing")


def run_sweep(
    sweep: Sweep,
    out: Path,
    data: Path,
    command: str,
    engine: Engine = serial,
    retry_failed: bool = False,
    worker: Sequence[str] = WORKER,
) -> SweepResult:
    """Runs the rows of a checked `sweep` that have no outcome yet; returns the summary that it writes to out/<name>/sweep.json.

    Raises `UserError` where a cell cannot work (before any work), the data sets cannot be made, or another sweep is at work there.
    """
    cells = cells_of(sweep)
    rows, reference = rows_of(sweep, cells), reference_of(sweep, cells)
    folder = Path(out).absolute() / sweep.name
    with locked(folder / LOCK, wait=False) as free:
        if not free:
            raise UserError(
                f"another sweep is at work in {folder}: wait for it, stop it, or give another --out"
            )
        if retry_failed:
            plan.forget_failures(folder, rows.values())
        _run_rows(
            sweep, folder, list(rows.values()), Path(data).absolute(), command, engine, worker
        )
        measured = {key: _measured(plan.row_folder(folder, row)) for key, row in rows.items()}
        for cell in cells:
            _check_contacts(
                {
                    plan.row_folder(folder, rows[cell.label, s]): measured[cell.label, s]
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
    left = plan.unfinished(folder, rows)
    if not left:
        return
    for row in left:
        for network in list_trained_networks(row.experiment):
            start_folder(row.experiment, network)
    task = plan.data_task(folder, left, data)
    carry_out(task.folder, task.kind, worker, quiet=False)
    made = read_outcome(task.folder, task.kind)
    if made and made.status == "failed":
        raise UserError(str(made.reason))
    tasks = plan.lay_out(folder, left, sweep.ablation, data, command)
    with Progress(f"sweep {sweep.name}", total, unit="rows", done=total - len(left)) as progress:
        for task in engine(tasks, worker):
            progress.advance(task.kind == "row")


def _measured(folder: Path) -> Measured:
    outcome = read_outcome(folder, "row")
    if outcome is None:
        raise UserError(f"{folder} was not finished: run the same command again")
    if outcome.status == "failed":
        return Measured(outcome, {})
    return Measured(outcome, read_tests(folder, f"delete {folder} and run the same command"))


def _check_contacts(rows: Mapping[Path, Measured]) -> None:
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
    summary: SweepResult, measured: Mapping[tuple[str, int], Measured], command: str
) -> SweepResult:
    """With command, machines, versions and sources: each different one of those that the rows were run on and with."""
    results = [row.outcome.evaluated for row in measured.values() if row.outcome.status == "done"]
    return replace(
        summary,
        command=command,
        machines=_distinct(result.machine for result in results),
        trained_on=_distinct(
            machine for result in results for machine in result.trained_on.values()
        ),
        versions=_distinct(result.versions for result in results),
        sources=_distinct(found for result in results for found in result.sources)
        if all(result.sources for result in results)
        else (),
    )


def _distinct(things: Iterable[Thing]) -> list[Thing]:
    return [found for found, _ in itertools.groupby(sorted(things, key=str))]
