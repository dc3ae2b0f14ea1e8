"""A picture of the sensor's trajectories around an object, for each way of perceiving."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from jaxunshear.config.networks import REGISTRY, UNSHEARING
from jaxunshear.downstream.contour import Contour
from jaxunshear.downstream.servo import CLOSED, ENDS, Trajectories
from jaxunshear.report.figures import make_panels
from jaxunshear.style import ABREAST, DPI, HEAD, LABEL, PANEL_IN, encode_png, wrap_title

METHOD_TITLES = {
    "true": "true pose",
    "sheared": "sheared images",
    **{name: f"unsheared, {REGISTRY[name].title}" for name in UNSHEARING},
    "learnt": "sheared, PoseNet that learnt slides",
}


def plot_trajectories(walks: Trajectories, line: Contour, stimulus: str) -> bytes:
    """Plot a panel for each method as a PNG, with all its walks over the object.

    A red dot marks a start, as in the paper; a cross marks an end that did not close the outline.
    """
    methods = list(dict.fromkeys(walks.method.tolist()))
    columns = min(ABREAST, len(methods))
    figure, panels = make_panels(len(methods), columns, (PANEL_IN, PANEL_IN + 0.3), 0.3, DPI)
    for axes, method in zip(panels, methods, strict=True):
        axes.add_patch(Polygon(line.points, facecolor="0.9", edgecolor="0.6", linewidth=0.8))
        _plot_walks(axes, walks, method)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=LABEL)
    title = wrap_title(f"{stimulus}: the sensor's way, mm (simulated)", columns)
    figure.suptitle(title, fontsize=HEAD + 1)
    return encode_png(figure)


def _plot_walks(axes: Axes, walks: Trajectories, method: str) -> None:
    rows = np.flatnonzero(walks.method == method)
    for walk in rows:
        track = walks.point[walk, ~np.isnan(walks.point[walk, :, 0]), :2]
        axes.plot(*track.T, linewidth=0.9)
        axes.plot(*track[0], "o", color="red", markersize=4)
        if walks.end[walk] != CLOSED:
            axes.plot(*track[-1], "x", color="black", markersize=6)
    ends = [ENDS[end] for end in walks.end[rows] if end != CLOSED]
    most_frequent_end = f"\n{max(set(ends), key=ends.count)}" if ends else ""
    closed = f"{len(rows) - len(ends)} of {len(rows)} closed{most_frequent_end}"
    axes.set_title(f"{METHOD_TITLES.get(method, method)}\n{closed}", fontsize=HEAD)
