"""The picture of a sweep over a list of settings: error against seconds of training, and against milliseconds an image."""

import io
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from jaxunshear.report.figures import COLOURS, FAINT, INK, STYLE

ERRORS = {  # of the disentangled network: metric, label, whether more is better
    "ms_ssim/disentangled": ("likeness to the tap, MS-SSIM", True),
    "pin_error/disentangled/rms_mm": ("pins' error, mm", False),
    "pose/disentangled/edge_mm": ("edge distance error, mm", False),
    "pose/disentangled/edge_deg": ("edge angle error, deg", False),
}
COSTS = {"train_seconds": "seconds of training", "ms_per_image": "ms an image"}
NETWORK = "disentangled"


def frontier(cost: ArrayLike, error: ArrayLike) -> list[int]:
    """Indices, cheapest first, of the points that no other one beats in both: cost (N,) and error (N,), less is better in each."""
    best, kept = np.inf, []
    errors = np.asarray(error, float)
    for index in np.lexsort((errors, np.asarray(cost, float))).tolist():
        if errors[index] < best:
            best = errors[index]
            kept.append(index)
    return kept


def efficient(summary: dict[str, Any]) -> dict[str, dict[str, list[str]]]:
    """Labels on the frontier, cheapest first, by metric and cost."""
    named: dict[str, dict[str, list[str]]] = {}
    for metric, (_, more) in ERRORS.items():
        named[metric] = {}
        for cost in COSTS:
            labels, x, y = points(summary, metric, cost)
            named[metric][cost] = [labels[index] for index in frontier(x, -y if more else y)]
    return named


def points(summary: dict[str, Any], metric: str, cost: str) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Labels, means over seeds of the cost, and of the metric, of all cells that have both.

    MS-SSIM of other scales than the first cell's (other image sizes) is another quantity, and left out.
    """
    found = []
    cells = [cell for cell in summary["cells"] if metric in cell["metrics"]]
    for cell in cells:
        if metric.startswith("ms_ssim") and cell["metric"]["ms_ssim"] != cells[0]["metric"]["ms_ssim"]:
            continue
        spent = [seconds for costs in cell["costs"].values() if (seconds := _spent(costs, cost)) is not None]
        if spent:
            found.append((cell["label"], float(np.mean(spent)), cell["metrics"][metric]["mean"]))
    labels, x, y = zip(*found, strict=True) if found else ((), (), ())
    return list(labels), np.array(x), np.array(y)


def _spent(costs: dict[str, Any], cost: str) -> float | None:
    entry = costs.get(cost, {}).get(NETWORK)
    return entry["median"] if isinstance(entry, dict) else entry


def frontier_figure(summary: dict[str, Any]) -> bytes | None:
    """PNG: a row a cost, a column an error; what no other setting beats is joined and named. None where nothing can be drawn."""
    metrics = [metric for metric in ERRORS if len(points(summary, metric, "train_seconds")[0]) > 1]
    if not metrics:
        return None
    with rc_context(STYLE):
        figure = Figure(figsize=(5.0 * len(metrics), 4.2 * len(COSTS)), layout="constrained")
        places = figure.subplots(len(COSTS), len(metrics), squeeze=False)
        for row, (cost, cost_label) in zip(places, COSTS.items(), strict=True):
            for axes, metric in zip(row, metrics, strict=True):
                _panel(axes, summary, metric, cost)
                axes.set(xlabel=cost_label, ylabel=ERRORS[metric][0], xscale="log")
        figure.suptitle(f"{summary['sweep']}: means over {len(summary['seeds'])} seeds; joined: beaten by none")
        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=100, metadata={"Software": ""})
    return picture.getvalue()


def _panel(axes: Any, summary: dict[str, Any], metric: str, cost: str) -> None:
    labels, x, y = points(summary, metric, cost)
    best = frontier(x, -y if ERRORS[metric][1] else y)
    axes.plot(x, y, "o", color=FAINT, markersize=5)
    axes.plot(x[best], y[best], "o-", color=COLOURS[NETWORK], markersize=6)
    for index, label in enumerate(labels):
        on = index in best
        axes.annotate(
            label,
            (x[index], y[index]),
            xytext=(4, 4),
            textcoords="offset points",
            fontsize=7,
            color=INK if on else FAINT,
        )
    axes.margins(x=0.2, y=0.15)
