"""Training curves of several runs in one drawing: a row a network, over epochs and over seconds."""

from collections.abc import Sequence

from matplotlib import rc_context
from matplotlib.figure import Figure

from jaxunshear.compare.runs import Run
from jaxunshear.report.figures import svg
from jaxunshear.report.history import History
from jaxunshear.style import STYLE

MAIN = ("supervised", "pose")  # losses, by whether a network unshears or reads poses
COLOURS = ("#1f6feb", "#d9822b", "#2a9d6f", "#8250df", "#b3554d", "#7c8b3d")  # of runs, again from the first


def curves(runs: Sequence[Run]) -> str:
    """SVG; the main loss, in training and on validation, of every network that any run has a log of."""
    networks = list(dict.fromkeys(network for run in runs for network in run.histories))
    with rc_context(STYLE):
        figure = Figure(figsize=(9.0, 2.7 * len(networks)), layout="constrained")
        panels = figure.subplots(len(networks), 2, squeeze=False)
        for network, row in zip(networks, panels, strict=True):
            for run, colour in zip(runs, COLOURS * len(runs), strict=False):
                history = run.histories.get(network)
                name = _main_loss(history)
                if history is None or name is None:
                    continue
                for axes, across in zip(row, (history.epoch, history.train_seconds), strict=True):
                    axes.plot(across, history.training[name], color=colour, linewidth=1, alpha=0.45)
                    axes.plot(across, history.validation[name], "o-", color=colour, markersize=3, label=run.name)
                row[0].set_ylabel(name)
            row[0].set(title=network, xlabel="epoch", yscale="log")
            row[1].set(title=network, xlabel="seconds of training", yscale="log")
            row[0].legend()
        return svg(figure)


def _main_loss(history: History | None) -> str | None:
    """Of MAIN, or the first that is both trained and validated."""
    both = [name for name in history.validation if name in history.training] if history else []
    return next((name for name in (*MAIN, *both) if name in both), None)
