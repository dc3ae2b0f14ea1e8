"""A file system whose Nth write fails, and all that follow: one line, exit code 2; and a rerun ends as if nothing had been."""

import random
import time
from collections.abc import Iterator
from pathlib import Path

from jaxunshear.errors import UserError
from tests.faults import shim
from tests.faults.jobs import Job, fresh, jobs
from tests.faults.outcome import Row, Size, commanded
from tests.faults.places import Places

ERRORS = {
    "ENOSPC": "disk full",
    "EDQUOT": "quota",
    "EROFS": "read-only",
    "EACCES": "permission lost",
    "EIO": "disk broken",
}
HERE = (
    "release",
    "report",
    "unshear",
    "compare",
    "stream",
    "train",
    "data",
    "evaluate",
    "run, recorded",
)


def rows(places: Places, size: Size, scratch: Path) -> Iterator[Row]:
    """A row for each command."""
    made = jobs(places)
    for name in HERE:
        yield _of(made[name], size, scratch / "work")


def _of(job: Job, size: Size, work: Path) -> Row:
    row = Row(f"the Nth write fails: {', '.join(ERRORS.values())}", job.name, size.seed)
    began, draw = time.monotonic(), random.Random(size.seed)
    fresh(job, work)
    shim.arm(work, 0)
    commanded(*job.words(work))
    count, right = shim.seen(), job.found(work)
    shim.disarm()
    for _ in size.places(size.writes):
        nth, error = draw.randint(1, count), draw.choice(list(ERRORS))
        fresh(job, work)
        _one(job, work, row, (nth, error), right)
    row.seconds = time.monotonic() - began
    return row


def _one(job: Job, work: Path, row: Row, fault: tuple[int, str], right: object) -> None:
    where = f"{fault[1]} at write {fault[0]}"
    shim.arm(work, *fault)
    try:
        commanded(*job.words(work))
        return row.count("harmless" if job.found(work) == right else "silent", where)
    except UserError as error:
        kind, where = "refused", f"{where}: {error}"
    except Exception as error:
        kind, where = "lost", f"{where}: {type(error).__name__}: {error}"
    finally:
        shim.disarm()
    try:
        commanded(*job.words(work))
        if job.found(work) != right:
            kind = "silent"
    except Exception as error:
        kind, where = "lost", f"{where}; then {type(error).__name__}: {error}"
    row.count(kind, where)
