"""Contact geometry as the paper's row of surfaces: tap, sheared, unsheared by each network; and the truth where it is known."""

import numpy as np
from matplotlib.figure import Figure

from jaxunshear.data.simulated_contacts import SimulatedContacts
from jaxunshear.downstream.geometry import HEIGHT_METHODS, INVERSE, interpolate_surface
from jaxunshear.downstream.geometry_scores import UNTOUCHED, Geometry, compute_correlation
from jaxunshear.perception.lattice import Lattice
from jaxunshear.style import ABREAST, DPI, LABEL, PANEL_IN, encode_png

CELLS, WIDTH = 48, 2.7
TRUTH = "true indentation"
VIEW = {"elev": 42, "azim": -60}


def plot_contacts(
    lattice: Lattice, names: tuple[str, ...], contacts: SimulatedContacts, geometry: Geometry
) -> bytes:
    """A PNG: of every stimulus the contact whose sheared geometry is of middling likeness to the truth; a line for each way."""
    height = {at: each for at, each in geometry.height_mm.items() if at[0] != UNTOUCHED}
    sheared = compute_correlation(
        np.nan_to_num(height["sheared", INVERSE]), contacts.indentation_mm
    )
    full = np.all([~np.isnan(each[:, 0]) for each in height.values()], axis=0)
    kinds = list(dict.fromkeys(kind for kind, _ in height))
    lines = []
    for index, name in enumerate(names):
        here = np.flatnonzero((contacts.stimulus == index) & full)
        if len(here):
            row = int(here[np.argsort(sheared[here])[len(here) // 2]])
            for way in HEIGHT_METHODS:
                heights = {kind: height[kind, way][row] for kind in kinds}
                lines.append((f"{name}, {way}", {TRUTH: contacts.indentation_mm[row], **heights}))
    return _surfaces(lattice, lines, TRUTH)


def plot_recordings(lattice: Lattice, shown: tuple[list[str], dict[str, np.ndarray]]) -> bytes:
    """A PNG: a line an image, without truth."""
    names, kinds = shown
    lines = [
        (name, {kind: height[i] for kind, height in kinds.items()}) for i, name in enumerate(names)
    ]
    return _surfaces(lattice, lines, None)


def _surfaces(
    lattice: Lattice, lines: list[tuple[str, dict[str, np.ndarray]]], truth: str | None
) -> bytes:
    columns = len(lines[0][1]) if lines else 1
    wide = WIDTH * columns
    figure = Figure(figsize=(wide, 2.6 * max(1, len(lines))), layout="constrained", dpi=DPI)
    size = LABEL * max(1, wide / (ABREAST * PANEL_IN))  # a page shows a wider picture smaller
    low, high = lattice.rest.min(axis=0), lattice.rest.max(axis=0)
    x, y = np.meshgrid(*(np.linspace(low[i], high[i], CELLS) for i in (0, 1)))
    for row, (name, heights) in enumerate(lines):
        reported = np.concatenate(
            [height for height in heights.values() if not np.isnan(height[0])] or [np.zeros(2)]
        )
        span = np.percentile(reported, [0.5, 99.5])
        for column, (kind, height) in enumerate(heights.items()):
            axes = figure.add_subplot(
                len(lines), columns, 1 + row * columns + column, projection="3d"
            )
            axes.set_axis_off()
            title = kind if row == 0 else ""
            if np.isnan(height[0]):
                axes.text2D(
                    0.5, 0.5, "pins not sure", ha="center", transform=axes.transAxes, fontsize=size
                )
            else:
                drawn = interpolate_surface(lattice.rest, height, CELLS)
                axes.plot_surface(
                    x,
                    -y,
                    drawn,
                    cmap="viridis",
                    vmin=span[0],
                    vmax=span[1],
                    rstride=1,
                    cstride=1,
                    lw=0,
                )
                axes.set_zlim(*span)
                axes.view_init(**VIEW)
                if truth is not None and kind != truth:
                    likeness = compute_correlation(height[None], heights[truth][None])[0]
                    title += f"\ncorrelation {likeness:.2f}"
            axes.set_title(title, fontsize=size)
            if column == 0:
                axes.text2D(0.0, 0.92, name[-30:], transform=axes.transAxes, fontsize=size)
    return encode_png(figure)
