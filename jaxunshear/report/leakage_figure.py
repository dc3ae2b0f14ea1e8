"""A picture of what each code contains, beside reconstructions from exchanged codes."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from jaxunshear.evaluation.codes import ExchangedCodes
from jaxunshear.files import Json
from jaxunshear.style import encode_png

BARS = {
    "r2": "code",
    "untrained": "code of an untrained network",
    "ceiling": "ceiling: what the input shows",
    "shuffled": "shuffled labels",
}
PIN_TITLE = (
    "DS of exchanged codes (red), of a contact's own (blue);\ncircles: the simulated contact"
)
IMAGE_TITLE = (
    "What DS draws too bright (red) and too dark (blue),\n"
    "beside the simulated contact; the diagonal: of its own codes"
)


def plot_leakage(results: Json, exchanged: ExchangedCodes | None) -> bytes:
    """Plot the probes of each code as bars, and exchanged codes if there are any, as a PNG."""
    side = 0 if exchanged is None else len(exchanged.true)
    size = (6 + 1.5 * side, 1.2 + max(3.2, 1.6 * side))
    figure = Figure(figsize=size, layout="constrained", dpi=110)
    if exchanged is None:
        _plot_bars(figure, results)
    else:
        subfigures = figure.subfigures(1, 2, squeeze=False, width_ratios=(6, 1.6 * side))
        _plot_bars(subfigures[0, 0], results)
        _plot_exchanges(subfigures[0, 1], exchanged)
    return encode_png(figure)


def _plot_bars(figure: FigureBase, results: Json) -> None:
    rows = [row for row in results["summary"] if row["quantities"]]
    axes = figure.subplots()
    names = [name for name in BARS if rows and name in rows[0]]
    height = 0.8 / max(1, len(names))
    for index, name in enumerate(names):
        y = np.arange(len(rows)) + (index - (len(names) - 1) / 2) * height
        values = [row[name] for row in rows]
        axes.barh(y, values, height, label=BARS[name])
        if name == "r2":
            low = [row["r2"] - row["r2 interval"][0] for row in rows]
            high = [row["r2 interval"][1] - row["r2"] for row in rows]
            ends = np.maximum(np.array([low, high]), 0)
            axes.errorbar(values, y, xerr=ends, fmt="none", color="black", lw=1)
    titles = [row["name"] + (" (a leak)" if row["leak"] else "") for row in rows]
    axes.set_yticks(np.arange(len(rows)), titles)
    lowest = min([-0.1, *(row["r2"] for row in rows)])
    axes.set(xlabel="R2 on test poses, strongest probe", xlim=(lowest, 1.05))
    axes.invert_yaxis()
    axes.axvline(0, color="black", lw=0.8)
    handles, texts = axes.get_legend_handles_labels()
    figure.legend(handles, texts, fontsize=8, loc="outside lower center", ncols=2)


def _plot_exchanges(figure: FigureBase, exchanged: ExchangedCodes) -> None:
    side, images = len(exchanged.true), exchanged.true.ndim == 5
    panels = figure.subplots(side, side, squeeze=False)
    for (i, j), axes in np.ndenumerate(panels):
        (_plot_image if images else _plot_pins)(axes, exchanged, i, j)
        axes.set(xticks=[], yticks=[], aspect="equal")
        if j == 0:
            axes.set_ylabel(f"z_p of pose {i + 1}", fontsize=7)
        if i == side - 1:
            axes.set_xlabel(f"z_s of slide {j + 1}", fontsize=7)
    figure.suptitle(IMAGE_TITLE if images else PIN_TITLE, fontsize=8)


def _plot_pins(axes: Axes, exchanged: ExchangedCodes, i: int, j: int) -> None:
    centre = exchanged.true.mean(axis=(0, 1, 2))
    reach = 1.05 * np.ptp(exchanged.true, axis=(0, 1, 2)).max() / 2
    true, decoded = exchanged.true[i, j], exchanged.decoded[i, j]
    axes.scatter(true[:, 0], true[:, 1], s=5, facecolors="none", edgecolors="0.5", lw=0.6)
    colour = "tab:blue" if i == j else "tab:red"
    axes.scatter(decoded[:, 0], decoded[:, 1], s=1.2, color=colour)
    low, high = centre - reach, centre + reach
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]))
    rms = float(np.sqrt(np.mean(np.sum((true - decoded) ** 2, axis=-1))))
    axes.set_title(f"{rms:.2f} px", fontsize=7, pad=2)


def _plot_image(axes: Axes, exchanged: ExchangedCodes, i: int, j: int) -> None:
    """Plot in white where both images are bright, in red or blue where only one is."""
    true, decoded = exchanged.true[i, j, ..., 0], exchanged.decoded[i, j, ..., 0]
    colours = np.stack([decoded, np.minimum(decoded, true), true], axis=-1)
    axes.imshow(colours, interpolation="nearest")
    axes.set_title(f"{np.sqrt(np.mean((true - decoded) ** 2)):.3f}", fontsize=7, pad=2)
