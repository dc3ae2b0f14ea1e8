"""Commands that write, and what must come out of each, whatever happens to it."""

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from jaxunshear.config.load import load_experiment
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.stored_sets import open_set
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import Results
from jaxunshear.results.sweep import SweepResult
from jaxunshear.training.checkpoint import compute_weights_digest, load_best
from tests.faults.outcome import compute_array_digest, compute_digest, run_command
from tests.faults.places import PINS, RECORDED, ROOT, TINY, Places
from tests.helpers.reproducible import select_results, select_sweep

POSENET = ("--networks", "posenet", "--network", "posenet")


@dataclass(frozen=True)
class Job:
    """A command that writes into a folder, which `read` reads what must be the same of.

    `says_killed`: whether what came out says that a part was killed; then the command with `retry`
    behind it must bring that back. Of a word (name,) the folder is a part of this name.
    """

    name: str
    words: tuple[object, ...]
    read: Callable[[Path], object]
    copied: str = ""  # the name of a copy of the smallest run that it starts from
    program: tuple[str, ...] = (sys.executable, "-m", "jaxunshear")
    says_killed: Callable[[Path], bool] = lambda work: False
    retry: tuple[str, ...] = ()

    def list_words(self, work: Path) -> list[object]:
        return [work.joinpath(*word) if isinstance(word, tuple) else word for word in self.words]

    def prepare(self, work: Path, places: Places) -> None:
        """Leave nothing in `work` but what the command starts from."""
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        if self.copied:
            shutil.copytree(places.run, work / self.copied)

    def run(self, work: Path) -> object:
        """Run the command in this process, and read what it made."""
        run_command(*self.list_words(work))
        return self.read(work)


def make_jobs(places: Places) -> dict[str, Job]:
    """Make the jobs, by name. What they read lies elsewhere, and is complete."""
    run, data, frames, out = places.run, places.data, places.frames, ("--out", ())
    own_data = ("--data", ("d",))
    pins = ("--recordings", places.recording, "--name", "pins", *PINS)
    lines = ("--lines", ("lines.jsonl",))
    jobs = (
        Job("data", ("data", TINY, *own_data, *out), _read_sets),
        Job("train", ("train", TINY, *POSENET, "--data", data, *out), _read_weights),
        Job("evaluate", ("evaluate", TINY, "--data", data, *out), _score("tiny"), "tiny"),
        Job("report", ("report", ("tiny",)), _read_page, "tiny"),
        Job("release", ("release", run, "--out", ("w",)), _read_files("w")),
        Job(
            "unshear",
            ("unshear", frames, "--force", "--model", run, "--out", ("u",)),
            _read_files("u"),
        ),
        # a page holds the time that it was made in
        Job("compare", ("compare", run, ("other",), "--out", ("c",)), _list_files, "other"),
        Job("stream", ("stream", frames, "--model", places.pins, *lines), _read_lines),
        Job("run, recorded", ("run", RECORDED, *pins, *own_data, *out), _score("pins")),
        Job(
            "servo",
            ("servo", "--stimulus", "disk", "--starts", 1, "--ways", "true", "--out", ("servo",)),
            _read_trajectories,
        ),
        Job(
            "sweep",
            ("sweep", ()),
            _read_table,
            program=(sys.executable, str(ROOT / "tests/sweep/stand_in.py")),
            says_killed=_has_killed_rows,
            retry=("retry",),
        ),
    )
    return {job.name: job for job in jobs}


def _read_sets(work: Path) -> object:
    experiment = load_experiment(TINY)
    rows = []
    for settings in (experiment.paired, experiment.pose):
        reader = open_set(settings, work / "d", experiment.sensor)
        rows += [compute_array_digest(reader.rows(split)) for split in SPLITS]
    return rows


def _read_weights(work: Path) -> object:
    return compute_weights_digest(load_best(work / "tiny" / "posenet"))


def _score(name: str) -> Callable[[Path], object]:
    def read(work: Path) -> object:
        return select_results(read_record(work / name / "results.json", Results, "again"))

    return read


def _read_page(work: Path) -> object:
    return compute_digest([work / "tiny" / "report.html"])


def _read_files(name: str) -> Callable[[Path], object]:
    """Read all files of a folder, by name and content."""

    def read(work: Path) -> object:
        files = (file for file in (work / name).rglob("*") if file.is_file())
        return {file.name: compute_digest([file]) for file in files}

    return read


def _list_files(work: Path) -> object:
    return sorted(file.name for file in (work / "c").rglob("*"))


def _read_lines(work: Path) -> object:
    lines = [json.loads(line) for line in (work / "lines.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if name != "ms"} for line in lines]


def _read_trajectories(work: Path) -> object:
    from jaxunshear.downstream.servo import load_trajectories

    digests = []
    for file in sorted((work / "servo").rglob("*.npz")):
        fields = vars(load_trajectories(file)[1])
        times = ("perceive_s", "simulate_s")
        digests.append(
            compute_array_digest({name: fields[name] for name in fields if name not in times})
        )
    return digests


_read_sweep = partial(read_record, kind=SweepResult, remedy="again")


def _read_table(work: Path) -> object:
    return select_sweep(_read_sweep(work / "small" / "sweep.json"))


def _has_killed_rows(work: Path) -> bool:
    cells = _read_sweep(work / "small" / "sweep.json").cells
    failures = [failure for cell in cells for failure in cell.failures]
    return any("killed by signal 9" in (failure.reason or "") for failure in failures)
