"""Sections of a run's page on its making: training, times, contacts and provenance.

Training logs hold one JSON object per validation.
"""

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple, cast

from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure

from jaxunshear.config.networks import TRAINABLE
from jaxunshear.config.targets import get_unit
from jaxunshear.errors import Note
from jaxunshear.files import Json, check_and_remove_checksum, to_builtins
from jaxunshear.progress import format_duration
from jaxunshear.report import html, wording
from jaxunshear.report.wording import Wording
from jaxunshear.results.measurement import TrainingSummary
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import Results
from jaxunshear.style import ABREAST, COLOURS, INK, STYLE, encode_svg, label_log_axis, make_panels
from jaxunshear.text_table import format_operations, format_plain

RETRAIN_REMEDY = "delete it, then run the same experiment again, which goes on from the checkpoint"
DASHES = ("-", "--", ":")
CONTACT_TITLES = {
    "residual_mm": "solver residual, mm",
    "iterations": "solver iterations",
    "stuck": "nodes stuck",
    "slipping": "nodes slipping",
    "free": "nodes free",
}


class History(NamedTuple):
    """V validations of one network; all lists are of length V."""

    epoch: list[float]
    train_seconds: list[float]
    training: dict[str, list[float]]  # losses by name
    validation: dict[str, list[float]]


class Trainings(NamedTuple):
    """The logs and the summaries of a run's trainings, by network."""

    histories: dict[str, History]
    summaries: dict[str, TrainingSummary]


def build_training_section(trainings: Trainings) -> Markup:
    """Build the section with the loss curves and the summary of each training."""
    if not trainings.histories:
        return wording.section("no_training")
    rows = [
        [
            name,
            f"{summary.parameters:,}",
            format_operations(summary.operations),
            str(summary.steps),
            format_plain(summary.images_per_second),
            format_duration(summary.train_seconds),
            str(summary.best_step),
        ]
        for name, summary in trainings.summaries.items()
    ]
    head = [
        "network",
        "parameters",
        "FLOPs of a frame",
        "steps",
        "images/s",
        "training",
        "best at step",
    ]
    text = "loss over epochs of " + ", ".join(trainings.histories)
    curves = html.embed_svg(_plot_losses(trainings.histories), text)
    return wording.section("training", curves, html.table(head, rows))


def build_times_section(results: Results, words: Wording, trainings: Trainings) -> Markup:
    """Build the section on the time of each stage, and on errors over seconds of training."""
    stages = {name: value for name, value in results.time_s.items() if value is not None}
    figures = []
    if stages:
        text = "; ".join(f"{name} {value:.0f} s" for name, value in stages.items())
        figures.append(html.embed_svg(_plot_stage_times(stages), text))
    # figures of the validation that are plotted over seconds of training
    labels = {"supervised": f"unsheared {words.modality.output}, MSE"}
    for name in words.main_targets:
        quantity, unit = wording.name_quantity(name), get_unit(name)
        labels[name] = words.validation_error.format(quantity=quantity, unit=unit)
    for name, label in labels.items():
        curves = {
            key: history
            for key, history in trainings.histories.items()
            if name in history.validation
        }
        if curves:
            text = f"{label} over seconds of training"
            figures.append(html.embed_svg(_plot_error(curves, name, label), text))
    waits = []
    for name, times in results.ms_per_image.items():
        median = _format_ms(times["median"])
        p95 = _format_ms(times["p95"])
        waits.append(f"{name} {median} ms (95th percentile {p95})")
    text = f"One image at a time, compilation apart: {'; '.join(waits)}."
    note = html.soft(text) if waits else ""
    return wording.section("times", html.row(*figures), note)


def _format_ms(ms: float) -> str:
    return f"{ms:.1f}" if ms >= 1 else f"{ms:.2g}"


def build_contacts_section(results: Results) -> Markup:
    """Build the section on the solver's convergence; nothing if no contacts were simulated."""
    if not results.contact:
        return Markup()
    rows = []
    for field, entry in results.contact.items():
        values = [
            format_plain(cast(float, entry[name])) for name in ("mean", "median", "p95", "max")
        ]
        rows.append([CONTACT_TITLES.get(field, field), *values])
    counts, retried, pairs = results.counts, "", ""
    if counts.contacts is not None:
        retried = (
            f"Of {counts.contacts} contacts {counts.retried} were solved again more finely and "
            f"{counts.dropped} dropped."
        )
    if counts.train is not None:
        pairs = (
            f"Pairs: {counts.train} to train, {counts.validation} to validate, "
            f"{counts.test} to test"
        )
    poses = f"{counts.test_poses} test poses. {counts.pin_images} images had their pins found."
    return wording.section(
        "contacts",
        html.table(["sheared test contacts", "mean", "median", "95th percentile", "largest"], rows),
        html.soft(f"{retried} {pairs}; {poses}"),
    )


def build_provenance_section(results: Results) -> Markup:
    """Build the section with the command, seeds, machine, versions and settings of the run."""
    source = to_builtins(results.source) if results.source else {}
    facts = (results.seeds, to_builtins(results.machine), results.versions, source)
    tables = (html.table(("", ""), list(fact.items())) for fact in facts if fact)
    return wording.section(
        "provenance",
        html.code(results.command),
        html.row(*tables),
        html.folded("All settings", html.code(json.dumps(results.settings, indent=2))),
    )


def _plot_losses(histories: Mapping[str, History]) -> str:
    columns = min(ABREAST, len(histories))
    with rc_context(STYLE):
        figure, panels = make_panels(len(histories), columns, (3.4, 2.8))
        for axes, (network, history) in zip(panels, histories.items(), strict=True):
            colour, epoch = COLOURS.get(network, INK), history.epoch
            names = [name for name in history.validation if name in history.training]
            for name, dash in zip(names, DASHES, strict=False):
                training, validation = history.training[name], history.validation[name]
                axes.plot(epoch, training, dash, color=colour, linewidth=1, alpha=0.45)
                axes.plot(epoch, validation, dash, color=colour, linewidth=2, label=name)
            axes.set(title=network, xlabel="epoch", yscale="log")
            label_log_axis(axes.yaxis)
            axes.legend()
        for axes in panels[::columns]:
            axes.set_ylabel("mean squared error")
        return encode_svg(figure)


def _plot_error(histories: Mapping[str, History], name: str, label: str) -> str:
    with rc_context(STYLE):
        figure = Figure(figsize=(3.4, 2.6), layout="constrained")
        axes = figure.subplots()
        for network, history in histories.items():
            colour, seconds = COLOURS.get(network, INK), history.train_seconds
            errors = history.validation[name]
            axes.plot(seconds, errors, "o-", color=colour, markersize=3, label=network)
        axes.set(xlabel="seconds of training", ylabel=label, yscale="log")
        axes.set_xlim(left=0)
        label_log_axis(axes.yaxis)
        axes.legend()
        return encode_svg(figure)


def _plot_stage_times(seconds: Mapping[str, float]) -> str:
    with rc_context(STYLE):
        figure = Figure(figsize=(6.6, 0.6 + 0.3 * len(seconds)), layout="constrained")
        axes = figure.subplots()
        bars = axes.barh(list(seconds), list(seconds.values()), color="#9db7dd", height=0.65)
        texts = [f"{value:.{1 if value < 100 else 0}f} s" for value in seconds.values()]
        axes.bar_label(bars, texts, padding=3)
        axes.set(xlabel="wall clock, seconds")
        axes.margins(x=0.12)
        axes.invert_yaxis()
        axes.grid(False, axis="y")
        return encode_svg(figure)


def read_trainings(run_dir: Path) -> Trainings:
    """Read the logs and summaries of the networks that have a log. Raises UserError."""
    trainings = Trainings({}, {})
    for name in TRAINABLE:
        history = read_history(run_dir / name / "log.jsonl")
        if history is not None:
            trainings.histories[name] = history
            summary = run_dir / name / "summary.json"
            if summary.exists():
                record = read_record(summary, TrainingSummary, RETRAIN_REMEDY)
                trainings.summaries[name] = record
    return trainings


def read_lines(path: Path) -> list[Json]:
    """Read the lines of a training log that hold a validation; none if there is no log.

    Damaged lines are left out, with a note.
    """
    try:
        rows = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []
    validations = []
    for row in rows:
        try:
            line = check_and_remove_checksum(json.loads(row))
        except ValueError:
            continue
        if isinstance(line, dict) and "train_seconds" in line and "epoch" in line:
            validations.append(line)
    if damaged := len(rows) - len(validations):
        text = f"{path} is damaged: {damaged} of its lines are left out"
        warnings.warn(text, Note, stacklevel=2)
    return validations


def read_history(path: Path) -> History | None:
    """Read the training log at `path`; None if it does not exist or has no validation."""
    lines = read_lines(path)
    if not lines:
        return None
    return History(
        [line["epoch"] for line in lines],
        [line["train_seconds"] for line in lines],
        _collect_columns([line.get("train", {}) for line in lines]),
        _collect_columns([line.get("validation", {}) for line in lines]),
    )


def _collect_columns(rows: list[Json]) -> dict[str, list[float]]:
    """Collect the values of each name for which every row has a number."""
    columns = {}
    for name in rows[0]:
        if all(isinstance(row.get(name), int | float) for row in rows):
            columns[name] = [float(row[name]) for row in rows]
    return columns
