"""Compare finished runs: the settings that differ, scores with intervals, and training times.

Both runs of a difference were scored on the same contacts, and each resample draws the same poses
for both. The runs' folders are read; nothing is written there. Imports no JAX.
"""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxunshear.config.configs import list_differences as differing_fields
from jaxunshear.errors import UserError
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.files import read_object_if_sound, write_text
from jaxunshear.model_folders import make_distinct_names
from jaxunshear.output_checks import check_new_folder
from jaxunshear.progress import format_duration
from jaxunshear.protected_folders import check_outside
from jaxunshear.report import html, labels
from jaxunshear.report.training_sections import RETRAIN_REMEDY
from jaxunshear.results.measurement import TrainingSummary
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import EVALUATE_REMEDY, Results
from jaxunshear.results.sweep import Figure, Outcome
from jaxunshear.sweep.scores import RowScores, has_same_contacts, read_tests
from jaxunshear.sweep.summary import compute_differences, compute_metrics
from jaxunshear.text_table import format_text_table

NAME_SETTINGS = ("name", "claim", "paired.config", "pose.config")  # settings that change no score
SIMILARITY_TABLES = (
    "ms_ssim",
    "swap",
    "pins",
    "pin_error",
)  # tables of scores of images, or of pins
WITHIN_RUN_TABLE = "difference"  # table of the networks of one run, which its report has
MAX_NAME_LENGTH = 100  # letters of a page's name
NONE = "\u2013"
CAVEAT = (
    "Brackets: 95 % bootstrap intervals over test poses of one training each. They do not cover "
    "other trainings; `jaxunshear sweep FILE --seeds 0,1,2` gives intervals over seeds and poses."
)


class Run(NamedTuple):
    name: str
    folder: Path
    measured: RowScores  # results.json, and the scores of every test contact
    seconds: dict[str, float]  # of training, by network
    data: str | None  # version of the data set that a network learnt from

    @property
    def results(self) -> Results:
        return self.measured.outcome.evaluated_results

    @property
    def network(self) -> str:
        """Return the network that the run is about; "sheared" where nothing is unsheared."""
        return choose_main_kind(self.results.ms_ssim or self.results.pose_mae)


class Score(NamedTuple):
    """One score of all runs; None where a run has none."""

    name: str  # as in a sweep: `pose/tap/edge_mm`, `unseen: ms_ssim/disentangled`
    values: tuple[Figure | None, ...]
    changes: tuple[Figure | None, ...]  # less the first run's


class Comparison(NamedTuple):
    runs: list[Run]
    settings: dict[str, list[str]]  # each run's value, by dotted name of a setting that differs
    scores: list[Score]
    notes: list[str]  # what hinders the comparison


def write_comparison(folders: Sequence[Path], out: Path) -> tuple[str, Path]:
    """Write out/<first>-<second>....html; return text for a terminal and the page's path.

    Raises UserError where a run is not finished, damaged or named twice.
    """
    check_new_folder(out)
    check_outside(out, "--out")
    runs = read_runs(folders)
    found = Comparison(runs, compare_settings(runs), compare_scores(runs), note_obstacles(runs))
    name = re.sub(r"[^A-Za-z0-9._]+", "-", "-".join(run.name for run in runs))[:MAX_NAME_LENGTH]
    path = out / f"{name}.html"
    write_text(path, make_page(found))
    return make_text(found), path


def read_runs(folders: Sequence[Path]) -> list[Run]:
    """Read finished runs; the first is the reference. Raises UserError."""
    if len(folders) < 2:
        raise UserError(f"compare takes two runs or more, not {folders[0]} alone: name another")
    seen: dict[str, Path] = {}
    for folder in folders:
        if other := seen.get(os.path.realpath(folder)):
            raise UserError(f"{other} and {folder} are the same run: name each run once")
        seen[os.path.realpath(folder)] = folder
    return list(map(_read_run, make_distinct_names(folders), folders))


def _read_run(name: str, folder: Path) -> Run:
    if not (folder / "results.json").is_file():
        if (folder / "experiment.json").is_file():
            raise UserError(f"{folder} is not finished: run its command again, which goes on")
        raise UserError(f"{folder} holds no results.json: name a finished run, such as runs/demo")
    results = read_record(folder / "results.json", Results, EVALUATE_REMEDY)
    outcome = Outcome(status="done", reason=None, results=results)
    seconds, data = {}, None
    for network in results.settings["networks"]:
        model = read_object_if_sound(folder / network / "model.json") or {}
        data = data or (model.get("origin") or {}).get("version")
        if (file := folder / network / "summary.json").exists():
            seconds[network] = read_record(file, TrainingSummary, RETRAIN_REMEDY).train_seconds
    return Run(name, folder, RowScores(outcome, read_tests(folder, EVALUATE_REMEDY)), seconds, data)


def compare_settings(runs: Sequence[Run]) -> dict[str, list[str]]:
    """Give each setting that is not the same in all runs, by dotted name: its value in each."""
    held = [run.results.settings for run in runs]
    names = {name for other in held[1:] for name in differing_fields(dict(held[0]), dict(other))}
    differing = sorted(names - {*NAME_SETTINGS})
    return {name: [_show_setting(settings, name) for settings in held] for name in differing}


def _show_setting(value: object, name: str) -> str:
    """Write a setting as a command line does; a dash where a run has no such setting."""
    for part in name.split("."):
        if not isinstance(value, dict) or part not in value:
            return NONE
        value = value[part]
    if isinstance(value, list | tuple):
        return ",".join(map(str, value))
    if isinstance(value, bool):
        return str(value).lower()
    return "none" if value in (None, "") else str(value)


def compare_scores(runs: Sequence[Run]) -> list[Score]:
    """Give all scores that any run has, in the order of the first that has them."""
    rows = [{0: run.measured} for run in runs]  # as of a sweep with one seed
    values, changes = (
        [compute_metrics(row) for row in rows],
        [compute_differences(row, rows[0]) for row in rows],
    )
    for run, change in zip(runs, changes, strict=True):
        for name in list(change):
            likeness = find_table_name(name) in SIMILARITY_TABLES and not _same_inputs(run, runs[0])
            if run is runs[0] or likeness or not _same_test(run, runs[0]):
                del change[name]
    scores = []
    for name in dict.fromkeys(
        name for each in values for name in each if find_table_name(name) != WITHIN_RUN_TABLE
    ):
        columns = (tuple(each.get(name) for each in part) for part in (values, changes))
        scores.append(Score(name, *columns))
    return scores


def find_table_name(name: str) -> str:
    """Return the table of results that a score belongs to."""
    return name.rpartition(": ")[2].partition("/")[0]


def _same_test(run: Run, other: Run) -> bool:
    """Say whether both were scored on the same test contacts, of data of one version."""
    if run.data != other.data or "" not in run.measured.tests.keys() & other.measured.tests.keys():
        return False
    same_kind = run.results.simulated == other.results.simulated
    return same_kind and has_same_contacts({0: run.measured}, {0: other.measured}, "")


def _same_inputs(run: Run, other: Run) -> bool:
    return labels.uses_pins(run.results) == labels.uses_pins(other.results)


def note_obstacles(runs: Sequence[Run]) -> list[str]:
    """Say what hinders the comparison, a line each."""
    first, notes = runs[0], []
    for run in runs[1:]:
        if not _same_test(run, first):
            test = f"{run.name} was scored on another test set than {first.name}"
            notes.append(f"{test}: no differences are given")
        if not _same_inputs(run, first):
            kinds = f"of {run.name} and {first.name} one reads pins, one images"
            notes.append(f"{kinds}: their likeness is not compared")
    every = dict.fromkeys(network for run in runs for network in run.results.settings["networks"])
    for run in runs:
        lacks = [network for network in every if network not in run.results.settings["networks"]]
        if lacks:
            notes.append(f"{run.name} has no {', '.join(lacks)}")
    return notes


def choose_main(found: Comparison) -> list[Score]:
    """Choose the scores of the networks that the runs are about."""
    chief = labels.list_main_targets(found.runs[0].results)
    wanted = []
    for network in dict.fromkeys(run.network for run in found.runs):
        kinds = (network,) if network != "sheared" else ("tap", "sheared_learnt")
        tables = [f"{table}/{kind}" for table in ("pose", "pose_recovery") for kind in kinds]
        wanted += [f"ms_ssim/{network}", *(f"{table}/{name}" for table in tables for name in chief)]
    named = {score.name: score for score in found.scores}
    return [named[name] for name in wanted if name in named]


def _show_score(score: Score) -> list[str]:
    changes = (_show_figure(change, "+") for change in score.changes[1:])
    return [score.name, *map(_show_figure, score.values), *changes]


def _show_figure(figure: Figure | None, sign: str = "") -> str:
    if figure is None:
        return NONE
    interval = "[{:.3g}, {:.3g}]".format(*figure.interval) if figure.interval else ""
    return f"{figure.mean:{sign}.3g} {interval}".rstrip()


def _show_times(runs: Sequence[Run]) -> list[list[str]]:
    rows = []
    for network in dict.fromkeys(network for run in runs for network in run.seconds):
        times = [
            format_duration(run.seconds[network]) if network in run.seconds else NONE
            for run in runs
        ]
        rows.append([f"training of {network}", *times])
    return rows


def _head(runs: Sequence[Run]) -> list[str]:
    names = [run.name for run in runs]
    return ["", *names, *(f"{name} less {names[0]}" for name in names[1:])]


def make_text(found: Comparison) -> str:
    """Write what fits a terminal: the main scores, training times and settings that differ."""
    head = _head(found.runs)
    rows = [*map(_show_score, choose_main(found)), *_show_times(found.runs)]
    table = format_text_table([dict(zip(head, row, strict=False)) for row in rows], head)
    settings = [f"{name} {' | '.join(values)}" for name, values in found.settings.items()]
    more = f" and {len(settings) - 6} more" if len(settings) > 6 else ""
    differ = f"settings that differ: {'; '.join(settings[:6]) or 'none'}{more}"
    return "\n".join([*found.notes, table, differ, CAVEAT])


def make_page(found: Comparison) -> str:
    """Write the complete page; the same runs give the same bytes."""
    runs, head, main = found.runs, _head(found.runs), choose_main(found)
    names = [run.name for run in runs]
    rest = [_show_score(score) for score in found.scores if score not in main]
    settings = [[name, *values] for name, values in found.settings.items()]
    commands = [f"{run.name} ({run.folder}): {run.results.command}" for run in runs]
    lead = f"Differences are of the other runs less {names[0]}, the reference. {CAVEAT}"
    return html.page(
        f"jaxunshear: {' and '.join(names)}",
        html.compared(names, found.notes, lead),
        html.section("Settings that differ", "", html.table(["", *names], settings)),
        html.section("Main scores", "", html.table(head, [_show_score(score) for score in main])),
        html.section("Training times", "", html.table(["", *names], _show_times(runs))),
        html.section("All other scores", "", html.folded(len(rest), html.table(head, rest))),
        html.section("Commands", "", html.code("\n".join(commands))),
    )
