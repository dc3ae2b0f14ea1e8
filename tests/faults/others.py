"""Two processes in one folder; a file system that is full, or read-only, in earnest; files from another year."""

import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from jaxunshear.errors import UserError
from tests.faults.jobs import Job, fresh, jobs
from tests.faults.kills import ended, started
from tests.faults.outcome import Row, Size, commanded
from tests.faults.places import Places

DECADE = 10 * 365 * 86_400.0
KIB = (16, 1024)  # room that is left in a file system that is too small


def rows(places: Places, size: Size, scratch: Path) -> Iterator[Row]:
    """A row for each fault; those of a file system need the right to mount one."""
    made = jobs(places)
    for name in ("data", "train"):
        yield _two(made[name], size, scratch / "work")
        yield _moved(made[name], size, scratch / "work")
    if not _mount(scratch / "small", f"size={KIB[1]}k"):
        print("no right to mount a tmpfs: its rows are left out", file=sys.stderr)
        return
    subprocess.run(["umount", scratch / "small"], check=True)
    for name in ("data", "train", "report", "release"):
        yield _mounted(made[name], size, scratch / "small", "size={}k", "a full file system")
        yield _mounted(made[name], size, scratch / "small", "ro", "a read-only file system")


def right_of(job: Job, place: Path) -> object:
    """What a command makes in a fresh place, and leaves there."""
    fresh(job, place)
    commanded(*job.words(place))
    return job.found(place)


def _two(job: Job, size: Size, work: Path) -> Row:
    row = Row("two processes in one folder", job.name, size.seed)
    began, draw, right = time.monotonic(), random.Random(size.seed), right_of(job, work)
    for _ in size.places(size.moments):
        fresh(job, work)
        first, later = started(job, work, {}), draw.uniform(0, 3)
        time.sleep(later)
        code, said = ended(started(job, work, {}))
        ends = [ended(first), (code, said)]
        codes = sorted(one[0] for one in ends)
        lines = [one[1].count("jaxunshear: error: ") for one in ends if one[0]]
        if codes not in ([0, 0], [0, 2]) or any(count != 1 for count in lines):
            row.count("lost", f"{later:.1f} s apart: exit codes {codes}")
        elif job.found(work) != right:
            row.count("silent", f"{later:.1f} s apart")
        else:
            row.count("harmless" if codes == [0, 0] else "refused")
    row.seconds = time.monotonic() - began
    return row


def _moved(job: Job, size: Size, work: Path) -> Row:
    """The clock was set back, or forward, by years, between one command and the same again."""
    row = Row("the clock moved by years", job.name, size.seed)
    began, draw, right = time.monotonic(), random.Random(size.seed), right_of(job, work)
    for _ in size.places(size.moments):
        for file in work.rglob("*"):
            os.utime(file, (moved := time.time() + draw.uniform(-DECADE, DECADE), moved))
        commanded(*job.words(work))
        row.count("harmless" if job.found(work) == right else "silent", "files of other years")
    row.seconds = time.monotonic() - began
    return row


def _mounted(job: Job, size: Size, place: Path, option: str, fault: str) -> Row:
    """Fails in a file system of this option, and goes on when that has room and is writable again."""
    row = Row(fault, job.name, size.seed)
    began, draw = time.monotonic(), random.Random(size.seed)
    right = None
    for number in size.places(size.moments + 1):
        room = draw.randint(*KIB)
        _mount(place, "size=1g")
        try:
            if not number:
                right = right_of(job, place / "work")
                continue
            fresh(job, place / "work")
            _remount(place, option.format(shutil.disk_usage(place).used // 1024 + room))
            _one(job, place, row, right, f"{fault}, {room} KiB left")
        finally:
            subprocess.run(["umount", place], check=True)
    row.seconds = time.monotonic() - began
    return row


def _one(job: Job, place: Path, row: Row, right: object, where: str) -> None:
    try:
        commanded(*job.words(place / "work"))
        return row.count("harmless" if job.found(place / "work") == right else "silent", where)
    except UserError:
        kind = "refused"
    except Exception as error:
        kind, where = "lost", f"{where}: {type(error).__name__}: {error}"
    _remount(place, "rw,size=1g")
    try:
        commanded(*job.words(place / "work"))
        if job.found(place / "work") != right:
            kind = "silent"
    except Exception as error:
        kind, where = "lost", f"{where}; then {type(error).__name__}: {error}"
    row.count(kind, where)


def _mount(place: Path, options: str) -> bool:
    place.mkdir(exist_ok=True)
    words = ["mount", "-t", "tmpfs", "-o", options, "none", place]
    return subprocess.run(words, check=False, capture_output=True).returncode == 0


def _remount(place: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", place], check=True)
