"""Whole objects as they were felt: evidence along the walk, and the shape that it encloses against the true one."""

import io

import numpy as np
from matplotlib.figure import Figure

from jaxunshear.applications.objects import Solid
from jaxunshear.applications.occupancy import CERTAIN
from jaxunshear.report.walk_figure import WORDS

WIDTH = 3.2


def object_figure(stimulus: str, solids: dict[str, Solid]) -> bytes:
    """A PNG: a column a way of perceiving; above the fused evidence, below both shapes (grey both, orange missed, blue too much)."""
    figure = Figure(figsize=(WIDTH * len(solids), 2 * WIDTH + 0.5), layout="constrained", dpi=110)
    panels = figure.subplots(2, len(solids), squeeze=False)
    for (above, below), (way, solid) in zip(panels.T, solids.items(), strict=True):
        extent = (solid.fused.x[0], solid.fused.x[-1], solid.fused.y[0], solid.fused.y[-1])
        above.imshow(solid.fused.evidence, origin="lower", extent=extent, cmap="RdBu_r", vmin=-CERTAIN, vmax=CERTAIN)
        above.contour(solid.fused.x, solid.fused.y, solid.true, levels=[0.5], colors="0.3", linewidths=0.6)
        above.set_title(WORDS.get(way, way), fontsize=8)
        picture = np.ones((*solid.shape.shape, 3))
        picture[solid.shape & solid.true] = 0.75
        picture[~solid.shape & solid.true] = (1.0, 0.48, 0.1)
        picture[solid.shape & ~solid.true] = (0.25, 0.59, 1.0)
        below.imshow(picture, origin="lower", extent=extent)
        below.set_title(f"IoU {solid.likeness.iou:.2f}, outline {solid.likeness.mean_mm:.2f} mm off", fontsize=8)
        felt = np.argwhere(~np.isnan(solid.fused.evidence))
        for axes in (above, below):
            axes.tick_params(labelsize=6)
            if len(felt):
                low, high = solid.fused.x[felt.min(axis=0)], solid.fused.x[felt.max(axis=0)]
                axes.set(xlim=(low[1], high[1]), ylim=(low[0], high[0]))
    figure.suptitle(
        f"{stimulus}: felt to be over the object (red) or beside it (blue), and the shape enclosed (simulated), mm",
        fontsize=9,
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": ""})
    return buffer.getvalue()
