"""File systems whose Nth write fails, that are full, or read-only; files from another year.

A command must end with one line and exit code 2; a rerun ends as if nothing had been.
"""

import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from jaxunshear.errors import UserError
from tests.faults import shim
from tests.faults.jobs import Job, make_jobs
from tests.faults.outcome import Outcome, Row, Size, run_cases
from tests.faults.places import Places
from tests.faults.processes import run_two

ERRORS = {
    "ENOSPC": "disk full",
    "EDQUOT": "quota",
    "EROFS": "read-only",
    "EACCES": "permission lost",
    "EIO": "disk broken",
}
WRITING = ("release", "report", "unshear", "compare", "stream", "train", "data", "evaluate")
DECADE_S = 10 * 365 * 86_400.0
KIB = (16, 1024)  # room that is left in a file system that is too small


def list_write_rows(places: Places, size: Size, scratch: Path) -> Iterator[Row]:
    """Yield a row for each command, some write of which fails."""
    jobs = make_jobs(places)
    for name in (*WRITING, "run, recorded"):
        yield _fail_writes(jobs[name], places, size, scratch / "work")


def list_other_rows(places: Places, size: Size, scratch: Path) -> Iterator[Row]:
    """Yield a row for each fault; those of a file system need the right to mount one."""
    jobs = make_jobs(places)
    for name in ("data", "train"):
        yield run_two(jobs[name], places, size, scratch / "work")
        yield _move_clock(jobs[name], size, scratch / "work", places)
    small = scratch / "small"
    if not _mount(small, f"size={KIB[1]}k"):
        print("no right to mount a tmpfs: its rows are left out", file=sys.stderr)
        return
    subprocess.run(["umount", small], check=True)
    for name in ("data", "train", "report", "release"):
        for option, fault in (
            ("size={}k", "a full file system"),
            ("ro", "a read-only file system"),
        ):
            row = Row(fault, name, size.seed)
            yield _fill(row, jobs[name], places, size, (small, option))


def _fail_writes(job: Job, places: Places, size: Size, work: Path) -> Row:
    job.prepare(work, places)
    shim.arm(work, 0)
    right = job.run(work)
    count = shim.count_writes()
    shim.disarm()

    def try_write(draw: random.Random) -> Outcome:
        nth, error = draw.randint(1, count), draw.choice(list(ERRORS))
        job.prepare(work, places)
        shim.arm(work, nth, error)
        return _run_twice(job, work, right, f"{error} at write {nth}", shim.disarm)

    row = Row(f"the Nth write fails: {', '.join(ERRORS.values())}", job.name, size.seed)
    return run_cases(row, size, size.writes, try_write)


def _run_twice(
    job: Job, work: Path, right: object, where: str, repair: Callable[[], None]
) -> Outcome:
    """Run a command under a fault and, unless it ends well, again after `repair`."""
    try:
        found = job.run(work)
        return Outcome("harmless" if found == right else "silent", where)
    except UserError as error:
        kind, where = "refused", f"{where}: {error}"
    except Exception as error:
        kind, where = "lost", f"{where}: {type(error).__name__}: {error}"
    finally:
        repair()
    try:
        if job.run(work) != right:
            kind = "silent"
    except Exception as error:
        kind, where = "lost", f"{where}; then {type(error).__name__}: {error}"
    return Outcome(kind, where)


def _move_clock(job: Job, size: Size, work: Path, places: Places) -> Row:
    """Set the clock back, or forward, by years, between one command and the same again."""
    job.prepare(work, places)
    right = job.run(work)

    def try_years(draw: random.Random) -> Outcome:
        for file in work.rglob("*"):
            moved = time.time() + draw.uniform(-DECADE_S, DECADE_S)
            os.utime(file, (moved, moved))
        return Outcome("harmless" if job.run(work) == right else "silent", "files of other years")

    row = Row("the clock moved by years", job.name, size.seed)
    return run_cases(row, size, size.moments, try_years)


def _fill(row: Row, job: Job, places: Places, size: Size, mounted: tuple[Path, str]) -> Row:
    """Fail in a file system of this option, and go on when it has room and is writable again."""
    place, option = mounted
    work = place / "work"

    def run_mounted(run: Callable[[], object]) -> object:
        _mount(place, "size=1g")
        try:
            job.prepare(work, places)
            return run()
        finally:
            subprocess.run(["umount", place], check=True)

    right = run_mounted(lambda: job.run(work))

    def try_full(draw: random.Random) -> Outcome:
        room = draw.randint(*KIB)

        def run() -> Outcome:
            _remount(place, option.format(shutil.disk_usage(place).used // 1024 + room))
            where = f"{row.fault}, {room} KiB left"
            return _run_twice(job, work, right, where, lambda: _remount(place, "rw,size=1g"))

        return run_mounted(run)  # type: ignore[return-value]

    return run_cases(row, size, size.moments, try_full)


def _mount(place: Path, options: str) -> bool:
    place.mkdir(exist_ok=True)
    words = ["mount", "-t", "tmpfs", "-o", options, "none", place]
    return subprocess.run(words, check=False, capture_output=True).returncode == 0


def _remount(place: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", place], check=True)
