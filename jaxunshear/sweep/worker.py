"""The process of one task: `python -m jaxunshear.sweep.worker FOLDER PARENT` does FOLDER/task.json and writes the outcome.

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
from dataclasses import replace
from pathlib import Path

from jaxunshear.allocator import keep_freed_memory
from jaxunshear.code_version import read_source
from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.config.load import run_file
from jaxunshear.config.serialization import from_json
from jaxunshear.environment import check_variables
from jaxunshear.errors import UserError
from jaxunshear.files import is_disk_full
from jaxunshear.locks import hold_lock
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
    """Does the task in `folder`, unless it has an outcome already."""
    exit_with_parent(parent)
    read_source()  # as the code is now; it may be changed while this works
    keep_freed_memory()
    with hold_lock(
        folder / LOCK, wait=True
    ):  # one left over from a killed sweep may still be at its end
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
    """Has the system kill this process when `parent` ends, however it ends (Linux; elsewhere this task is finished first)."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before we could ask
        sys.exit("the sweep has ended")


def run_order(order: TaskOrder, folder: Path) -> Outcome:
    """What the task made, or why it failed, and what it took. A full disk is no failure of the task: raised."""
    began = time.perf_counter()
    try:
        check_variables()  # a machine of a cluster has its own
        made = {"data": _data, "training": _training, "row": _row}[order.kind](order, folder)
        outcome = copy_order_fields(order, made)
    except UserError as error:
        if is_disk_full(error):
            raise
        outcome = make_failure(
            order, str(error) if order.kind == "data" else _to_retry(str(error)), folder
        )
    except Exception as error:  # also a MemoryError, and what XLA makes of one
        if is_disk_full(error):
            raise
        traceback.print_exc()
        outcome = make_failure(order, f"{type(error).__name__}: {error}"[:500], folder)
    kilobyte = 1 if sys.platform == "darwin" else 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * kilobyte
    return replace(
        outcome,
        wall_seconds=time.perf_counter() - began,
        peak_memory_bytes=max(peak, outcome.peak_memory_bytes),
        host=platform.node(),
    )


def _to_retry(reason: str) -> str:
    """`reason` with the option that tries a failed task again, where it asks for the same command."""
    option = "--retry-failed"
    return (
        reason
        if option in reason
        else reason.replace("the same command", f"the same command with {option}")
    )


def _data(order: TaskOrder, folder: Path) -> Outcome:
    from jaxunshear.data.generation import make_sets

    for wanted in order.experiments:
        make_sets(from_json(wanted, str(folder / TASK)), Path(order.data))
    return Outcome(status="done", reason=None)


def _training(order: TaskOrder, folder: Path) -> Outcome:
    experiment = _start_task(order, folder)
    run_stages(
        experiment, tuple(order.networks or ()), folder.parent, Path(order.data), order.command
    )
    return _summarise_trainings(order, folder)


def _row(order: TaskOrder, folder: Path) -> Outcome:
    experiment = _start_task(order, folder)
    stages, data = (*(order.networks or ()), "evaluate"), Path(order.data)
    results = run_stages(experiment, stages, folder.parent, data, order.command)
    assert results is not None
    spoilt = _measure_codes(experiment, folder, data, order.command) if order.ablation else None
    made = replace(_summarise_trainings(order, folder), results=results, ablation=spoilt)
    return replace(made, device=results.machine.device, ms_per_image=results.ms_per_image)


def _measure_codes(
    experiment: Experiment, folder: Path, data: Path, command: str
) -> list[dict[str, object]]:
    """What decoders make of exchanged codes, and what each code holds that it should not."""
    from jaxunshear.evaluation.code_swap_test import ablate
    from jaxunshear.evaluation.leakage import measure_leakage
    from jaxunshear.evaluation.leakage_table import build_sweep_rows

    over = uses_pins(experiment)
    rows = [] if over else ablate(experiment, folder, data, command)["rows"]
    if experiment.pins.shear_code if over else experiment.unshear.shear_channels:
        rows += build_sweep_rows(measure_leakage(experiment, folder, data, command, controls=False))
    return rows


def _start_task(order: TaskOrder, folder: Path) -> Experiment:
    """The task's experiment, and in `folder` copies of the trainings that others have finished for it."""
    for network, source in order.sources.items():
        _reuse(Path(source), folder / network)
    for file in order.files:
        run_file(Path(file))
    return from_json(order.experiment, str(folder / TASK))


def _reuse(source: Path, target: Path) -> None:
    """A copy of the finished training `source` as `target`, complete or not at all."""
    if (target / "summary.json").exists():
        return
    if not (source / "summary.json").exists():
        outcome = read_outcome(source.parent, "training")
        reason = outcome.reason if outcome else "it was not finished"
        raise UserError(f"its {target.name}, which other rows share, failed: {reason}")
    _check_checkpoints(source)
    part = target.with_name(target.name + ".part")
    for old in (part, target):
        shutil.rmtree(old, ignore_errors=True)
    shutil.copytree(source, part)
    part.rename(target)


def _check_checkpoints(source: Path) -> None:
    """Refuses to copy a training that is lost or damaged: its own folder is the one to delete, not that of the copy."""
    from jaxunshear.training.checkpoint import has_model, load_best

    if not has_model(source):
        raise UserError(
            f"{source} has lost its checkpoints: delete that folder, then run the same command"
        )
    load_best(source)


def _summarise_trainings(order: TaskOrder, folder: Path) -> Outcome:
    """Time and memory of the trainings, those of other tasks with them."""
    ended = {
        network: read_record(
            folder / network / "summary.json", TrainingSummary, "delete it and run the same command"
        )
        for network in order.networks or ()
    }
    others = {Path(source).parent for source in order.sources.values()}
    outcomes = [
        read_outcome(other, kind) for other in sorted(others) for kind in ("training", "row")
    ]
    return Outcome(
        status="done",
        reason=None,
        train_seconds={network: summary.train_seconds for network, summary in ended.items()},
        images_per_second={
            network: summary.images_per_second for network, summary in ended.items()
        },
        peak_memory_bytes=max((one.peak_memory_bytes for one in outcomes if one), default=0),
    )


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2])))
