"""Compare finished runs: differing settings, scores with intervals, and training times.

Both runs of a difference were scored on the same contacts, and each resample draws the same poses
for both. The runs' folders are read; nothing is written there. Imports no JAX.
"""

import itertools
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxunshear.config.configs import list_differences
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
SIMILARITY_TABLES = ("ms_ssim", "swap", "pins", "pin_error")  # of scores of images, or of pins
WITHIN_RUN_TABLE = "difference"  # between the networks of one run, which its report shows
MAX_LISTED_SETTINGS = 6  # in the text; the page has all
MAX_NAME_LENGTH = 100  # letters of a page's name
NONE = "\u2013"
CAVEAT = (
    "Brackets: 95 % bootstrap intervals over test poses of one training each. They do not cover "
    "other trainings; `jaxunshear sweep FILE --seeds 0,1,2` gives intervals over seeds and poses."
)


class Run(NamedTuple):
    """A finished run."""

    name: str
    folder: Path
    scores: RowScores  # results.json, and the scores of every test contact
    seconds: dict[str, float]  # of training, by network
    data: str | None  # version of the training data

    @property
    def results(self) -> Results:
        return self.scores.outcome.evaluated_results

    @property
    def network(self) -> str:
        """Return the main network of the run; "sheared" if it unshears nothing."""
        return choose_main_kind(self.results.ms_ssim or self.results.pose_mae)


class Score(NamedTuple):
    """One score of all runs; None for a run without it."""

    name: str  # as in a sweep: `pose/tap/edge_mm`, `unseen: ms_ssim/disentangled`
    values: tuple[Figure | None, ...]
    changes: tuple[Figure | None, ...]  # less the first run's


class Comparison(NamedTuple):
    """All that a page shows."""

    runs: list[Run]
    settings: dict[str, list[str]]  # each run's value, by dotted name of a setting that differs
    scores: list[Score]
    notes: list[str]  # obstacles to the comparison


def write_comparison(folders: Sequence[Path], out: Path) -> tuple[str, Path]:
    """Write out/<first>-<second>....html; return text for a terminal and the page's path.

    Raises UserError if a run is not finished, damaged or named twice.
    """
    check_new_folder(out)
    check_outside(out, "--out")
    runs = read_runs(folders)
    comparison = Comparison(
        runs, compare_settings(runs), compare_scores(runs), note_obstacles(runs)
    )
    name = re.sub(r"[^A-Za-z0-9._]+", "-", "-".join(run.name for run in runs))[:MAX_NAME_LENGTH]
    path = out / f"{name}.html"
    write_text(path, make_page(comparison))
    return make_text(comparison), path


def read_runs(folders: Sequence[Path]) -> list[Run]:
    """Read finished runs; the first is the reference. Raises UserError."""
    if len(folders) < 2:
        raise UserError(f"compare takes two runs or more, not {folders[0]} alone: name another")
    real_paths: dict[str, Path] = {}
    for folder in folders:
        real_path = os.path.realpath(folder)
        if other := real_paths.get(real_path):
            raise UserError(f"{other} and {folder} are the same run: name each run once")
        real_paths[real_path] = folder
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
    """Compare settings: the values in all runs of each one that differs, by dotted name."""
    settings = [run.results.settings for run in runs]
    names: set[str] = set()
    for other in settings[1:]:
        names.update(list_differences(dict(settings[0]), dict(other)))
    differing = {}
    for name in sorted(names - {*NAME_SETTINGS}):
        differing[name] = [_format_setting(values, name) for values in settings]
    return differing


def _format_setting(value: object, name: str) -> str:
    """Format a setting as on a command line; a dash if a run has no such setting."""
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
    """List all scores that any run has, in the order of the first run with them."""
    values, changes = [], []
    names: dict[str, None] = {}
    for run in runs:
        metrics = compute_metrics({0: run.scores})  # as in a sweep with one seed
        values.append(metrics)
        changes.append({} if run is runs[0] else _compare_to_reference(run, runs[0]))
        names |= dict.fromkeys(metrics)
    scores = []
    for name in names:
        if get_table_name(name) != WITHIN_RUN_TABLE:
            figures = tuple(metrics.get(name) for metrics in values)
            differences = tuple(change.get(name) for change in changes)
            scores.append(Score(name, figures, differences))
    return scores


def _compare_to_reference(run: Run, reference: Run) -> dict[str, Figure]:
    """Compute the differences of a run's scores from those of the reference."""
    if not _has_same_test(run, reference):
        return {}
    differences = compute_differences({0: run.scores}, {0: reference.scores})
    if _has_same_input(run, reference):
        return differences
    return {
        name: figure
        for name, figure in differences.items()
        if get_table_name(name) not in SIMILARITY_TABLES
    }


def get_table_name(name: str) -> str:
    """Return the table of results that a score belongs to."""
    return name.rpartition(": ")[2].partition("/")[0]


def _has_same_test(run: Run, other: Run) -> bool:
    """Say whether both were scored on the same test contacts, from data of one version."""
    if run.data != other.data or run.results.simulated != other.results.simulated:
        return False
    if "" not in run.scores.tests or "" not in other.scores.tests:
        return False
    return has_same_contacts({0: run.scores}, {0: other.scores}, "")


def _has_same_input(run: Run, other: Run) -> bool:
    return labels.uses_pins(run.results) == labels.uses_pins(other.results)


def note_obstacles(runs: Sequence[Run]) -> list[str]:
    """Describe each obstacle to the comparison in a line."""
    first, notes = runs[0], []
    for run in runs[1:]:
        if not _has_same_test(run, first):
            test = f"{run.name} was scored on another test set than {first.name}"
            notes.append(f"{test}: no differences are given")
        if not _has_same_input(run, first):
            kinds = f"of {run.name} and {first.name} one reads pins, one images"
            notes.append(f"{kinds}: their likeness is not compared")
    networks: dict[str, None] = {}
    for run in runs:
        networks |= dict.fromkeys(run.results.settings["networks"])
    for run in runs:
        missing = [name for name in networks if name not in run.results.settings["networks"]]
        if missing:
            notes.append(f"{run.name} has no {', '.join(missing)}")
    return notes


def choose_main(comparison: Comparison) -> list[Score]:
    """Choose the scores of the runs' main networks."""
    targets = labels.list_main_targets(comparison.runs[0].results)
    names = []
    for network in dict.fromkeys(run.network for run in comparison.runs):
        names.append(f"ms_ssim/{network}")
        kinds = (network,) if network != "sheared" else ("tap", "sheared_learnt")
        for table, kind in itertools.product(("pose", "pose_recovery"), kinds):
            names += [f"{table}/{kind}/{target}" for target in targets]
    by_name = {score.name: score for score in comparison.scores}
    return [by_name[name] for name in names if name in by_name]


def _format_score(score: Score) -> list[str]:
    changes = (_format_figure(change, "+") for change in score.changes[1:])
    return [score.name, *map(_format_figure, score.values), *changes]


def _format_figure(figure: Figure | None, sign: str = "") -> str:
    if figure is None:
        return NONE
    interval = "[{:.3g}, {:.3g}]".format(*figure.interval) if figure.interval else ""
    return f"{figure.mean:{sign}.3g} {interval}".rstrip()


def _format_times(runs: Sequence[Run]) -> list[list[str]]:
    """Format a row of training times for each network."""
    rows: dict[str, list[str]] = {}
    for index, run in enumerate(runs):
        for network, seconds in run.seconds.items():
            times = rows.setdefault(network, [NONE] * len(runs))
            times[index] = format_duration(seconds)
    return [[f"training of {network}", *times] for network, times in rows.items()]


def _make_head(runs: Sequence[Run]) -> list[str]:
    names = [run.name for run in runs]
    return ["", *names, *(f"{name} less {names[0]}" for name in names[1:])]


def make_text(comparison: Comparison) -> str:
    """Write the main scores, training times and settings that differ, for a terminal."""
    head = _make_head(comparison.runs)
    rows = [*map(_format_score, choose_main(comparison)), *_format_times(comparison.runs)]
    table = format_text_table([dict(zip(head, row, strict=False)) for row in rows], head)
    settings = [f"{name} {' | '.join(values)}" for name, values in comparison.settings.items()]
    listed = "; ".join(settings[:MAX_LISTED_SETTINGS]) or "none"
    if len(settings) > MAX_LISTED_SETTINGS:
        listed += f" and {len(settings) - MAX_LISTED_SETTINGS} more"
    return "\n".join([*comparison.notes, table, f"settings that differ: {listed}", CAVEAT])


def make_page(comparison: Comparison) -> str:
    """Write the complete page; the same runs give the same bytes."""
    runs, main = comparison.runs, choose_main(comparison)
    head, names = _make_head(runs), [run.name for run in runs]
    rest = [_format_score(score) for score in comparison.scores if score not in main]
    settings = [[name, *values] for name, values in comparison.settings.items()]
    commands = [f"{run.name} ({run.folder}): {run.results.command}" for run in runs]
    lead = f"Differences are of the other runs less {names[0]}, the reference. {CAVEAT}"
    return html.page(
        f"jaxunshear: {' and '.join(names)}",
        html.compared(names, comparison.notes, lead),
        html.section("Settings that differ", "", html.table(["", *names], settings)),
        html.section("Main scores", "", html.table(head, [*map(_format_score, main)])),
        html.section("Training times", "", html.table(["", *names], _format_times(runs))),
        html.section("All other scores", "", html.folded(len(rest), html.table(head, rest))),
        html.section("Commands", "", html.code("\n".join(commands))),
    )
