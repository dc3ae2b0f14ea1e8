"""Tasks of a sweep: a folder and a process each, from task.json to <kind>.json.

However the process ends (a refusal, a crash, a kill for memory), <kind>.json says so, and nothing
but this task is lost. The output of the process is in log.txt. If the sweep itself is stopped, or
the disk is full, there is no <kind>.json, and the same task goes on from its checkpoints. Imports
no JAX.
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
WORKER = (sys.executable, "-P", "-m", "jaxunshear.sweep.worker")
DISK_FULL = 75  # exit code of a task that has no outcome, since the disk is full


@dataclass(frozen=True)
class Task:
    """One task, as an engine needs it."""

    folder: Path
    kind: str  # "data": the data sets; "training": one that rows share; "row"
    needs: tuple[Path, ...] = ()  # folders of the tasks that come before


@dataclass(frozen=True, kw_only=True)
class TaskOrder:
    """The content of task.json: the work of the task's process."""

    kind: str
    data: str = ""  # folder of the data sets
    command: str = ""
    experiments: Sequence[Settings] = ()  # whose data sets are made
    experiment: Settings | None = None
    networks: Sequence[str] | None = None  # to be trained, in this order
    # by network: the folder of a training to be copied
    sources: Mapping[str, str] = field(default_factory=dict)
    ablation: bool = False
    label: str | None = None
    seed: int | None = None
    files: Sequence[str] = ()  # experiment files that register losses or layouts


def get_outcome_file(folder: Path, kind: str) -> Path:
    """Return the path of a task's outcome, which exists once the task has ended."""
    return Path(folder) / f"{kind}.json"


def read_outcome(folder: Path, kind: str) -> Outcome | None:
    """Read the outcome of a task; None while the task is not finished."""
    path = get_outcome_file(folder, kind)
    if not path.exists():
        return None
    return read_record(path, Outcome, "delete it and run the same command")


def read_order(folder: Path) -> TaskOrder:
    return read_record(folder / TASK, TaskOrder, "delete that folder and run the same command")


def make_failure(order: TaskOrder, reason: str, folder: Path) -> Outcome:
    """Make the outcome of a failed task; the reason is one line, with paths from `folder`."""
    relative = reason.replace(f"{folder}{os.sep}", "").replace(str(folder), folder.name)
    line = " ".join(relative.split())
    return copy_order_fields(order, Outcome(status="failed", reason=line))


def copy_order_fields(order: TaskOrder, outcome: Outcome) -> Outcome:
    """Copy the label, seed, networks and settings of a task into its outcome."""
    return replace(
        outcome,
        label=order.label,
        seed=order.seed,
        networks=order.networks,
        settings=order.experiment,
    )


def run_task(folder: Path, kind: str, worker: Sequence[str] = WORKER, quiet: bool = True) -> None:
    """Run the task of `folder` in its own process; write a failure if that writes nothing.

    If `quiet`, the output of the process goes to log.txt. Raises `UserError` if the disk is full,
    since the next task would end the same way.
    """
    with (folder / LOG).open("ab") as log:
        output = log if quiet else None
        process = subprocess.Popen(
            [*worker, str(folder), str(os.getpid())],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},  # the modules found here
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
        # a kill of all processes of the sweep kills this one next, and is no failure of the task
        time.sleep(0.2)
        write_failure(folder, kind, _describe_exit(code, folder))


def write_failure(folder: Path, kind: str, reason: str) -> None:
    """Write the outcome of a task that could not do so itself."""
    path = get_outcome_file(folder, kind)
    if not path.exists():
        write_record(path, make_failure(read_order(folder), reason, folder))


def _describe_exit(code: int, folder: Path) -> str:
    if code < 0:
        memory = " (out of memory?)" if -code == signal.SIGKILL else ""
        return f"killed by signal {-code}{memory}"
    lines = (folder / LOG).read_text(errors="replace").strip().splitlines()
    return f"ended with exit code {code}: {lines[-1] if lines else 'it said nothing'}"
