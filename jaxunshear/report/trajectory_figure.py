"""Where the sensor went around an object, for each way of perceiving; the start is a red dot, as in the paper."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from jaxunshear.config.registry import REGISTRY, UNSHEARING
from jaxunshear.downstream.contour import Contour
from jaxunshear.downstream.servo import CLOSED, ENDS, Trajectories
from jaxunshear.style import ABREAST, DPI, HEAD, LABEL, PANEL_IN, encode_png, wrap_title

METHOD_TITLES = {
    "true": "true pose",
    "sheared": "sheared images",
    **{name: f"unsheared, {REGISTRY[name].title}" for name in UNSHEARING},
    "learnt": "sheared, PoseNet that learnt slides",
}


def plot_trajectories(walks: Trajectories, line: Contour, stimulus: str) -> bytes:
    """A PNG: a panel a way, all its walks over the object; a cross where one ended without closing the outline."""
    ways = list(dict.fromkeys(walks.method.tolist()))
    columns, rows = min(ABREAST, len(ways)), -(-len(ways) // ABREAST)
    figure = Figure(
        figsize=(PANEL_IN * columns, (PANEL_IN + 0.3) * rows + 0.3), layout="constrained", dpi=DPI
    )
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(ways) :]:
        axes.set_axis_off()
    for axes, way in zip(panels, ways, strict=False):
        axes.add_patch(Polygon(line.points, facecolor="0.9", edgecolor="0.6", linewidth=0.8))
        mine = np.flatnonzero(walks.method == way)
        for walk in mine:
            track = walks.point[walk, ~np.isnan(walks.point[walk, :, 0]), :2]
            axes.plot(*track.T, linewidth=0.9)
            axes.plot(*track[0], "o", color="red", markersize=4)
            if walks.end[walk] != CLOSED:
                axes.plot(*track[-1], "x", color="black", markersize=6)
        ends = [ENDS[end] for end in walks.end[mine] if end != CLOSED]
        why = f"\n{max(set(ends), key=ends.count)}" if ends else ""
        axes.set_title(
            f"{METHOD_TITLES.get(way, way)}\n{len(mine) - len(ends)} of {len(mine)} closed{why}",
            fontsize=HEAD,
        )
        axes.set_aspect("equal")
        axes.tick_params(labelsize=LABEL)
    figure.suptitle(
        wrap_title(f"{stimulus}: the sensor's way, mm (simulated)", columns), fontsize=HEAD + 1
    )
    return encode_png(figure)
