"""The drawn figures of the report, each an SVG text; the same numbers give the same bytes."""

import io
from collections.abc import Mapping, Sequence

from matplotlib import rc_context
from matplotlib.figure import Figure

from jaxunshear.report.history import History
from jaxunshear.style import COLOURS, INK, STYLE

ABREAST = 3  # panels of loss curves
DASHES = ("-", "--", ":")


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
                axes.plot(history.epoch, history.training[name], dash, color=colour, linewidth=1, alpha=0.45)
                axes.plot(history.epoch, history.validation[name], dash, color=colour, linewidth=2, label=name)
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
                axes.plot(history.train_seconds, values, "o-", color=colour, markersize=3, label=network)
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
        axes.bar_label(bars, [f"{value:.1f} s" if value < 100 else f"{value:.0f} s" for value in seconds], padding=3)
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
