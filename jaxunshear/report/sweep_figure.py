"""The picture of a sweep over one or two axes: lines or heat maps, a panel per metric."""

import fnmatch
import textwrap
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes

from jaxunshear.report.figures import make_panels
from jaxunshear.results.sweep import CellResult, Failure, Figures, SweepResult
from jaxunshear.style import COLOURS, FAINT, INK, LABEL, STYLE, encode_png

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
    cells = [cell for cell in summary.cells if cell.seeds and cell.point is not None]
    for cell in cells:
        for name, figure in _collect_figures(cell).items():
            means.setdefault(name, set()).add(figure.mean)
    differing = [name for name in means if len(means[name]) > 1 or len(cells) == 1]
    selected: list[str] = []
    for pattern in SHOWN_METRICS:
        selected += [name for name in differing if fnmatch.fnmatchcase(name, pattern)]
    return list(dict.fromkeys(selected))


def collect_grid_values(summary: SweepResult, name: str) -> np.ndarray:
    """Collect the means of a metric over the axes' values; NaN if a cell has none."""
    values = np.full([len(axis.values) for axis in summary.axes], np.nan)
    for place, cell in _place_cells(summary):
        if name in _collect_figures(cell):
            values[place] = _collect_figures(cell)[name].mean
    return values


def _collect_figures(cell: CellResult) -> Figures:
    return {**cell.metrics, **{f"ablation/{name}": f for name, f in cell.ablation.items()}}


def _place_cells(summary: SweepResult) -> list[PlacedCell]:
    orders = [list(axis.values) for axis in summary.axes]
    placed = []
    for cell in summary.cells:
        if cell.point is not None:
            pairs = zip(orders, cell.point, strict=True)
            placed.append(PlacedCell(tuple(order.index(value) for order, value in pairs), cell))
    return placed


def _plot_heat_map(axes: Axes, summary: SweepResult, name: str) -> None:
    """Plot the first axis downwards and the second to the right; failed cells are hatched."""
    values = collect_grid_values(summary, name)
    image = axes.imshow(np.ma.masked_invalid(values), cmap="viridis", aspect="auto")
    for (row, column), cell in _place_cells(summary):
        value, seeds = values[row, column], len(cell.seeds)
        if np.isfinite(value):
            dark = float(np.asarray(image.norm(value))) < 0.6
            count = f"\n{seeds} of {len(summary.seeds)}" if cell.failures else ""
            _write(axes, column, row, f"{value:.3g}{count}", "white" if dark else INK, 9)
        elif seeds:
            _write(axes, column, row, "none", FAINT, 8)  # not a metric of this cell's networks
        else:
            axes.fill_between(
                [column - 0.5, column + 0.5],
                row - 0.5,
                row + 0.5,
                facecolor="white",
                edgecolor=FAINT,
                hatch="///",
                linewidth=0,
            )
            _write(axes, column, row, _shorten_reason(cell.failures), INK, LABEL)
    down, across = summary.axes
    axes.set(xlabel=across.name, ylabel=down.name)
    axes.set_xticks(range(len(across.values)), across.values)
    axes.set_yticks(range(len(down.values)), down.values)
    axes.grid(False)


def _plot_lines(axes: Axes, summary: SweepResult, name: str) -> None:
    """Plot the mean, its interval and each seed over the axis; failed cells have a cross."""
    (axis,) = summary.axes
    placed = sorted(_place_cells(summary), key=lambda each: each.place)
    figures = {
        place: _collect_figures(cell)[name]
        for (place,), cell in placed
        if name in _collect_figures(cell)
    }
    means = np.array([figure.mean for figure in figures.values()])
    ends = np.array([figure.interval or [figure.mean] * 2 for figure in figures.values()]).T
    colour = next((colour for network, colour in COLOURS.items() if f"/{network}" in name), INK)
    axes.errorbar(
        list(figures),
        means,
        np.abs(ends - means),
        fmt="o-",
        color=colour,
        markersize=4,
        linewidth=1.5,
        capsize=3,
    )
    for place, figure in figures.items():
        seeds = [mean for mean in (figure.per_seed or {}).values() if mean is not None]
        axes.plot([place] * len(seeds), seeds, ".", color=colour, alpha=0.45, markersize=5)
    for (place,), cell in _place_cells(summary):
        if cell.failures:
            below = axes.get_xaxis_transform()
            axes.plot(place, 0.03, "x", color=INK, transform=below, clip_on=False)
            reason = _shorten_reason(cell.failures)
            axes.text(
                place, 0.07, reason, transform=below, fontsize=LABEL, ha="center", va="bottom"
            )
    axes.set_xlabel(axis.name)
    axes.set_xticks(range(len(axis.values)), axis.values)
    axes.margins(x=0.1)


def _write(axes: Axes, x: float, y: float, text: str, colour: str, size: float) -> None:
    on_hatching = colour == INK and size <= LABEL
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1} if on_hatching else None
    axes.text(x, y, text, color=colour, fontsize=size, ha="center", va="center", bbox=box)


def _shorten_reason(failures: Sequence[Failure]) -> str:
    """Shorten the first failure's reason to a few short lines, without what led up to it."""
    reason = str(failures[0].reason).rpartition("stopped: ")[2]
    return "\n".join(textwrap.wrap(reason, 15, max_lines=4, placeholder=" ..."))
