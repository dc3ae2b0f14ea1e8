"""Killed at random moments, by time and by write in turn, and started again each time: the same bits at the end."""

import os
import random
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from tests.faults import shim
from tests.faults.jobs import Job, fresh, jobs
from tests.faults.outcome import Row, Size
from tests.faults.places import ROOT, Places

LATE = 4  # times as many tries as kills: a command may be at its end before
HERE = ("data", "train", "sweep", "servo", "stream", "run, recorded")


def rows(places: Places, size: Size, scratch: Path) -> Iterator[Row]:
    """A row for each command."""
    made = jobs(places)
    for name in HERE:
        yield _of(made[name], size, scratch / "work")


def _of(job: Job, size: Size, work: Path) -> Row:
    row = Row("kill -9 at a random moment", job.name, size.seed)
    began, draw = time.monotonic(), random.Random(size.seed)
    fresh(job, work)
    long = time.monotonic()
    code, said = ended(started(job, work, {}))
    long = time.monotonic() - long
    if code:
        raise RuntimeError(f"{job.name} does not run: {said[-500:]}")
    right = job.found(work)
    fresh(job, work)
    for number in size.places(LATE * size.moments):
        if row.cases >= size.moments:
            break
        if number % 2:
            nth = draw.randint(1, 200)
            code, said = ended(
                started(job, work, shim.killing(Path(os.environ["FAULTS"]), work, nth))
            )
            where = f"at write {nth}"
        else:
            seconds = draw.uniform(0.2, 0.9) * long
            code, said = ended(started(job, work, {}), seconds)
            where = f"after {seconds:.1f} s"
        if code == 0:  # it was at its end before the kill: from the start, then
            _compare(job, work, right, row, where)
            fresh(job, work)
        elif code == -signal.SIGKILL:
            row.count("harmless")
        else:
            row.count("lost", f"{where}: {said[-200:]}")
            fresh(job, work)
    code, said = ended(started(job, work, {}))
    if code:
        row.count("lost", f"at the end: {said[-200:]}")
    else:
        _compare(job, work, right, row, f"at the end: {said[-200:]}")
    row.seconds = time.monotonic() - began
    return row


def _compare(job: Job, work: Path, right: object, row: Row, where: str) -> None:
    """Counts what ended with another result: where that says which part was killed, the same command must make it complete on demand."""
    if job.found(work) == right:
        return
    if not job.named(work):
        row.count("silent", where)
        return
    code, said = ended(started(job, work, {}, job.again))
    row.count(
        "lost" if code or job.found(work) != right else "refused", f"{where}, again: {said[-200:]}"
    )


def started(
    job: Job, work: Path, more: dict[str, str], again: tuple[str, ...] = ()
) -> subprocess.Popen[str]:
    """The command in a process and a group of its own."""
    environment = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"} | more
    return subprocess.Popen(
        [*job.program, *map(str, job.words(work)), *again],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def ended(process: subprocess.Popen[str], seconds: float | None = None) -> tuple[int, str]:
    """Exit code, negative for a signal, and stderr; killed, with all that it started, after so many seconds."""
    try:
        _, said = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        _, said = process.communicate()
    return process.returncode, said
