"""Processes that are killed at random moments, that get no memory, or that share a folder.

The same command, started again, must end with the same bits.
"""

import os
import random
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from tests.faults import shim
from tests.faults.jobs import Job, make_jobs
from tests.faults.outcome import ERROR, Outcome, Row, Size, run_cases
from tests.faults.places import ROOT, Places

TRIES = 4  # as many tries as kills: a command may be at its end before
BLOCKS = 300  # at most, that a process gets before it is refused more
MOST_WRITES = 200  # before a kill
Said = tuple[int, str]  # exit code, negative for a signal, and stderr


def list_kill_rows(places: Places, size: Size, scratch: Path) -> Iterator[Row]:
    """Yield a row for each command that is killed, by time and by write in turn."""
    jobs = make_jobs(places)
    for name in ("data", "train", "sweep", "servo", "stream", "run, recorded"):
        yield _kill(jobs[name], places, size, scratch / "work")


def list_memory_rows(places: Places, size: Size, scratch: Path) -> Iterator[Row]:
    """Yield a row for each command that is refused memory."""
    jobs = make_jobs(places)
    for name in ("data", "train", "release", "stream"):
        yield _refuse_memory(jobs[name], places, size, scratch / "work")


def start(job: Job, work: Path, environment: dict[str, str], *more: str) -> subprocess.Popen[str]:
    """Start the command in a process and a group of its own."""
    inherited = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
    return subprocess.Popen(
        [*job.program, *map(str, job.list_words(work)), *more],
        cwd=ROOT,
        env=inherited | environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def wait(process: subprocess.Popen[str], seconds: float | None = None) -> Said:
    """Wait for its end; after so many seconds kill it, with all that it started."""
    try:
        _, said = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        _, said = process.communicate()
    return process.returncode, said


def _kill(job: Job, places: Places, size: Size, work: Path) -> Row:
    job.prepare(work, places)
    begin = time.monotonic()
    code, said = wait(start(job, work, {}))
    duration = time.monotonic() - begin
    if code:
        raise RuntimeError(f"{job.name} does not run: {said[-500:]}")
    right = job.read(work)
    job.prepare(work, places)

    def try_kill(draw: random.Random) -> Outcome:
        if draw.random() < 0.5:
            nth = draw.randint(1, MOST_WRITES)
            where = f"at write {nth}"
            code, said = wait(start(job, work, shim.kill_at_write(work, nth)))
        else:
            seconds = draw.uniform(0.2, 0.9) * duration
            where = f"after {seconds:.1f} s"
            code, said = wait(start(job, work, {}), seconds)
        if code == -signal.SIGKILL:
            return Outcome("harmless")
        outcome = Outcome("lost", f"{where}: {said[-200:]}")
        if code == 0:  # it was at its end before the kill
            outcome = _compare(job, work, right, where)
        job.prepare(work, places)
        return outcome

    row = Row("kill -9 at a random moment", job.name, size.seed)
    run_cases(row, size, size.moments, try_kill, TRIES * size.moments)
    code, said = wait(start(job, work, {}))
    where = f"at the end: {said[-200:]}"
    outcome = Outcome("lost", where) if code else _compare(job, work, right, where)
    if outcome.kind is not None:
        row.count(*outcome)
    return row


def _compare(job: Job, work: Path, right: object, where: str) -> Outcome:
    """Judge an end: a result that says which part was killed must become complete on demand."""
    if job.read(work) == right:
        return Outcome(None)
    if not job.says_killed(work):
        return Outcome("silent", where)
    code, said = wait(start(job, work, {}, *job.retry))
    lost = code or job.read(work) != right
    return Outcome("lost" if lost else "refused", f"{where}, again: {said[-200:]}")


def _refuse_memory(job: Job, places: Places, size: Size, work: Path) -> Row:
    """Refuse all large blocks of memory from some moment on.

    C++ code then ends by a signal, as by a kill.
    """
    job.prepare(work, places)
    right = job.run(work)

    def try_refusal(draw: random.Random) -> Outcome:
        nth = int(BLOCKS ** draw.random())
        job.prepare(work, places)
        code, said = wait(start(job, work, shim.refuse_memory(nth)))
        where = f"at block {nth}: exit code {code}: {said[-200:]}"
        if code == 0:  # it needed fewer
            return Outcome(None)
        again, _ = wait(start(job, work, {}))
        if again or job.read(work) != right:
            return Outcome("lost" if again else "silent", where)
        if code == 2 and said.count(ERROR) == 1:
            return Outcome("refused")
        return Outcome("harmless" if code < 0 else "lost", where)

    row = Row("memory refused", job.name, size.seed)
    return run_cases(row, size, size.moments, try_refusal, TRIES * size.moments)


def run_two(job: Job, places: Places, size: Size, work: Path) -> Row:
    """Run two processes in one folder."""
    job.prepare(work, places)
    right = job.run(work)

    def try_two(draw: random.Random) -> Outcome:
        job.prepare(work, places)
        first, later = start(job, work, {}), draw.uniform(0, 3)
        time.sleep(later)
        second = wait(start(job, work, {}))
        ends = sorted((wait(first), second))
        codes = [code for code, _ in ends]
        clear = all(said.count(ERROR) == 1 for code, said in ends if code)
        if codes not in ([0, 0], [0, 2]) or not clear:
            return Outcome("lost", f"{later:.1f} s apart: exit codes {codes}")
        if job.read(work) != right:
            return Outcome("silent", f"{later:.1f} s apart")
        return Outcome("harmless" if codes == [0, 0] else "refused")

    return run_cases(
        Row("two processes in one folder", job.name, size.seed), size, size.moments, try_two
    )
