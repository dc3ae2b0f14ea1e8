"""Commands that write, and what must come out of each whatever befalls it."""

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from jaxunshear.config.load import load_experiment
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.reader import open_set
from jaxunshear.evaluation.measurements import select_reproducible
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import Results
from jaxunshear.results.sweep import SweepResult
from jaxunshear.training.checkpoint import compute_weights_digest
from tests.faults.corruption import bits
from tests.faults.outcome import digest
from tests.faults.places import PINS, RECORDED, ROOT, TINY, Places

TAPE = ("--networks", "posenet", "--network", "posenet")


@dataclass(frozen=True)
class Job:
    """`words(work)`: the command that writes below the folder `work`; `found(work)`: what must be the same of it.

    `named(work)`: whether what came out says that a part was killed; then the command with `again` behind it must bring that back.
    """

    name: str
    words: Callable[[Path], tuple[object, ...]]
    found: Callable[[Path], object]
    prepare: Callable[[Path], object] = lambda work: None
    program: tuple[str, ...] = (sys.executable, "-m", "jaxunshear")
    named: Callable[[Path], bool] = lambda work: False
    again: tuple[str, ...] = ()


def jobs(places: Places) -> dict[str, Job]:
    """By name. What they read lies elsewhere, and is complete."""
    run, data, frames = places.run, places.data, places.frames

    def of_run(work: Path) -> None:
        shutil.copytree(run, work / "tiny")

    def other(work: Path) -> None:
        shutil.copytree(run, work / "other")

    def trained(work: Path) -> object:
        return compute_weights_digest(work / "tiny" / "posenet")

    def scored(name: str) -> Callable[[Path], object]:
        return lambda work: select_reproducible(
            read_record(work / name / "results.json", Results, "again")
        )

    def answered(work: Path) -> object:
        lines = [json.loads(line) for line in (work / "lines.jsonl").read_text().splitlines()]
        return [{name: value for name, value in line.items() if name != "ms"} for line in lines]

    pins = ("--recordings", places.recording, "--name", "pins", *PINS)
    made = [
        Job("data", lambda work: ("data", TINY, "--data", work / "d", "--out", work), _rows),
        Job("train", lambda work: ("train", TINY, *TAPE, "--data", data, "--out", work), trained),
        Job(
            "evaluate",
            lambda work: ("evaluate", TINY, "--data", data, "--out", work),
            scored("tiny"),
            of_run,
        ),
        Job("report", lambda work: ("report", work / "tiny"), _page, of_run),
        Job("release", lambda work: ("release", run, "--out", work / "w"), _files("w")),
        Job(
            "unshear",
            lambda work: ("unshear", frames, "--force", "--model", run, "--out", work / "u"),
            _files("u"),
        ),
        Job(
            "compare",
            lambda work: ("compare", run, work / "other", "--out", work / "c"),
            _count("c"),
            other,
        ),
        Job("stream", lambda work: _stream(places, work), answered),
        Job(
            "run, recorded",
            lambda work: ("run", RECORDED, *pins, "--data", work / "d", "--out", work),
            scored("pins"),
        ),
        Job("servo", lambda work: _servo(work), _walks),
        Job(
            "sweep",
            lambda work: ("sweep", work),
            _table,
            program=(sys.executable, str(ROOT / "tests/sweep/stand_in.py")),
            named=_killed_rows,
            again=("retry",),
        ),
    ]
    return {job.name: job for job in made}


def fresh(job: Job, work: Path) -> None:
    """Nothing in `work` but what the command starts from."""
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    job.prepare(work)


def _stream(places: Places, work: Path) -> tuple[object, ...]:
    more = ("--no-images", "--lines", work / "lines.jsonl")
    return ("stream", places.frames, "--model", places.pins, *more)


def _servo(work: Path) -> tuple[object, ...]:
    return ("servo", "--stimulus", "disk", "--starts", 1, "--ways", "true", "--out", work / "servo")


def _rows(work: Path) -> object:
    experiment = load_experiment(TINY)
    sets = (
        open_set(one, work / "d", experiment.sensor) for one in (experiment.paired, experiment.pose)
    )
    return [bits(reader.rows(split)) for reader in sets for split in SPLITS]


def _page(work: Path) -> object:
    return digest([work / "tiny" / "report.html", work / "tiny" / "montage.png"])


def _files(name: str) -> Callable[[Path], object]:
    """All of them, by name and content."""
    return lambda work: {
        file.name: digest([file]) for file in sorted((work / name).rglob("*")) if file.is_file()
    }


def _count(name: str) -> Callable[[Path], object]:
    """A page holds the time that it was made in."""
    return lambda work: sorted(file.name for file in (work / name).rglob("*"))


def _walks(work: Path) -> object:
    from jaxunshear.downstream.servo import load_trajectories

    walks = [vars(load_trajectories(file)[1]) for file in sorted((work / "servo").rglob("*.npz"))]
    return [
        bits({name: each[name] for name in each if name not in ("perceive_s", "simulate_s")})
        for each in walks
    ]


def _table(work: Path) -> object:
    from jaxunshear.sweep.summary import select_reproducible as same

    return same(_swept(work))


def _killed_rows(work: Path) -> bool:
    return any(
        "killed by signal 9" in failure.reason
        for cell in _swept(work).cells
        for failure in cell.failures
    )


def _swept(work: Path) -> SweepResult:
    return read_record(work / "small" / "sweep.json", SweepResult, "again")
