"""The picture of a sweep over one or two axes: lines or heat maps, a panel per metric."""

import fnmatch
from typing import NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes

from jaxunshear.report.figures import make_panels
from jaxunshear.results.sweep import CellResult, Figures, SweepResult
from jaxunshear.style import COLOURS, FAINT, INK, STYLE, encode_png

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
            colour, text = "white" if dark else INK, f"{values[row, column]:.3g}"
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
