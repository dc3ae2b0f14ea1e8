"""The picture of a sweep over a list of settings: error against seconds of training, and against milliseconds an image."""

from textwrap import wrap

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import ArrayLike

from jaxunshear.config.registry import DISENTANGLED, TEACHER
from jaxunshear.results.sweep import CellResult, SweepResult
from jaxunshear.style import COLOURS, FAINT, INK, LABEL, STYLE, encode_png

ERRORS = {  # of the disentangled network: metric, label, whether more is better
    "ms_ssim/disentangled": ("likeness to the tap, MS-SSIM", True),
    "pin_error/disentangled/rms_mm": ("pins' error, mm", False),
    "pose/disentangled/edge_mm": ("edge distance error, mm", False),
    "pose/disentangled/edge_deg": ("edge angle error, deg", False),
}
COSTS = {"train_seconds": "seconds of training", "ms_per_image": "ms an image"}
TEST = (
    "paired.",
    "sensor",
)  # settings that decide which contacts the test holds, and how their images appear
# but for these: errors in mm and degrees compare across sizes
SIZES = ("paired.preprocess.size", "paired.camera.frame_px")


def find_frontier(cost: ArrayLike, error: ArrayLike) -> list[int]:
    """Indices, cheapest first, of the points that no other one beats in both: cost (N,) and error (N,), less is better in each."""
    best, kept = np.inf, []
    errors = np.asarray(error, float)
    for index in np.lexsort((errors, np.asarray(cost, float))).tolist():
        if errors[index] < best:
            best = errors[index]
            kept.append(index)
    return kept


def list_efficient(summary: SweepResult) -> dict[str, dict[str, list[str]]]:
    """Labels on the frontier, cheapest first, by metric and cost; of the cells that can be ranked, see `list_ranked`."""
    comparable = list_ranked(summary)
    named: dict[str, dict[str, list[str]]] = {}
    for metric, (_, more) in ERRORS.items():
        named[metric] = {}
        for cost in COSTS:
            labels, x, y = collect_points(summary, metric, cost)
            inside = [index for index, label in enumerate(labels) if label in comparable]
            best = find_frontier(x[inside], -y[inside] if more else y[inside])
            named[metric][cost] = [labels[inside[index]] for index in best]
    return named


def list_ranked(summary: SweepResult) -> list[str]:
    """Labels of the cells tested on the same contacts as the reference: on others an error may be less because they are easier."""
    test = _test(_reference(summary))
    return [cell.label for cell in summary.cells if _test(cell) == test]


def _reference(summary: SweepResult) -> CellResult:
    """The reference cell, or the first where there is none, of those that have figures; the first cell where none has."""
    cells = [cell for cell in summary.cells if cell.metrics] or summary.cells
    return next((cell for cell in cells if cell.label == summary.reference), cells[0])


def _test(cell: CellResult) -> dict[str, str]:
    return {
        name: value
        for name, value in cell.settings.items()
        if name.startswith(TEST) and name not in SIZES
    }


def collect_points(
    summary: SweepResult, metric: str, cost: str
) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Labels, means over seeds of the cost, and of the metric, of all cells that have both.

    Milliseconds are those of all cells with the same network, since nothing else distinguishes them. MS-SSIM of
    other scales than the reference's (other image sizes) is another quantity, and left out.
    """
    found = []
    cells = [cell for cell in summary.cells if metric in cell.metrics]
    scale = _reference(summary).metric.get("ms_ssim")
    for cell in cells:
        if metric.startswith("ms_ssim") and cell.metric["ms_ssim"] != scale:
            continue
        alike = (
            [cell]
            if cost != "ms_per_image"
            else [other for other in cells if _network(other) == _network(cell)]
        )
        if spent := [seconds for each in alike for seconds in _list_costs(each, cost)]:
            found.append((cell.label, float(np.mean(spent)), cell.metrics[metric].mean))
    labels, x, y = zip(*found, strict=True) if found else ((), (), ())
    return list(labels), np.array(x), np.array(y)


def _network(cell: CellResult) -> dict[str, str]:
    return {name: value for name, value in cell.settings.items() if name.startswith("unshear.")}


def _list_costs(cell: CellResult, cost: str) -> list[float]:
    """Of every seed that has it. The training of a taught network includes its teacher's."""
    spent = []
    for costs in cell.costs.values():
        if cost == "ms_per_image" and DISENTANGLED in costs.ms_per_image:
            spent.append(costs.ms_per_image[DISENTANGLED]["median"])
        elif cost == "train_seconds" and DISENTANGLED in costs.train_seconds:
            spent.append(costs.train_seconds[DISENTANGLED] + costs.train_seconds.get(TEACHER, 0.0))
    return spent


def plot_frontier(summary: SweepResult) -> bytes | None:
    """PNG: a row a cost, a column an error; what no other setting beats is joined, what cannot be ranked is hollow. None where
    nothing can be drawn."""
    metrics = [
        metric for metric in ERRORS if len(collect_points(summary, metric, "train_seconds")[0]) > 1
    ]
    if not metrics:
        return None
    number = {cell.label: str(place + 1) for place, cell in enumerate(summary.cells)}
    with rc_context(STYLE):
        figure = Figure(
            figsize=(4.0 * len(metrics), 3.6 * len(COSTS) + 0.8), layout="constrained", dpi=100
        )
        places = figure.subplots(len(COSTS), len(metrics), squeeze=False)
        for row, (cost, cost_label) in zip(places, COSTS.items(), strict=True):
            for axes, metric in zip(row, metrics, strict=True):
                axes.set(xlabel=cost_label, ylabel=ERRORS[metric][0], xscale="log")
                axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axes.xaxis.set_major_formatter("{x:g}")
                axes.xaxis.set_minor_formatter(NullFormatter())
                plot_panel(axes, summary, metric, cost, number)
        seeds = len(summary.seeds)
        names = "      ".join(f"{digit} {label}" for label, digit in number.items())
        names += "      hollow: another test" * (len(list_ranked(summary)) < len(number))
        figure.suptitle(
            f"{summary.sweep}: means over {seeds} seed{'s' * (seeds > 1)}; joined: beaten by none"
        )
        figure.supxlabel("\n".join(wrap(names, 42 * len(metrics))), fontsize=9)
        return encode_png(figure)


def plot_panel(
    axes: Axes, summary: SweepResult, metric: str, cost: str, number: dict[str, str]
) -> None:
    labels, x, y = collect_points(summary, metric, cost)
    best = [labels.index(label) for label in list_efficient(summary)[metric][cost]]
    comparable = list_ranked(summary)
    axes.plot(x[best], y[best], "-", color=COLOURS[DISENTANGLED])
    for index, label in enumerate(labels):
        on, full = index in best, label in comparable
        inside = COLOURS[DISENTANGLED] if on else FAINT if full else "white"
        axes.annotate(
            number[label],
            (x[index], y[index]),
            ha="center",
            va="center",
            fontsize=LABEL,
            color="white" if full else INK,
            bbox={
                "boxstyle": "circle,pad=0.25",
                "facecolor": inside,
                "edgecolor": "white" if full else FAINT,
            },
            zorder=3 + on,
        )
    axes.plot(x, y, "o", alpha=0)  # so that the axes reach as far as the numbers
    axes.margins(x=0.12, y=0.12)
