"""A task of a sweep is one folder and one process: task.json goes in, <kind>.json comes out, log.txt holds what was said.

However the process ends (a refusal, a crash, a kill for memory), <kind>.json says so, and nothing but this task is lost. Where
the sweep itself is stopped, or the disk is full, there is none, and the same task goes on from its checkpoints. Imports no JAX.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from jaxunshear.errors import UserError
from jaxunshear.results.record_files import read_record, write_record
from jaxunshear.results.run import Settings
from jaxunshear.results.sweep import Outcome

TASK, LOG, LOCK = "task.json", "log.txt", "lock"
WORKER = (sys.executable, "-m", "jaxunshear.sweep.worker")
DISK_FULL = 75  # exit code of a task that has no outcome, since the disk is full


@dataclass(frozen=True)
class Task:
    """What an engine needs to know: where, and after which other tasks."""

    folder: Path
    kind: str  # "data": the data sets; "training": one that rows share; "row"
    needs: tuple[Path, ...] = ()  # folders of tasks


@dataclass(frozen=True, kw_only=True)
class TaskOrder:
    """task.json: what the process of a task is to do."""

    kind: str
    data: str = ""  # folder of the data sets
    command: str = ""
    experiments: Sequence[Settings] = ()  # whose data sets are made
    experiment: Settings | None = None
    networks: Sequence[str] | None = None  # to be trained, in this order
    sources: Mapping[str, str] = field(
        default_factory=dict
    )  # by network: the folder of a training to be copied
    ablation: bool = False
    label: str | None = None
    seed: int | None = None
    files: Sequence[str] = ()  # experiment files that register losses


def get_outcome_file(folder: Path, kind: str) -> Path:
    """Where the outcome of a task is, once it has one."""
    return Path(folder) / f"{kind}.json"


def read_outcome(folder: Path, kind: str) -> Outcome | None:
    """None while the task is not finished."""
    path = get_outcome_file(folder, kind)
    return (
        read_record(path, Outcome, "delete it and run the same command") if path.exists() else None
    )


def read_order(folder: Path) -> TaskOrder:
    return read_record(folder / TASK, TaskOrder, "delete that folder and run the same command")


def make_failure(order: TaskOrder, reason: str, folder: Path) -> Outcome:
    """The outcome of a task that failed in `folder`; the reason is one line, and names files from there."""
    line = " ".join(
        reason.replace(f"{folder}{os.sep}", "").replace(str(folder), folder.name).split()
    )
    return copy_order_fields(order, Outcome(status="failed", reason=line))


def copy_order_fields(order: TaskOrder, outcome: Outcome) -> Outcome:
    """`outcome` with what stands in it whatever it is: for whom it was done, with which settings."""
    return replace(
        outcome,
        label=order.label,
        seed=order.seed,
        networks=order.networks,
        settings=order.experiment,
    )


def run_task(folder: Path, kind: str, worker: Sequence[str] = WORKER, quiet: bool = True) -> None:
    """Runs the task of `folder` in a process of its own, to its outcome; if it leaves none, writes the failure.

    Raises `UserError` where the disk is full: the next task would end there, too.
    `quiet`: what the process prints goes to log.txt, else where this process prints.
    """
    with (folder / LOG).open("ab") as log:
        output = log if quiet else None
        process = subprocess.Popen(
            [*worker, str(folder), str(os.getpid())],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,  # Ctrl-C is for the sweep, which then ends its tasks
        )
        try:
            code = process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise
    if code == DISK_FULL:
        raise UserError(f"{folder}: the disk is full; free some space, then run the same command")
    if not get_outcome_file(folder, kind).exists():
        time.sleep(
            0.2
        )  # whoever kills all processes of a sweep kills this one next: that is no failure of the task
        write_failure(folder, kind, _ending(code, folder))


def write_failure(folder: Path, kind: str, reason: str) -> None:
    """Writes the outcome of a task that cannot do so itself, unless it did."""
    path = get_outcome_file(folder, kind)
    if not path.exists():
        write_record(path, make_failure(read_order(folder), reason, folder))


def _ending(code: int, folder: Path) -> str:
    if code < 0:
        memory = " (out of memory?)" if -code == signal.SIGKILL else ""
        return f"killed by signal {-code}{memory}"
    lines = (folder / LOG).read_text(errors="replace").strip().splitlines()
    return f"ended with exit code {code}: {lines[-1] if lines else 'it said nothing'}"
