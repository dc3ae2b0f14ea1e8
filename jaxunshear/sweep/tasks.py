"""A task of a sweep is one folder and one process: task.json goes in, <kind>.json comes out, log.txt holds what was said.

However the process ends (a refusal, a crash, a kill for memory), <kind>.json says so, and nothing but this task is lost. Where
the sweep itself is stopped, or the disk is full, there is none, and the same task goes on from its checkpoints. Imports no JAX.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxunshear.environment import settled
from jaxunshear.errors import UserError
from jaxunshear.storage import read_json, write_json

TASK, LOG, LOCK = "task.json", "log.txt", "lock"
WORKER = (sys.executable, "-m", "jaxunshear.sweep.work")
DISK_FULL = 75  # exit code of a task that has no outcome, since the disk is full
SAID = ("label", "seed", "networks")  # what the outcome repeats of the task


@dataclass(frozen=True)
class Task:
    """What an engine needs to know: where, and after which other tasks."""

    folder: Path
    kind: str  # "data": the data sets; "training": one that rows share; "row"
    needs: tuple[Path, ...] = ()  # folders of tasks


def outcome_file(folder: Path, kind: str) -> Path:
    """Where the outcome of a task is, once it has one."""
    return Path(folder) / f"{kind}.json"


def read_outcome(folder: Path, kind: str) -> dict[str, Any] | None:
    """`status` ("done" or "failed") with its `reason` and figures; None while the task is not finished."""
    path = outcome_file(folder, kind)
    return read_json(path) if path.exists() else None


def failure(task: dict[str, Any], reason: str, folder: Path) -> dict[str, Any]:
    """The outcome of a task that failed in `folder`; the reason is one line, and names files from there."""
    line = " ".join(reason.replace(f"{folder}{os.sep}", "").replace(str(folder), folder.name).split())
    return {"status": "failed", "reason": line} | repeated(task)


def repeated(task: dict[str, Any]) -> dict[str, Any]:
    """What stands in an outcome whatever it is: for whom it was done, with which settings."""
    settings = {"settings": task["experiment"]} if "experiment" in task else {}
    return {name: task[name] for name in SAID if name in task} | settings


def carry_out(folder: Path, kind: str, worker: Sequence[str] = WORKER, quiet: bool = True) -> None:
    """Runs the task of `folder` in a process of its own, to its outcome; if it leaves none, writes the failure.

    Raises `UserError` where the disk is full: the next task would end there, too.
    `quiet`: what the process prints goes to log.txt, else where this process prints.
    """
    with (folder / LOG).open("ab") as log:
        output: Any = log if quiet else None
        process = subprocess.Popen(
            [*worker, str(folder), str(os.getpid())],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env=settled(os.environ),  # a machine of a cluster has its own
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
    if not outcome_file(folder, kind).exists():
        time.sleep(0.2)  # whoever kills all processes of a sweep kills this one next: that is no failure of the task
        give_up(folder, kind, _ending(code, folder))


def give_up(folder: Path, kind: str, reason: str) -> None:
    """Writes the outcome of a task that cannot do so itself, unless it did."""
    path = outcome_file(folder, kind)
    if not path.exists():
        write_json(path, failure(read_json(folder / TASK), reason, folder))


def _ending(code: int, folder: Path) -> str:
    if code < 0:
        memory = " (out of memory?)" if -code == signal.SIGKILL else ""
        return f"killed by signal {-code}{memory}"
    lines = (folder / LOG).read_text(errors="replace").strip().splitlines()
    return f"ended with exit code {code}: {lines[-1] if lines else 'it said nothing'}"
