"""The process of one task: `python -m jaxunshear.sweep.worker FOLDER PARENT`.

It does FOLDER/task.json and writes the outcome. It dies with its parent, and holds FOLDER/lock, so
that no two of them work in one folder.
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
from dataclasses import replace
from pathlib import Path

from jaxunshear.code_version import read_source
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.load import run_file
from jaxunshear.config.serialization import from_json
from jaxunshear.data.sources import open_source
from jaxunshear.environment import check_variables, keep_freed_memory
from jaxunshear.errors import UserError
from jaxunshear.files import hold_lock, is_disk_full
from jaxunshear.results.measurement import TrainingSummary
from jaxunshear.results.record_files import read_record, write_record
from jaxunshear.results.sweep import Outcome
from jaxunshear.run import run_stages
from jaxunshear.sweep.tasks import (
    DISK_FULL,
    LOCK,
    TASK,
    TaskOrder,
    copy_order_fields,
    get_outcome_file,
    make_failure,
    read_order,
    read_outcome,
)

PR_SET_PDEATHSIG = 1  # linux/prctl.h


def main(folder: Path, parent: int) -> int:
    """Do the task in `folder`, unless it has an outcome already."""
    exit_with_parent(parent)
    read_source()  # now, as the code may change while the task runs
    keep_freed_memory()
    with hold_lock(folder / LOCK, wait=True):  # a worker of a killed sweep may still be ending
        order = read_order(folder)
        outcome = get_outcome_file(folder, order.kind)
        if not outcome.exists():
            try:
                write_record(outcome, run_order(order, folder))
            except Exception as error:
                if is_disk_full(error):
                    print(f"{type(error).__name__}: {error}", file=sys.stderr)
                    return DISK_FULL
                raise
    return 0


def exit_with_parent(parent: int) -> None:
    """Make Linux kill this process when `parent` ends; elsewhere it finishes its task first."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before the call above
        sys.exit("the sweep has ended")


def run_order(order: TaskOrder, folder: Path) -> Outcome:
    """Run a task; return its outcome with time and memory. A full disk raises its error."""
    start = time.perf_counter()
    try:
        check_variables()  # each machine of a cluster has its own
        run = {"data": _make_data, "training": _run_trainings, "row": _run_row}[order.kind]
        outcome = copy_order_fields(order, run(order, folder))
    except UserError as error:
        if is_disk_full(error):
            raise
        reason = str(error)
        if order.kind != "data" and "--retry-failed" not in reason:
            reason = reason.replace("the same command", "the same command with --retry-failed")
        outcome = make_failure(order, reason, folder)
    except Exception as error:  # also a MemoryError, and what XLA makes of one
        if is_disk_full(error):
            raise
        traceback.print_exc()
        outcome = make_failure(order, f"{type(error).__name__}: {error}"[:500], folder)
    kilobyte = 1 if sys.platform == "darwin" else 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * kilobyte
    return replace(
        outcome,
        wall_seconds=time.perf_counter() - start,
        peak_memory_bytes=max(peak, outcome.peak_memory_bytes),
        host=platform.node(),
    )


def _make_data(order: TaskOrder, folder: Path) -> Outcome:
    for file in order.files:
        run_file(Path(file))
    for settings in order.experiments:
        experiment = from_json(settings, str(folder / TASK))
        open_source(experiment).make_sets(Path(order.data))
    return Outcome(status="done", reason=None)


def _run_trainings(order: TaskOrder, folder: Path) -> Outcome:
    experiment = _start_task(order, folder)
    networks = tuple(order.networks or ())
    run_stages(experiment, networks, folder.parent, Path(order.data), order.command)
    return _summarise_trainings(order, folder)


def _run_row(order: TaskOrder, folder: Path) -> Outcome:
    experiment = _start_task(order, folder)
    stages, data = (*(order.networks or ()), "evaluate"), Path(order.data)
    results = run_stages(experiment, stages, folder.parent, data, order.command)
    assert results is not None
    ablation = _measure_codes(experiment, folder, data, order.command) if order.ablation else None
    return replace(
        _summarise_trainings(order, folder),
        results=results,
        ablation=ablation,
        device=results.machine.device,
        ms_per_image=results.ms_per_image,
    )


def _measure_codes(
    experiment: Experiment, folder: Path, data: Path, command: str
) -> list[dict[str, object]]:
    from jaxunshear.evaluation.code_swaps import ablate
    from jaxunshear.evaluation.leakage import build_sweep_rows, measure_leakage

    if experiment.unshear.input == "pins":
        rows, has_shear_code = [], bool(experiment.pins.shear_code)
    else:
        rows = ablate(experiment, folder, data, command)["rows"]
        has_shear_code = bool(experiment.unshear.shear_channels)
    if has_shear_code:
        rows += build_sweep_rows(measure_leakage(experiment, folder, data, command, controls=False))
    return rows


def _start_task(order: TaskOrder, folder: Path) -> Experiment:
    """Copy the trainings that other tasks have finished into `folder`; return the experiment."""
    for network, source in order.sources.items():
        _copy_training(Path(source), folder / network)
    for file in order.files:
        run_file(Path(file))
    return from_json(order.experiment, str(folder / TASK))


def _copy_training(source: Path, target: Path) -> None:
    """Copy the finished training `source` to `target`, entirely or not at all."""
    if (target / "summary.json").exists():
        return
    if not (source / "summary.json").exists():
        outcome = read_outcome(source.parent, "training")
        reason = outcome.reason if outcome else "it was not finished"
        raise UserError(f"its {target.name}, which other rows share, failed: {reason}")
    from jaxunshear.training.checkpoint import check_checkpoints, load_best

    check_checkpoints(source)
    load_best(source)  # so that the error of a damaged one names its own folder
    part = target.with_name(target.name + ".part")
    for old in (part, target):
        shutil.rmtree(old, ignore_errors=True)
    shutil.copytree(source, part)
    part.rename(target)


def _summarise_trainings(order: TaskOrder, folder: Path) -> Outcome:
    """Summarise time and memory of the trainings, including those that other tasks did."""
    train_seconds, images_per_second = {}, {}
    for network in order.networks or ():
        path, remedy = folder / network / "summary.json", "delete it and run the same command"
        summary = read_record(path, TrainingSummary, remedy)
        train_seconds[network] = summary.train_seconds
        images_per_second[network] = summary.images_per_second
    peak_memory_bytes = 0
    for other in {Path(source).parent for source in order.sources.values()}:
        for kind in ("training", "row"):
            if outcome := read_outcome(other, kind):
                peak_memory_bytes = max(peak_memory_bytes, outcome.peak_memory_bytes)
    return Outcome(
        status="done",
        reason=None,
        train_seconds=train_seconds,
        images_per_second=images_per_second,
        peak_memory_bytes=peak_memory_bytes,
    )


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2])))
