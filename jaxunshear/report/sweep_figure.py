"""The picture of a sweep: heat maps over a grid of two axes, lines over one axis, a panel a metric."""

import fnmatch
import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxunshear.results.sweep import CellResult, Failure, Figures, SweepResult
from jaxunshear.style import COLOURS, FAINT, INK, LABEL, STYLE, encode_png

SHOWN_METRICS = (  # in this order; a metric that is the same in all cells says nothing and is left out
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


def plot_sweep(summary: SweepResult) -> bytes | None:
    """PNG of a summary as in sweep.json; None for a grid of no axis, or of more than two, or where no cell has figures."""
    panels = select_metrics(summary)
    draw = {1: _lines, 2: _heat_map}.get(len(summary.axes))
    if draw is None or not panels:
        return None
    rows = -(-len(panels) // COLUMNS)
    columns = min(COLUMNS, len(panels))
    with rc_context(STYLE):
        figure = Figure(figsize=(4.2 * columns, 3.6 * rows), layout="constrained", dpi=110)
        places = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, name in zip(places, panels, strict=False):
            draw(axes, summary, name)
            axes.set_title(METRIC_TITLES.get(name, name))
        for axes in places[len(panels) :]:
            axes.set_axis_off()
        figure.suptitle(
            f"{summary.sweep}: means over {len(summary.seeds)} seeds and the test contacts"
        )
        return encode_png(figure)


def select_metrics(summary: SweepResult) -> list[str]:
    """Names of the metrics worth a panel, in the order of `SHOWN_METRICS`."""
    found: dict[str, set[float]] = {}
    cells = [cell for cell in summary.cells if cell.seeds and cell.point is not None]
    for cell in cells:
        for name, figure in _figures(cell).items():
            found.setdefault(name, set()).add(figure.mean)
    differing = [name for name, means in found.items() if len(means) > 1 or len(cells) == 1]
    chosen = (
        name
        for pattern in SHOWN_METRICS
        for name in differing
        if fnmatch.fnmatchcase(name, pattern)
    )
    return list(dict.fromkeys(chosen))


def collect_grid_values(summary: SweepResult, name: str) -> np.ndarray:
    """Means of a metric, in the order of the axes' values; NaN where a cell has none."""
    values = np.full([len(axis.values) for axis in summary.axes], np.nan)
    for place, cell in _places(summary):
        if name in _figures(cell):
            values[place] = _figures(cell)[name].mean
    return values


def _figures(cell: CellResult) -> Figures:
    return {
        **cell.metrics,
        **{f"ablation/{name}": figure for name, figure in cell.ablation.items()},
    }


def _places(summary: SweepResult) -> list[tuple[tuple[int, ...], CellResult]]:
    """The cells of the grid with their indices along the axes."""
    orders = [list(axis.values) for axis in summary.axes]
    return [
        (tuple(order.index(value) for order, value in zip(orders, cell.point, strict=True)), cell)
        for cell in summary.cells
        if cell.point is not None
    ]


def _heat_map(axes: Axes, summary: SweepResult, name: str) -> None:
    """The first axis downwards, the second to the right; a number in each cell, a failure hatched with its reason."""
    values = collect_grid_values(summary, name)
    image = axes.imshow(np.ma.masked_invalid(values), cmap="viridis", aspect="auto")
    for (row, column), cell in _places(summary):
        value = values[row, column]
        if np.isfinite(value):
            dark = float(np.asarray(image.norm(value))) < 0.6
            partly = "" if not cell.failures else f"\n{len(cell.seeds)} of {len(summary.seeds)}"
            _write(axes, column, row, f"{value:.3g}{partly}", "white" if dark else INK, 9)
        elif cell.seeds:
            _write(axes, column, row, "none", FAINT, 8)  # the networks of this cell do not have it
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
            _write(axes, column, row, _short(cell.failures), INK, LABEL)
    down, across = summary.axes
    axes.set(xlabel=across.name, ylabel=down.name)
    axes.set_xticks(range(len(across.values)), across.values)
    axes.set_yticks(range(len(down.values)), down.values)
    axes.grid(False)


def _lines(axes: Axes, summary: SweepResult, name: str) -> None:
    """The mean with its interval over the values of the axis, a point a seed; failures crossed below, with their reasons."""
    (axis,) = summary.axes
    there = sorted(
        ((place[0], cell) for place, cell in _places(summary) if name in _figures(cell)),
        key=lambda at: at[0],
    )
    x = [place for place, _ in there]
    figures = [_figures(cell)[name] for _, cell in there]
    means = np.array([figure.mean for figure in figures])
    colour = next((colour for network, colour in COLOURS.items() if f"/{network}" in name), INK)
    bands = np.array([figure.interval or [figure.mean] * 2 for figure in figures]).T
    axes.errorbar(
        x,
        means,
        np.abs(bands - means),
        fmt="o-",
        color=colour,
        markersize=4,
        linewidth=1.5,
        capsize=3,
    )
    for place, figure in zip(x, figures, strict=True):
        seeds = [mean for mean in (figure.per_seed or {}).values() if mean is not None]
        axes.plot([place] * len(seeds), seeds, ".", color=colour, alpha=0.45, markersize=5)
    for (place,), cell in _places(summary):
        if cell.failures:
            below = axes.get_xaxis_transform()
            axes.plot(place, 0.03, "x", color=INK, transform=below, clip_on=False)
            axes.text(
                place,
                0.07,
                _short(cell.failures),
                transform=below,
                fontsize=LABEL,
                ha="center",
                va="bottom",
            )
    axes.set_xlabel(axis.name)
    axes.set_xticks(range(len(axis.values)), axis.values)
    axes.margins(x=0.1)


def _write(axes: Axes, x: float, y: float, text: str, colour: str, size: float) -> None:
    box = (
        {"facecolor": "white", "edgecolor": "none", "pad": 1}
        if colour == INK and size <= LABEL
        else None
    )
    axes.text(x, y, text, color=colour, fontsize=size, ha="center", va="center", bbox=box)


def _short(failures: Sequence[Failure]) -> str:
    """The first failure's reason in a few short lines, without what led up to it."""
    reason = str(failures[0].reason).rpartition("stopped: ")[2]
    return "\n".join(textwrap.wrap(reason, 15, max_lines=4, placeholder=" ..."))
