"""The pictures of a sweep.

Over one or two axes: lines or heat maps, a panel per metric. Over a list of settings: error against
training and run time, with the settings that no other beats in both.
"""

import fnmatch
from textwrap import wrap
from typing import NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from jaxunshear.config.networks import DISENTANGLED, TEACHER
from jaxunshear.results.sweep import CellResult, Figures, SweepResult
from jaxunshear.style import (
    COLOURS,
    FAINT,
    INK,
    LABEL,
    STYLE,
    encode_png,
    label_log_axis,
    make_panels,
)
from jaxunshear.text_table import format_plain

SHOWN_METRICS = (  # in this order; a metric that is equal in all cells is left out
    "ms_ssim/*",
    "pose/*/x_mm",
    "pose/*/yaw_deg",
    "pose/*/edge_mm",
    "pose/*/edge_deg",
    "swap/*/ssim",
    "swap/DC(z_p)/mse",
    "swap/DS(z_p,z_s)/mse",
    "ablation/DS(z_p,0)/ssim",
    "ablation/DS(0,z_s)/ssim",
)
METRIC_TITLES = {
    "swap/DC(z_p)/mse": "L_sup, swap/DC(z_p)/mse",
    "swap/DS(z_p,z_s)/mse": "L_rec, swap/DS(z_p,z_s)/mse",
}
COLUMNS = 4


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


class PlacedCell(NamedTuple):
    """A cell of the grid with its indices along the axes."""

    place: tuple[int, ...]
    cell: CellResult
    figures: Figures


def plot_sweep(summary: SweepResult) -> bytes | None:
    """Plot the summary in sweep.json as a PNG.

    Returns None if the grid does not have one or two axes, or no cell has figures.
    """
    metrics = select_metrics(summary)
    plot = {1: _plot_lines, 2: _plot_heat_map}.get(len(summary.axes))
    if plot is None or not metrics:
        return None
    with rc_context(STYLE):
        columns = min(COLUMNS, len(metrics))
        figure, panels = make_panels(len(metrics), columns, (4.2, 3.6), dpi=110)
        for axes, name in zip(panels, metrics, strict=True):
            plot(axes, summary, name)
            axes.set_title(METRIC_TITLES.get(name, name))
        seeds = len(summary.seeds)
        figure.suptitle(f"{summary.sweep}: means over {seeds} seeds and the test contacts")
        return encode_png(figure)


def select_metrics(summary: SweepResult) -> list[str]:
    """Select the metrics that differ between cells, in the order of `SHOWN_METRICS`."""
    means: dict[str, set[float]] = {}
    placed = [each for each in _place_cells(summary) if each.cell.seeds]
    for each in placed:
        for name, figure in each.figures.items():
            means.setdefault(name, set()).add(figure.mean)
    differing = [name for name in means if len(means[name]) > 1 or len(placed) == 1]
    selected: dict[str, None] = {}
    for pattern in SHOWN_METRICS:
        selected |= dict.fromkeys(fnmatch.filter(differing, pattern))
    return list(selected)


def collect_grid_values(summary: SweepResult, name: str) -> np.ndarray:
    """Collect the means of a metric over the axes' values; NaN if a cell has none."""
    values = np.full([len(axis.values) for axis in summary.axes], np.nan)
    for place, _, figures in _place_cells(summary):
        if name in figures:
            values[place] = figures[name].mean
    return values


def _place_cells(summary: SweepResult) -> list[PlacedCell]:
    placed = []
    for cell in summary.cells:
        if cell.point is not None:
            pairs = zip(summary.axes, cell.point, strict=True)
            place = tuple(list(axis.values).index(value) for axis, value in pairs)
            ablation = {f"ablation/{name}": figure for name, figure in cell.ablation.items()}
            placed.append(PlacedCell(place, cell, {**cell.metrics, **ablation}))
    return sorted(placed, key=lambda each: each.place)


def _plot_heat_map(axes: Axes, summary: SweepResult, name: str) -> None:
    """Plot the first axis downwards and the second to the right."""
    values = collect_grid_values(summary, name)
    image = axes.imshow(np.ma.masked_invalid(values), cmap="viridis", aspect="auto")
    for (row, column), cell, figures in _place_cells(summary):
        colour, text = FAINT, "none" if cell.seeds else "failed"
        if name in figures:
            dark = float(np.asarray(image.norm(values[row, column]))) < 0.6
            colour, text = "white" if dark else INK, format_plain(values[row, column])
            if cell.failures:
                text += f"\n{len(cell.seeds)} of {len(summary.seeds)}"
        axes.text(column, row, text, color=colour, fontsize=9, ha="center", va="center")
    down, across = summary.axes
    axes.set(xlabel=across.name, ylabel=down.name)
    axes.set_xticks(range(len(across.values)), across.values)
    axes.set_yticks(range(len(down.values)), down.values)
    axes.grid(False)


def _plot_lines(axes: Axes, summary: SweepResult, name: str) -> None:
    """Plot the mean, its interval and each seed over the axis; failed cells have a cross."""
    (axis,) = summary.axes
    placed = _place_cells(summary)
    figures = {place: figures[name] for (place,), _, figures in placed if name in figures}
    means = np.array([figure.mean for figure in figures.values()])
    ends = np.array([figure.interval or [figure.mean] * 2 for figure in figures.values()]).T
    colour = next((colour for network, colour in COLOURS.items() if f"/{network}" in name), INK)
    axes.errorbar(
        list(figures), means, np.abs(ends - means), fmt="o-", color=colour, markersize=4, capsize=3
    )
    for place, figure in figures.items():
        seeds = [mean for mean in (figure.per_seed or {}).values() if mean is not None]
        axes.plot([place] * len(seeds), seeds, ".", color=colour, alpha=0.45, markersize=5)
    failed = [place for (place,), cell, _ in placed if cell.failures]
    below = axes.get_xaxis_transform()
    axes.plot(failed, [0.03] * len(failed), "x", color=INK, transform=below, clip_on=False)
    axes.set_xlabel(axis.name)
    axes.set_xticks(range(len(axis.values)), axis.values)
    axes.margins(x=0.1)


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
                plot_panel(axes, summary, metric, cost, numbers)
                label_log_axis(axes.xaxis)
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
