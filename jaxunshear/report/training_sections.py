"""Sections of a run's report: how it was made. Training, times, the contacts behind the images, how to get it again."""

import io
import json
from collections.abc import Mapping, Sequence

from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure

from jaxunshear.progress import format_duration
from jaxunshear.report import html, labels
from jaxunshear.report.history import History
from jaxunshear.results.measurement import TrainingSummary
from jaxunshear.results.run import Results
from jaxunshear.serialization import to_builtins
from jaxunshear.style import COLOURS, INK, STYLE

RETRAIN_REMEDY = "delete it, then run the same experiment again, which goes on from the checkpoint"
ABREAST = 3  # panels of loss curves
DASHES = ("-", "--", ":")


def build_training_section(
    histories: dict[str, History], summaries: dict[str, TrainingSummary]
) -> Markup:
    if not histories:
        return html.section("Training", "This run has no training logs.")
    rows = [
        [
            name,
            f"{summary.parameters:,}",
            str(summary.steps),
            f"{summary.images_per_second:.3g}",
            format_duration(summary.train_seconds),
            str(summary.best_step),
        ]
        for name, summary in summaries.items()
    ]
    head = ["network", "parameters", "steps", "images/s", "training", "best at step"]
    text = "loss over epochs of " + ", ".join(histories)
    lead = "Losses at each validation, in training (thin) and on poses kept out of it (thick). The best step is used."
    return html.section(
        "Training", lead, html.embed_svg(loss_curves(histories), text), html.table(head, rows)
    )


def build_times_section(results: Results, histories: dict[str, History]) -> Markup:
    stages = {name: value for name, value in results.time_s.items() if value is not None}
    drawn = []
    if stages:
        text = "; ".join(f"{name} {value:.0f} s" for name, value in stages.items())
        drawn.append(html.embed_svg(stage_times(list(stages), list(stages.values())), text))
    for name, label in _over_time(results).items():
        if any(name in history.validation for history in histories.values()):
            drawn.append(
                html.embed_svg(
                    error_over_time(histories, name, label), f"{label} over seconds of training"
                )
            )
    lead = (
        "Wall clock of each stage, summed over the runs that it was stopped and continued in (what one had spent that was "
        "killed outright is lost), and what the seconds of training bought on poses kept out of it."
    )
    waits = "; ".join(
        f"{name} {_short(times['median'])} ms (95th percentile {_short(times['p95'])})"
        for name, times in results.ms_per_image.items()
    )
    note = html.soft(f"One image at a time, compilation apart: {waits}.") if waits else ""
    return html.section("Error against run time", lead, html.row(*drawn), note)


def _short(milliseconds: float) -> str:
    return f"{milliseconds:.1f}" if milliseconds >= 1 else f"{milliseconds:.2g}"


def _over_time(results: Results) -> dict[str, str]:
    """A network's validation figures that are drawn over its seconds of training, with their labels."""
    what = "pins" if labels.reads_pins(results) else "image"
    form = "{} of taps, {}" if results.simulated else "error in {}, {}"
    chief = {
        name: form.format(labels.name_quantity(name), labels.get_unit(name))
        for name in labels.list_main_targets(results)
    }
    return {"supervised": f"unsheared {what}, MSE"} | chief


def build_contacts_section(results: Results) -> Markup:
    """Nothing of recorded contacts, which no solver has solved."""
    if not results.simulated:
        return Markup()
    names = {
        "residual_mm": "solver residual, mm",
        "iterations": "solver iterations",
        "stuck": "nodes stuck",
        "slipping": "nodes slipping",
        "free": "nodes free",
    }
    head = ["sheared test contacts", "mean", "median", "95th percentile", "largest"]
    rows = [
        [names.get(field, field), *(f"{entry[q]:.3g}" for q in ("mean", "median", "p95", "max"))]
        for field, entry in (results.contact or {}).items()
    ]
    counts = results.counts
    tried = ""
    if counts.contacts is not None:
        tried = f"Of {counts.contacts} contacts {counts.retried} were solved again more finely and {counts.dropped} dropped."
    pairs = (
        f"Pairs: {counts.train} to train, {counts.validation} to validate, {counts.test} to test"
        if counts.train is not None
        else ""
    )
    poses = f"{counts.test_poses} test poses. {counts.pin_images} images had their pins found."
    lead = "How well the simulated contacts behind the test images were solved."
    return html.section(
        "Contact quality", lead, html.table(head, rows), html.soft(f"{tried} {pairs}; {poses}")
    )


def build_provenance_section(results: Results) -> Markup:
    held = (
        results.seeds,
        to_builtins(results.machine),
        results.versions,
        to_builtins(results.source) if results.source else {},
    )
    parts = (html.table(("", ""), list(part.items())) for part in held if part)
    settings = html.code(json.dumps(results.settings, indent=2))
    return html.section(
        "How to get this again",
        "The same command, seeds and versions on the same machine give the same numbers.",
        html.code(results.command),
        html.row(*parts),
        html.folded("All settings", settings),
    )


def loss_curves(histories: Mapping[str, History]) -> str:
    """Each loss that is both trained and validated, over epochs: one panel a network."""
    with rc_context(STYLE):
        across = min(ABREAST, len(histories))
        down = -(-len(histories) // across)
        figure = Figure(figsize=(3.4 * across, 2.8 * down), layout="constrained")
        panels = figure.subplots(down, across, squeeze=False)
        for axes in panels.ravel()[len(histories) :]:
            axes.set_axis_off()
        for axes, (network, history) in zip(panels.ravel(), histories.items(), strict=False):
            colour = COLOURS.get(network, INK)
            names = [name for name in history.validation if name in history.training]
            for name, dash in zip(names, DASHES, strict=False):
                axes.plot(
                    history.epoch,
                    history.training[name],
                    dash,
                    color=colour,
                    linewidth=1,
                    alpha=0.45,
                )
                axes.plot(
                    history.epoch,
                    history.validation[name],
                    dash,
                    color=colour,
                    linewidth=2,
                    label=name,
                )
            axes.set(title=network, xlabel="epoch", yscale="log")
            axes.legend()
        for axes in panels[:, 0]:
            axes.set_ylabel("mean squared error")
        return svg(figure)


def error_over_time(histories: Mapping[str, History], name: str, label: str) -> str:
    """The validation figure `name` over seconds of training, a line for every network that has it."""
    with rc_context(STYLE):
        figure = Figure(figsize=(3.4, 2.6), layout="constrained")
        axes = figure.subplots()
        for network, history in histories.items():
            if name in history.validation:
                colour = COLOURS.get(network, INK)
                values = history.validation[name]
                axes.plot(
                    history.train_seconds, values, "o-", color=colour, markersize=3, label=network
                )
        axes.set(xlabel="seconds of training", ylabel=label, yscale="log")
        axes.set_xlim(left=0)
        axes.legend()
        return svg(figure)


def stage_times(stages: Sequence[str], seconds: Sequence[float]) -> str:
    """Wall clock of each stage, in order, as bars."""
    with rc_context(STYLE):
        figure = Figure(figsize=(6.6, 0.6 + 0.3 * len(stages)), layout="constrained")
        axes = figure.subplots()
        bars = axes.barh(stages, seconds, color="#9db7dd", height=0.65)
        axes.bar_label(
            bars,
            [f"{value:.1f} s" if value < 100 else f"{value:.0f} s" for value in seconds],
            padding=3,
        )
        axes.set(xlabel="wall clock, seconds")
        axes.margins(x=0.12)
        axes.invert_yaxis()
        axes.grid(False, axis="y")
        return svg(figure)


def svg(figure: Figure) -> str:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    text = buffer.getvalue()
    return text[text.index("<svg") :]
