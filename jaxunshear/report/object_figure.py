"""A picture of reconstructed objects: fused values along the walks, and their shape."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxunshear.downstream.object_reconstruction import ReconstructedObject
from jaxunshear.downstream.reconstruct import SKIN, VORONOI
from jaxunshear.report.trajectory_figure import METHOD_TITLES
from jaxunshear.style import ABREAST, DPI, HEAD, LABEL, PANEL_IN, encode_png, wrap_title

PICTURES = {  # by shape estimator: the end of a file's name, and the subject of the picture
    SKIN: ("skin", "how high the skin stands, red above the level of the object's edge"),
    VORONOI: ("voronoi", "how the pins' cells have grown (red) or shrunk (blue)"),
}
MATCH, MISSED, SURPLUS = (0.75,) * 3, (1.0, 0.48, 0.1), (0.25, 0.59, 1.0)


def plot_objects(stimulus: str, objects: dict[str, ReconstructedObject], subject: str) -> bytes:
    """Plot the objects of each method as a PNG, with the fused values above the shapes."""
    columns, rows = min(ABREAST, len(objects)), -(-len(objects) // ABREAST)
    size = (PANEL_IN * columns, 2 * PANEL_IN * rows + 0.5)
    figure = Figure(figsize=size, layout="constrained", dpi=DPI)
    panels = figure.subplots(2 * rows, columns, squeeze=False).reshape(rows, 2, columns)
    pairs = panels.swapaxes(1, 2).reshape(-1, 2)
    for axes in pairs[len(objects) :].ravel():
        axes.set_axis_off()
    for (above, below), (method, solid) in zip(pairs, objects.items(), strict=False):
        _plot_values(above, solid)
        above.set_title(METHOD_TITLES.get(method, method), fontsize=HEAD)
        _plot_shapes(below, solid)
        for axes in (above, below):
            axes.tick_params(labelsize=LABEL)
            _zoom(axes, solid)
    text = f"{stimulus}: {subject}, and the shape made of it (simulated), mm"
    figure.suptitle(wrap_title(text, columns), fontsize=HEAD + 1)
    return encode_png(figure)


def _plot_values(axes: Axes, solid: ReconstructedObject) -> None:
    """Plot the fused values, with colours symmetric about the object's level, or about 0."""
    values, line, level = solid.fused.value, solid.fused.line, solid.level or 0.0
    measured = ~np.isnan(values)
    span = np.percentile(np.abs(values[measured] - level), 98) if measured.any() else 1.0
    span = max(float(span), 1e-9)
    low, high, extent = level - span, level + span, (line[0], line[-1], line[0], line[-1])
    axes.imshow(values, origin="lower", extent=extent, cmap="RdBu_r", vmin=low, vmax=high)
    axes.contour(line, line, solid.true, levels=[0.5], colors="0.3", linewidths=0.6)


def _plot_shapes(axes: Axes, solid: ReconstructedObject) -> None:
    """Plot where the shape matches the true one, misses a part of it, and exceeds it."""
    line, score = solid.fused.line, solid.score
    picture = np.ones((*solid.shape.shape, 3))
    picture[solid.shape & solid.true] = MATCH
    picture[~solid.shape & solid.true] = MISSED
    picture[solid.shape & ~solid.true] = SURPLUS
    axes.imshow(picture, origin="lower", extent=(line[0], line[-1], line[0], line[-1]))
    text = f"IoU {score.iou:.2f}, outline {score.mean_mm:.2f} mm off"
    axes.set_title(text, fontsize=HEAD)


def _zoom(axes: Axes, solid: ReconstructedObject) -> None:
    """Zoom in on the cells that have values."""
    cells = np.argwhere(~np.isnan(solid.fused.value))
    if len(cells):
        line = solid.fused.line
        low, high = line[cells.min(axis=0)], line[cells.max(axis=0)]
        axes.set(xlim=(low[1], high[1]), ylim=(low[0], high[0]))
