"""Finished runs as they are compared: what each left in its folder, read and nothing written. Imports no JAX."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxunshear.errors import UserError
from jaxunshear.evaluation.score import shown_kind
from jaxunshear.folders import names_apart
from jaxunshear.report.history import History, read_history
from jaxunshear.report.making import TRAINED
from jaxunshear.report.words import over_pins
from jaxunshear.results.rows import Summary
from jaxunshear.results.run import EVALUATED, Results
from jaxunshear.results.stored import read
from jaxunshear.results.sweep import Outcome
from jaxunshear.settings.configs import differences
from jaxunshear.settings.data import RENDERED
from jaxunshear.settings.registry import TRAINABLE
from jaxunshear.storage import read_object_if_sound
from jaxunshear.sweep.scores import Measured, read_tests, same_contacts

OWN = "unsheared"  # in the place of a network's name, where runs are about networks of different names
NAMES = ("name", "claim", "paired.config", "pose.config")  # settings that change no figure


class Run(NamedTuple):
    name: str  # on the page
    folder: Path
    measured: Measured  # results.json as its outcome's, and every test contact's scores
    histories: dict[str, History]  # by network, of those with a log
    endings: dict[str, Summary]  # by network
    data: str | None  # version of the data set that a network learnt from

    @property
    def results(self) -> Results:
        return self.measured.outcome.evaluated

    @property
    def rows(self) -> dict[int, Measured]:
        """As a sweep has them: one seed."""
        return {0: self.measured}

    @property
    def shown(self) -> str:
        """The network that the run is about; "sheared" where nothing is unsheared."""
        return shown_kind(self.results.ms_ssim or self.results.pose_mae)


def read_runs(folders: Sequence[Path]) -> list[Run]:
    """In their order, the first being the reference. Raises UserError: fewer than two, one named twice, one that is not finished."""
    if len(folders) < 2:
        raise UserError(f"compare takes two runs or more, not {folders[0]} alone: name another finished run")
    seen: dict[str, Path] = {}
    for folder in folders:
        if other := seen.get(os.path.realpath(folder)):
            raise UserError(f"{other} and {folder} are the same run: name each run once")
        seen[os.path.realpath(folder)] = folder
    runs = [_read(name, folder) for name, folder in zip(names_apart(folders), folders, strict=True)]
    if len({run.shown for run in runs}) > 1:
        runs = [run._replace(measured=_with_own(run)) for run in runs]
    return runs


def _read(name: str, folder: Path) -> Run:
    if not (folder / "results.json").is_file():
        if (folder / "experiment.json").is_file():
            raise UserError(f"{folder} is not finished, it holds no results.json: run the command that began it again")
        raise UserError(f"{folder} holds no results.json: name the folder of a finished run, such as runs/demo")
    results = read(folder / "results.json", Results, EVALUATED)
    logs = {network: read_history(folder / network / "log.jsonl") for network in TRAINABLE}
    endings = {network: folder / network / "summary.json" for network in logs}
    models = (read_object_if_sound(folder / network / "model.json") or {} for network in results.settings["networks"])
    versions = [(model.get("origin") or {}).get("version") for model in models]
    return Run(
        name,
        folder,
        Measured(Outcome(status="done", reason=None, results=results), read_tests(folder, EVALUATED)),
        {network: log for network, log in logs.items() if log},
        {network: read(path, Summary, TRAINED) for network, path in endings.items() if path.exists()},
        versions[0] if versions else None,
    )


def _with_own(run: Run) -> Measured:
    """Scores of the network that the run is about under `OWN`, too."""
    tests = {
        test: dict(scores)
        | {"/".join(OWN if part == run.shown else part for part in name.split("/")): scores[name] for name in scores}
        for test, scores in run.measured.tests.items()
    }
    return run.measured._replace(tests=tests)


def settings_apart(runs: Sequence[Run]) -> dict[str, list[str]]:
    """By dotted name of each setting that is not the same in all runs: its value in each."""
    held = [run.results.settings for run in runs]
    names = dict.fromkeys(name for other in held[1:] for name in differences(dict(held[0]), dict(other)))
    return {name: [_value(settings, name) for settings in held] for name in sorted(names) if name not in NAMES}


def _value(settings: object, name: str) -> str:
    """As a command line writes it; a dash where a run has no such setting."""
    for part in name.split("."):
        if not isinstance(settings, dict) or part not in settings:
            return "\u2013"
        settings = settings[part]
    return _text(settings)


def _text(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(part)}" for name, part in value.items())
    if isinstance(value, list | tuple):
        return ",".join(":".join(map(str, item)) if isinstance(item, list | tuple) else str(item) for item in value)
    return str(value).lower() if isinstance(value, bool) else "none" if value in (None, "") else str(value)


def same_test(run: Run, other: Run) -> bool:
    """Whether both were scored on the same test contacts, of data of one version."""
    if run.data != other.data or "" not in run.measured.tests.keys() & other.measured.tests.keys():
        return False
    return run.results.simulated == other.results.simulated and same_contacts(run.rows, other.rows, "")


def same_inputs(run: Run, other: Run) -> bool:
    """Whether both read images, or both pins: likeness is of what was read."""
    return over_pins(run.results) == over_pins(other.results)


def notes(runs: Sequence[Run]) -> list[str]:
    """What hinders the comparison, a line each."""
    first, *others = runs
    found = []
    for run in others:
        if run.results.simulated != first.results.simulated:
            kinds = {True: "simulated touches", False: "recordings"}
            are, were = kinds[run.results.simulated], kinds[first.results.simulated]
            found.append(
                f"{run.name} is about {are}, {first.name} about {were}: figures stand beside each other, no more"
            )
        elif not same_test(run, first):
            found.append(f"{run.name} was scored on another test set than {first.name}: no differences are given")
        if not same_inputs(run, first):
            kinds = {True: "pins", False: "images"}
            reads, read = kinds[over_pins(run.results)], kinds[over_pins(first.results)]
            found.append(
                f"{run.name} reads {reads}, {first.name} {read}: likeness is of other images, and not compared"
            )
    if any(run.results.pairing and run.results.pairing.way in RENDERED for run in runs):
        found.append("partners are drawn by each run's own renderer: likeness and pins are of each run's own partners")
    every = dict.fromkeys(network for run in runs for network in run.results.settings["networks"])
    for run in runs:
        lacks = [network for network in every if network not in run.results.settings["networks"]]
        if lacks:
            found.append(f"{run.name} has no {', '.join(lacks)}")
    return found
