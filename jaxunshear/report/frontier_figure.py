"""The picture of a sweep over a list of settings: error against training and run time."""

from textwrap import wrap
from typing import NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import ArrayLike

from jaxunshear.config.networks import DISENTANGLED, TEACHER
from jaxunshear.results.sweep import CellResult, SweepResult
from jaxunshear.style import COLOURS, FAINT, INK, LABEL, STYLE, encode_png

ERRORS = {  # of the disentangled network: metric, label, whether more is better
    "ms_ssim/disentangled": ("likeness to the tap, MS-SSIM", True),
    "pin_error/disentangled/rms_mm": ("pins' error, mm", False),
    "pose/disentangled/edge_mm": ("edge distance error, mm", False),
    "pose/disentangled/edge_deg": ("edge angle error, deg", False),
}
COSTS = {"train_seconds": "seconds of training", "ms_per_image": "ms an image"}
# settings that decide the contacts of the test and their images, except sizes in px:
# errors in mm and degrees can be compared across sizes
TEST_SETTINGS = ("paired.", "sensor")
NETWORK_SETTINGS = ("unshear.",)
SIZE_SETTINGS = ("paired.preprocess.size", "paired.camera.frame_px")


class Points(NamedTuple):
    """N cells with their means over seeds."""

    labels: list[str]
    cost: np.ndarray  # (N,)
    error: np.ndarray  # (N,)


def find_frontier(cost: ArrayLike, error: ArrayLike) -> list[int]:
    """Find the points, cheapest first, that no other point beats in both cost and error.

    Less is better in `cost` (N,) and in `error` (N,).
    """
    least, frontier = np.inf, []
    errors = np.asarray(error, float)
    for index in np.lexsort((errors, np.asarray(cost, float))).tolist():
        if errors[index] < least:
            least = errors[index]
            frontier.append(index)
    return frontier


def list_efficient(summary: SweepResult) -> dict[str, dict[str, list[str]]]:
    """List the labels on the frontier of `list_comparable` cells, by metric and by cost."""
    efficient = {}
    for metric in ERRORS:
        efficient[metric] = {cost: _list_frontier(summary, metric, cost) for cost in COSTS}
    return efficient


def _list_frontier(summary: SweepResult, metric: str, cost: str) -> list[str]:
    comparable, points = list_comparable(summary), collect_points(summary, metric, cost)
    inside = [index for index, label in enumerate(points.labels) if label in comparable]
    _, more_is_better = ERRORS[metric]
    error = -points.error[inside] if more_is_better else points.error[inside]
    return [points.labels[inside[index]] for index in find_frontier(points.cost[inside], error)]


def list_comparable(summary: SweepResult) -> list[str]:
    """List the labels of cells that were tested on the same contacts as the reference.

    On other contacts an error may be less because the contacts are easier.
    """
    test = _select_settings(_find_reference(summary), TEST_SETTINGS)
    return [cell.label for cell in summary.cells if _select_settings(cell, TEST_SETTINGS) == test]


def _find_reference(summary: SweepResult) -> CellResult:
    """Find the reference, or else the first cell, among cells with figures if there are any."""
    cells = [cell for cell in summary.cells if cell.metrics] or summary.cells
    return next((cell for cell in cells if cell.label == summary.reference), cells[0])


def _select_settings(cell: CellResult, groups: tuple[str, ...]) -> dict[str, str]:
    return {
        name: value
        for name, value in cell.settings.items()
        if name.startswith(groups) and name not in SIZE_SETTINGS
    }


def collect_points(summary: SweepResult, metric: str, cost: str) -> Points:
    """Collect the means of a cost and of a metric over seeds, of all cells that have both.

    Milliseconds are means over all cells with the same network, since nothing else decides them.
    MS-SSIM at other scales than the reference's is another quantity and is left out.
    """
    cells = [cell for cell in summary.cells if metric in cell.metrics]
    scale = _find_reference(summary).metric.get("ms_ssim")
    labels, costs, errors = [], [], []
    for cell in cells:
        if metric.startswith("ms_ssim") and cell.metric["ms_ssim"] != scale:
            continue
        network = _select_settings(cell, NETWORK_SETTINGS)
        group = [cell]
        if cost == "ms_per_image":
            group = [each for each in cells if _select_settings(each, NETWORK_SETTINGS) == network]
        values = [value for each in group for value in _list_costs(each, cost)]
        if values:
            labels.append(cell.label)
            costs.append(float(np.mean(values)))
            errors.append(cell.metrics[metric].mean)
    return Points(labels, np.array(costs), np.array(errors))


def _list_costs(cell: CellResult, cost: str) -> list[float]:
    """List the cost of every seed that has it; training includes that of a teacher."""
    values = []
    for costs in cell.costs.values():
        if cost == "ms_per_image" and DISENTANGLED in costs.ms_per_image:
            values.append(costs.ms_per_image[DISENTANGLED]["median"])
        elif cost == "train_seconds" and DISENTANGLED in costs.train_seconds:
            teacher = costs.train_seconds.get(TEACHER, 0.0)
            values.append(costs.train_seconds[DISENTANGLED] + teacher)
    return values


def plot_frontier(summary: SweepResult) -> bytes | None:
    """Plot a row for each cost and a column for each error as a PNG; None without two points.

    Points on the frontier are joined, and cells that cannot be compared are hollow.
    """
    metrics = [
        metric
        for metric in ERRORS
        if len(collect_points(summary, metric, "train_seconds").labels) > 1
    ]
    if not metrics:
        return None
    numbers = {cell.label: str(index) for index, cell in enumerate(summary.cells, 1)}
    size = (4.0 * len(metrics), 3.6 * len(COSTS) + 0.8)
    with rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained", dpi=100)
        panels = figure.subplots(len(COSTS), len(metrics), squeeze=False)
        for row, (cost, cost_label) in zip(panels, COSTS.items(), strict=True):
            for axes, metric in zip(row, metrics, strict=True):
                axes.set(xlabel=cost_label, ylabel=ERRORS[metric][0], xscale="log")
                axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axes.xaxis.set_major_formatter("{x:g}")
                axes.xaxis.set_minor_formatter(NullFormatter())
                plot_panel(axes, summary, metric, cost, numbers)
        seeds = f"{len(summary.seeds)} seed{'s' * (len(summary.seeds) > 1)}"
        figure.suptitle(f"{summary.sweep}: means over {seeds}; joined: beaten by none")
        legend = "      ".join(f"{number} {label}" for label, number in numbers.items())
        if len(list_comparable(summary)) < len(numbers):
            legend += "      hollow: another test"
        figure.supxlabel("\n".join(wrap(legend, 42 * len(metrics))), fontsize=9)
        return encode_png(figure)


def plot_panel(
    axes: Axes, summary: SweepResult, metric: str, cost: str, numbers: dict[str, str]
) -> None:
    """Plot the numbers of all cells at their cost and error, and join the frontier."""
    labels, x, y = collect_points(summary, metric, cost)
    frontier = [labels.index(label) for label in _list_frontier(summary, metric, cost)]
    comparable, colour = list_comparable(summary), COLOURS[DISENTANGLED]
    axes.plot(x[frontier], y[frontier], "-", color=colour)
    for index, label in enumerate(labels):
        text, edge, face = "white", "white", colour if index in frontier else FAINT
        if label not in comparable:
            text, edge, face = INK, FAINT, "white"
        circle = {"boxstyle": "circle,pad=0.25", "facecolor": face, "edgecolor": edge}
        place = x[index], y[index]
        number = axes.annotate(numbers[label], place, ha="center", va="center", bbox=circle)
        number.set(fontsize=LABEL, color=text, zorder=3 + (index in frontier))
    axes.plot(x, y, "o", alpha=0)  # extends the axes' limits to the numbers
    axes.margins(x=0.12, y=0.12)
