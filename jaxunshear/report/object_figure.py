"""Complete objects as they were felt: heights along the walk, and the shape made of it against the true one."""

import numpy as np
from matplotlib.figure import Figure

from jaxunshear.downstream.object_reconstruction import ReconstructedObject
from jaxunshear.downstream.shape_estimators import SKIN, VORONOI
from jaxunshear.report.trajectory_figure import METHOD_TITLES
from jaxunshear.style import ABREAST, DPI, HEAD, LABEL, PANEL_IN, encode_png, wrap_title

PICTURES = {  # by maker: the end of a file's name, and what is shown
    SKIN: ("skin", "how high the skin stands, red above the level of the object's edge"),
    VORONOI: ("voronoi", "how the pins' cells have grown (red) or shrunk (blue)"),
}


def plot_objects(stimulus: str, solids: dict[str, ReconstructedObject], shown: str) -> bytes:
    """A PNG: of each way of perceiving, ABREAST side by side, above what was fused, below both shapes (grey both, orange missed,
    blue too much). Colours are even about the level that parts an object from what lies beside it, or about 0."""
    columns, rows = min(ABREAST, len(solids)), -(-len(solids) // ABREAST)
    figure = Figure(
        figsize=(PANEL_IN * columns, 2 * PANEL_IN * rows + 0.5), layout="constrained", dpi=DPI
    )
    panels = (
        figure.subplots(2 * rows, columns, squeeze=False)
        .reshape(rows, 2, columns)
        .swapaxes(1, 2)
        .reshape(-1, 2)
    )
    for axes in panels[len(solids) :].ravel():
        axes.set_axis_off()
    for (above, below), (way, solid) in zip(panels, solids.items(), strict=False):
        line = solid.fused.line
        extent = (line[0], line[-1], line[0], line[-1])
        felt_there = ~np.isnan(solid.fused.value)
        level = solid.level or 0.0
        span = (
            np.percentile(np.abs(solid.fused.value[felt_there] - level), 98)
            if felt_there.any()
            else 1.0
        )
        span = max(float(span), 1e-9)
        low, high = level - span, level + span
        above.imshow(
            solid.fused.value, origin="lower", extent=extent, cmap="RdBu_r", vmin=low, vmax=high
        )
        above.contour(line, line, solid.true, levels=[0.5], colors="0.3", linewidths=0.6)
        above.set_title(METHOD_TITLES.get(way, way), fontsize=HEAD)
        picture = np.ones((*solid.shape.shape, 3))
        picture[solid.shape & solid.true] = 0.75
        picture[~solid.shape & solid.true] = (1.0, 0.48, 0.1)
        picture[solid.shape & ~solid.true] = (0.25, 0.59, 1.0)
        below.imshow(picture, origin="lower", extent=extent)
        below.set_title(
            f"IoU {solid.score.iou:.2f}, outline {solid.score.mean_mm:.2f} mm off",
            fontsize=HEAD,
        )
        felt = np.argwhere(felt_there)
        for axes in (above, below):
            axes.tick_params(labelsize=LABEL)
            if len(felt):
                low, high = line[felt.min(axis=0)], line[felt.max(axis=0)]
                axes.set(xlim=(low[1], high[1]), ylim=(low[0], high[0]))
    text = f"{stimulus}: {shown}, and the shape made of it (simulated), mm"
    figure.suptitle(wrap_title(text, columns), fontsize=HEAD + 1)
    return encode_png(figure)
