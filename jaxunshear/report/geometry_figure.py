"""Contact geometry as rows of surfaces: tap, sheared, and unsheared by each network."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jaxunshear.data.simulation import SimulatedContacts
from jaxunshear.downstream.geometry import HEIGHT_METHODS, INVERSE, interpolate_surface
from jaxunshear.downstream.geometry_scores import UNTOUCHED, Geometry, compute_correlation
from jaxunshear.perception.lattice import Lattice
from jaxunshear.style import ABREAST, DPI, LABEL, PANEL_IN, encode_png

CELLS, WIDTH = 48, 2.7
TRUTH = "true indentation"
VIEW = {"elev": 42, "azim": -60}


class SurfaceRow(NamedTuple):
    """One row of surfaces."""

    name: str
    heights: Mapping[str, np.ndarray]  # (P,) by kind of image; NaN if pins are not identified


def plot_contacts(
    lattice: Lattice, names: tuple[str, ...], contacts: SimulatedContacts, geometry: Geometry
) -> bytes:
    """Plot one contact of every stimulus as a PNG, with a row for each method.

    The contact is the one of median correlation between its sheared geometry and the truth.
    """
    truth = contacts.indentation_mm
    height = {key: each for key, each in geometry.height_mm.items() if key[0] != UNTOUCHED}
    correlation = compute_correlation(np.nan_to_num(height["sheared", INVERSE]), truth)
    complete = np.all([~np.isnan(each[:, 0]) for each in height.values()], axis=0)
    kinds = list(dict.fromkeys(kind for kind, _ in height))
    rows = []
    for index, name in enumerate(names):
        candidates = np.flatnonzero((contacts.stimulus == index) & complete)
        if len(candidates):
            order = np.argsort(correlation[candidates])
            contact = int(candidates[order[len(candidates) // 2]])
            for method in HEIGHT_METHODS:
                heights = {kind: height[kind, method][contact] for kind in kinds}
                rows.append(SurfaceRow(f"{name}, {method}", {TRUTH: truth[contact], **heights}))
    return _plot_surfaces(lattice, rows)


def plot_recordings(lattice: Lattice, shown: tuple[list[str], dict[str, np.ndarray]]) -> bytes:
    """Plot a row of surfaces for each recorded image as a PNG, without truth."""
    names, kinds = shown
    rows = []
    for i, name in enumerate(names):
        rows.append(SurfaceRow(name, {kind: height[i] for kind, height in kinds.items()}))
    return _plot_surfaces(lattice, rows)


def _plot_surfaces(lattice: Lattice, rows: list[SurfaceRow]) -> bytes:
    columns = len(rows[0].heights) if rows else 1
    width = WIDTH * columns
    figure = Figure(figsize=(width, 2.6 * max(1, len(rows))), layout="constrained", dpi=DPI)
    fontsize = LABEL * max(1, width / (ABREAST * PANEL_IN))  # a page shrinks wider pictures
    place = 0
    for row in rows:
        known = [height for height in row.heights.values() if not np.isnan(height[0])]
        span = np.percentile(np.concatenate(known or [np.zeros(2)]), [0.5, 99.5])
        for column, (kind, height) in enumerate(row.heights.items()):
            place += 1
            axes = figure.add_subplot(len(rows), columns, place, projection="3d")
            axes.set_axis_off()
            title = kind if place <= columns else ""
            if np.isnan(height[0]):
                middle = {"ha": "center", "transform": axes.transAxes, "fontsize": fontsize}
                axes.text2D(0.5, 0.5, "pins not sure", **middle)
            else:
                _plot_surface(axes, lattice, height, span)
                if TRUTH in row.heights and kind != TRUTH:
                    correlation = compute_correlation(height[None], row.heights[TRUTH][None])[0]
                    title += f"\ncorrelation {correlation:.2f}"
            axes.set_title(title, fontsize=fontsize)
            if column == 0:
                name = row.name[-30:]
                axes.text2D(0.0, 0.92, name, transform=axes.transAxes, fontsize=fontsize)
    return encode_png(figure)


def _plot_surface(axes: Any, lattice: Lattice, height: np.ndarray, span: np.ndarray) -> None:
    low, high = lattice.rest.min(axis=0), lattice.rest.max(axis=0)
    x, y = np.meshgrid(*(np.linspace(low[i], high[i], CELLS) for i in (0, 1)))
    z = interpolate_surface(lattice.rest, height, CELLS)
    strides = {"rstride": 1, "cstride": 1, "lw": 0}
    axes.plot_surface(x, -y, z, cmap="viridis", vmin=span[0], vmax=span[1], **strides)
    axes.set_zlim(*span)
    axes.view_init(**VIEW)
