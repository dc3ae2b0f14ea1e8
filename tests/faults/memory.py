"""Memory that is refused: a line for people, or an end by a signal; the same command then brings all back."""

import os
import random
import time
from collections.abc import Iterator
from pathlib import Path

from tests.faults import shim
from tests.faults.jobs import Job, fresh, jobs
from tests.faults.kills import LATE, ended, started
from tests.faults.others import right_of
from tests.faults.outcome import Row, Size
from tests.faults.places import Places

BLOCKS = 300  # at most, that a process gets before it is refused more


def rows(places: Places, size: Size, scratch: Path) -> Iterator[Row]:
    """A row for each command."""
    made = jobs(places)
    for name in ("data", "train", "release", "stream"):
        yield _starved(made[name], size, scratch / "work")


def _starved(job: Job, size: Size, work: Path) -> Row:
    """All large blocks of memory are refused from some moment on. C++ code ends by a signal then, as by a kill."""
    row = Row("memory refused", job.name, size.seed)
    began, draw, right = time.monotonic(), random.Random(size.seed), right_of(job, work)
    for _ in size.places(LATE * size.moments):
        if row.cases >= size.moments:
            break
        nth = int(BLOCKS ** draw.random())
        fresh(job, work)
        code, said = ended(started(job, work, shim.starving(Path(os.environ["FAULTS"]), nth)))
        where = f"at block {nth}: exit code {code}: {said[-200:]}"
        if code == 0:  # it needed fewer
            continue
        again, _ = ended(started(job, work, {}))
        if again or job.found(work) != right:
            row.count("lost" if again else "silent", where)
        elif code == 2 and said.count("jaxunshear: error: ") == 1:
            row.count("refused")
        else:
            row.count("harmless" if code < 0 else "lost", where)
    row.seconds = time.monotonic() - began
    return row
