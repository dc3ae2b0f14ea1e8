"""The process of one task: `python -m jaxunshear.sweep.work FOLDER PARENT` does FOLDER/task.json and writes the outcome.

It dies with its parent, and holds FOLDER/lock, so that never two of them work in one folder.
"""

import ctypes
import os
import platform
import resource
import shutil
import signal
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from jaxunshear.errors import UserError
from jaxunshear.locks import locked
from jaxunshear.memory import keep_freed_memory, restart_with_large_pages
from jaxunshear.run import run_stages
from jaxunshear.settings.experiment import Experiment, over_pins
from jaxunshear.settings.stored import from_json
from jaxunshear.storage import disk_is_full, read_json, write_json
from jaxunshear.sweep.tasks import DISK_FULL, LOCK, TASK, failure, outcome_file, read_outcome, repeated

PR_SET_PDEATHSIG = 1  # linux/prctl.h


def main(folder: Path, parent: int) -> int:
    """Does the task in `folder`, unless it has an outcome already."""
    die_with(parent)
    keep_freed_memory()
    with locked(folder / LOCK, wait=True):  # one left over from a killed sweep may still be at its end
        task = read_json(folder / TASK)
        outcome = outcome_file(folder, task["kind"])
        if not outcome.exists():
            try:
                write_json(outcome, attempt(task, folder))
            except Exception as error:
                if disk_is_full(error):
                    print(f"{type(error).__name__}: {error}", file=sys.stderr)
                    return DISK_FULL
                raise
    return 0


def die_with(parent: int) -> None:
    """Has the system kill this process when `parent` ends, however it ends (Linux; elsewhere this task is finished first)."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before we could ask
        sys.exit("the sweep has ended")


def attempt(task: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The outcome of `task`: what it made, or why it failed, and what it took. A full disk is no failure of the task: raised."""
    began = time.perf_counter()
    try:
        made = {"data": _data, "training": _training, "row": _row}[task["kind"]](task, folder)
        outcome = {"status": "done", "reason": None} | repeated(task) | made
    except UserError as error:
        if disk_is_full(error):
            raise
        outcome = failure(task, str(error) if task["kind"] == "data" else _to_retry(str(error)), folder)
    except Exception as error:  # also a MemoryError, and what XLA makes of one
        if disk_is_full(error):
            raise
        traceback.print_exc()
        outcome = failure(task, f"{type(error).__name__}: {error}"[:500], folder)
    kilobyte = 1 if sys.platform == "darwin" else 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * kilobyte
    return outcome | {
        "wall_seconds": time.perf_counter() - began,
        "peak_memory_bytes": max(peak, outcome.get("peak_memory_bytes", 0)),
        "host": platform.node(),
    }


def _to_retry(reason: str) -> str:
    """`reason` with the option that tries a failed task again, where it asks for the same command."""
    option = "--retry-failed"
    return reason if option in reason else reason.replace("the same command", f"the same command with {option}")


def _data(task: dict[str, Any], folder: Path) -> dict[str, Any]:
    from jaxunshear.dataset.making import make_sets

    for wanted in task["experiments"]:
        make_sets(from_json(wanted, str(folder / TASK)), Path(task["data"]))
    return {}


def _training(task: dict[str, Any], folder: Path) -> dict[str, Any]:
    experiment = _started(task, folder)
    run_stages(experiment, tuple(task["networks"]), folder.parent, Path(task["data"]), task["command"])
    return _trained(task, folder)


def _row(task: dict[str, Any], folder: Path) -> dict[str, Any]:
    experiment = _started(task, folder)
    stages, data = (*task["networks"], "evaluate"), Path(task["data"])
    results = run_stages(experiment, stages, folder.parent, data, task["command"])
    spoilt = _spoilt(experiment, folder, data, task["command"]) if task["ablation"] else None
    device = results["machine"]["device"]
    made = {"results": results, "ablation": spoilt, "device": device, "ms_per_image": results["ms_per_image"]}
    return made | _trained(task, folder)


def _spoilt(experiment: Experiment, folder: Path, data: Path, command: str) -> list[dict[str, Any]]:
    """What decoders make of exchanged codes, and what each code holds that it should not."""
    from jaxunshear.evaluation.ablation import ablate
    from jaxunshear.evaluation.leakage import for_sweep, leakage

    over = over_pins(experiment)
    rows = [] if over else ablate(experiment, folder, data, command)["rows"]
    if experiment.pins.shear_code if over else experiment.unshear.shear_channels:
        rows += for_sweep(leakage(experiment, folder, data, command, leaks_alone=not over))
    return rows


def _started(task: dict[str, Any], folder: Path) -> Experiment:
    """The task's experiment, and in `folder` copies of the trainings that others have finished for it."""
    for network, source in task["sources"].items():
        _reuse(Path(source), folder / network)
    return from_json(task["experiment"], str(folder / TASK))


def _reuse(source: Path, target: Path) -> None:
    """A copy of the finished training `source` as `target`, complete or not at all."""
    if (target / "summary.json").exists():
        return
    if not (source / "summary.json").exists():
        outcome = read_outcome(source.parent, "training") or {"reason": "it was not finished"}
        raise UserError(f"its {target.name}, which other rows share, failed: {outcome['reason']}")
    _check_checkpoints(source)
    part = target.with_name(target.name + ".part")
    for old in (part, target):
        shutil.rmtree(old, ignore_errors=True)
    shutil.copytree(source, part)
    part.rename(target)


def _check_checkpoints(source: Path) -> None:
    """Refuses to copy a training that is lost or damaged: its own folder is the one to delete, not that of the copy."""
    from jaxunshear.training.checkpoint import holds_model, load_best

    if not holds_model(source):
        raise UserError(f"{source} has lost its checkpoints: delete that folder, then run the same command")
    load_best(source)


def _trained(task: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Time and memory of the trainings, those of other tasks with them."""
    summaries = {network: read_json(folder / network / "summary.json") for network in task["networks"]}
    names = ("train_seconds", "images_per_second")
    speeds = {name: {network: summary[name] for network, summary in summaries.items()} for name in names}
    others = {Path(source).parent for source in task["sources"].values()}
    outcomes = [read_outcome(other, kind) for other in sorted(others) for kind in ("training", "row")]
    return speeds | {"peak_memory_bytes": max((one.get("peak_memory_bytes", 0) for one in outcomes if one), default=0)}


if __name__ == "__main__":
    restart_with_large_pages()
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2])))
