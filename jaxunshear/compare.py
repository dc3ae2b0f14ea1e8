"""Compare finished runs: differing settings, scores with intervals, and training times.

Both runs of a difference were scored on the same contacts, and each resample draws the same poses
for both. The runs' folders are read; nothing is written there.
"""

import itertools
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxunshear.config.configs import list_differences
from jaxunshear.config.serialization import check_finished_run
from jaxunshear.errors import UserError
from jaxunshear.evaluation.score import choose_main_kind
from jaxunshear.files import read_object_if_sound, write_text
from jaxunshear.progress import format_duration
from jaxunshear.report import html, wording
from jaxunshear.report.training_sections import RETRAIN_REMEDY
from jaxunshear.results.measurement import TrainingSummary
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import EVALUATE_REMEDY, Results
from jaxunshear.results.sweep import Figure, Outcome
from jaxunshear.sweep.scores import RowScores, has_same_contacts, read_tests
from jaxunshear.sweep.summary import compute_differences, compute_metrics
from jaxunshear.text_table import format_text_table

NAME_SETTINGS = {"name", "claim", "paired.config", "pose.config"}  # settings that change no score
SIMILARITY_TABLES = ("ms_ssim", "swap", "pins", "pin_error")  # of scores of images, or of pins
WITHIN_RUN_TABLE = "difference"  # between the networks of one run, which its report shows
MAX_LISTED_SETTINGS = 6  # in the text; the page has all
MAX_NAME_LENGTH = 100  # letters of a page's name
NONE = "\u2013"
CAVEAT = (
    "Brackets: 95 % bootstrap intervals over test poses of one training each. They do not cover "
    "other trainings; `jaxunshear sweep EXPERIMENT --seeds 0,1,2` gives intervals over seeds "
    "and poses."
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
    def input(self) -> str | None:
        return self.results.settings["unshear"].get("input")


class Score(NamedTuple):
    """One score of all runs; None for a run without it."""

    name: str  # as in a sweep: `pose/tap/edge_mm`, `unseen: ms_ssim/disentangled`
    values: list[Figure | None]
    changes: list[Figure | None]  # less the first run's


def write_comparison(folders: Sequence[Path], out: Path) -> tuple[str, Path]:
    """Write out/<first>-<second>....html; return text for a terminal and the page's path.

    Raises UserError if a run is not finished, damaged or named twice.
    """
    runs = read_runs(folders)
    settings, scores, notes = compare_settings(runs), compare_scores(runs), note_obstacles(runs)
    main_names = _list_main_scores(runs)
    main = [score for name in main_names for score in scores if score.name == name]
    rest = [score for score in scores if score.name not in main_names]
    names = [run.name for run in runs]
    head = ["", *names, *(f"{name} less {names[0]}" for name in names[1:])]
    lead = f"Differences are of the other runs less {names[0]}, the reference. {CAVEAT}"
    commands = [f"{run.name} ({run.folder}): {run.results.command}" for run in runs]
    times, folded = _format_times(runs), html.table(head, _format_scores(rest))
    page = html.page(
        f"jaxunshear: {' and '.join(names)}",
        html.compared(names, notes, lead),
        html.section(
            "Settings that differ",
            "",
            html.table(["", *names], [[name, *values] for name, values in settings.items()]),
        ),
        html.section("Main scores", "", html.table(head, _format_scores(main))),
        html.section("Training times", "", html.table(["", *names], times)),
        html.section("All other scores", "", html.folded(len(rest), folded)),
        html.section("Commands", "", html.code("\n".join(commands))),
    )
    path = out / f"{re.sub(r'[^A-Za-z0-9._]+', '-', '-'.join(names))[:MAX_NAME_LENGTH]}.html"
    write_text(path, page)
    rows = [dict(zip(head, row, strict=False)) for row in _format_scores(main) + times]
    listed = [f"{name} {' | '.join(values)}" for name, values in settings.items()]
    text = f"settings that differ: {'; '.join(listed[:MAX_LISTED_SETTINGS]) or 'none'}"
    if len(listed) > MAX_LISTED_SETTINGS:
        text += f" and {len(listed) - MAX_LISTED_SETTINGS} more"
    return "\n".join([*notes, format_text_table(rows, head), text, CAVEAT]), path


def read_runs(folders: Sequence[Path]) -> list[Run]:
    """Read finished runs; the first is the reference. Raises UserError."""
    if len(folders) < 2:
        raise UserError(f"compare takes two runs or more, not {folders[0]} alone: name another")
    for folder, other in itertools.combinations(folders, 2):
        if folder.resolve() == other.resolve():
            raise UserError(f"{folder} and {other} are the same run: name each run once")
    return list(map(_read_run, _make_distinct_names(folders), folders))


def _make_distinct_names(folders: Sequence[Path]) -> list[str]:
    """Return the folders' names, or as much of the ends of their paths as distinguishes them."""
    parts = [Path(os.path.abspath(folder)).parts for folder in folders]
    for count in range(1, max(map(len, parts))):
        names = ["/".join(part[-count:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [str(folder) for folder in folders]


def _read_run(name: str, folder: Path) -> Run:
    check_finished_run(folder)
    results = read_record(folder / "results.json", Results, EVALUATE_REMEDY)
    if results.frames:
        raise UserError(f"{folder} is about several tasks: name the folder of one, {folder}/TASK")
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
    settings = [dict(run.results.settings) for run in runs]
    lists = [list_differences(settings[0], other) for other in settings[1:]]
    differing = {}
    for name in sorted(set().union(*lists) - NAME_SETTINGS):
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
    values = [compute_metrics({0: run.scores}) for run in runs]  # as in a sweep with one seed
    changes = [_compare_to_reference(run, runs[0]) for run in runs]
    scores = []
    for name in dict.fromkeys(itertools.chain(*values)):
        if _get_table_name(name) != WITHIN_RUN_TABLE:
            differences = [each.get(name) for each in changes]
            scores.append(Score(name, [each.get(name) for each in values], differences))
    return scores


def _compare_to_reference(run: Run, reference: Run) -> dict[str, Figure]:
    """Compute the differences of a run's scores from those of the reference, if comparable."""
    if run is reference or not _has_same_test(run, reference):
        return {}
    excluded = () if run.input == reference.input else SIMILARITY_TABLES
    differences = compute_differences({0: run.scores}, {0: reference.scores})
    return {
        name: figure
        for name, figure in differences.items()
        if _get_table_name(name) not in excluded
    }


def _get_table_name(name: str) -> str:
    """Return the table of results that a score belongs to."""
    return name.rpartition(": ")[2].partition("/")[0]


def _has_same_test(run: Run, other: Run) -> bool:
    """Say whether both were scored on the same test contacts, from data of one version."""
    if run.data != other.data or "" not in run.scores.tests or "" not in other.scores.tests:
        return False
    return has_same_contacts({0: run.scores}, {0: other.scores}, "")


def note_obstacles(runs: Sequence[Run]) -> list[str]:
    """Describe each obstacle to the comparison in a line."""
    first, notes = runs[0], []
    for run in runs[1:]:
        if not _has_same_test(run, first):
            test = f"{run.name} was scored on another test set than {first.name}"
            notes.append(f"{test}: no differences are given")
        if run.input != first.input:
            kinds = f"of {run.name} and {first.name} one reads pins, one images"
            notes.append(f"{kinds}: their likeness is not compared")
    networks = [run.results.settings["networks"] for run in runs]
    for run, own in zip(runs, networks, strict=True):
        others = dict.fromkeys(itertools.chain(*networks))
        if missing := ", ".join(name for name in others if name not in own):
            notes.append(f"{run.name} has no {missing}")
    return notes


def _list_main_scores(runs: Sequence[Run]) -> list[str]:
    """List the names of the scores of the runs' main networks."""
    targets = wording.list_main_targets(runs[0].results)
    main = [choose_main_kind(run.results.ms_ssim or run.results.pose_mae) for run in runs]
    names = []
    for network in dict.fromkeys(main):
        names.append(f"ms_ssim/{network}")
        kinds = (network,) if network != "sheared" else ("tap", "sheared_learnt")
        for table, kind in itertools.product(("pose", "pose_recovery"), kinds):
            names += [f"{table}/{kind}/{target}" for target in targets]
    return names


def _format_scores(scores: Sequence[Score]) -> list[list[str]]:
    rows = []
    for name, values, changes in scores:
        differences = (_format_figure(change, "+") for change in changes[1:])
        rows.append([name, *map(_format_figure, values), *differences])
    return rows


def _format_figure(figure: Figure | None, sign: str = "") -> str:
    if figure is None:
        return NONE
    interval = "[{:.3g}, {:.3g}]".format(*figure.interval) if figure.interval else ""
    return f"{figure.mean:{sign}.3g} {interval}".rstrip()


def _format_times(runs: Sequence[Run]) -> list[list[str]]:
    """Format a row of training times for each network."""
    rows = []
    for network in dict.fromkeys(itertools.chain(*(run.seconds for run in runs))):
        seconds = (run.seconds.get(network) for run in runs)
        times = (NONE if each is None else format_duration(each) for each in seconds)
        rows.append([f"training of {network}", *times])
    return rows
