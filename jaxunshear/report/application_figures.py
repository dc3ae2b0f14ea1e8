"""Pictures of commands that use trained networks: trajectories, objects, surfaces and pins."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from jaxunshear.config.networks import REGISTRY, UNSHEARING
from jaxunshear.data.recorded_pins import ShownImage
from jaxunshear.data.simulation import SimulatedContacts
from jaxunshear.downstream.contour import Contour
from jaxunshear.downstream.geometry import HEIGHT_METHODS, INVERSE, interpolate_surface
from jaxunshear.downstream.geometry_scores import UNTOUCHED, Geometry, compute_correlation
from jaxunshear.downstream.object_reconstruction import ReconstructedObject
from jaxunshear.downstream.reconstruct import SKIN, VORONOI
from jaxunshear.downstream.servo import CLOSED, ENDS, Trajectories
from jaxunshear.perception.lattice import Lattice
from jaxunshear.style import (
    ABREAST,
    DPI,
    HEAD,
    LABEL,
    PANEL_IN,
    encode_png,
    make_panels,
    wrap_title,
)

PICTURES = {  # by shape estimator: the end of a file's name, and the subject of the picture
    SKIN: ("skin", "how high the skin stands, red above the level of the object's edge"),
    VORONOI: ("voronoi", "how the pins' cells have grown (red) or shrunk (blue)"),
}
MATCH, MISSED, SURPLUS = (0.75,) * 3, (1.0, 0.48, 0.1), (0.25, 0.59, 1.0)
SHAPE_KEYS = [
    Patch(color=MATCH, label="object, found"),
    Patch(color=MISSED, label="object, missed"),
    Patch(color=SURPLUS, label="found beside it"),
    Line2D([], [], color="0.3", linewidth=0.6, label="true outline (above)"),
]
WALK_KEYS = [
    Patch(facecolor="0.9", edgecolor="0.6", label="object"),
    Line2D([], [], color="C0", linewidth=0.9, label="a walk in each colour"),
    Line2D([], [], linestyle="", marker="o", color="red", markersize=4, label="start"),
    Line2D([], [], linestyle="", marker="x", color="black", label="end, not closed"),
]
SURFACE_CELLS, SURFACE_IN = 48, 2.7
TRUTH = "true indentation"
TICKS_MM = (-10, 0, 10)
VIEW = {"elev": 42, "azim": -60}
PIN_COLUMNS = 4
METHOD_TITLES = {
    "true": "true pose",
    "sheared": "sheared images",
    **{name: f"unsheared, {REGISTRY[name].title}" for name in UNSHEARING},
    "learnt": "sheared, PoseNet that learnt slides",
}


def plot_trajectories(walks: Trajectories, line: Contour, stimulus: str) -> bytes:
    """Plot a panel for each method as a PNG, with all its walks over the object."""
    methods = list(dict.fromkeys(walks.method.tolist()))
    columns = min(ABREAST, len(methods))
    figure, panels = make_panels(len(methods), columns, (PANEL_IN, PANEL_IN + 0.5), 0.9, DPI)
    for axes, method in zip(panels, methods, strict=True):
        axes.add_patch(Polygon(line.points, facecolor="0.9", edgecolor="0.6", linewidth=0.8))
        _plot_walks(axes, walks, method)
        axes.set_aspect("equal")
        _label_mm(axes)
    title = wrap_title(f"{stimulus}: the sensor's way (simulated)", columns)
    figure.suptitle(title, fontsize=HEAD + 1)
    _add_keys(figure, WALK_KEYS, columns)
    return encode_png(figure)


def _label_mm(axes: Axes) -> None:
    axes.tick_params(labelsize=LABEL)
    axes.set_xlabel("x, mm", fontsize=LABEL)
    axes.set_ylabel("y, mm", fontsize=LABEL)


def _add_keys(figure: Figure, keys: list[Artist], columns: int) -> None:
    figure.legend(
        handles=keys, loc="outside lower center", ncols=2 * columns, fontsize=LABEL, frameon=False
    )


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
            _label_mm(axes)
            _zoom(axes, solid)
    text = f"{stimulus}: {subject}, and the shape made of it (simulated)"
    figure.suptitle(wrap_title(text, columns), fontsize=HEAD + 1)
    _add_keys(figure, SHAPE_KEYS, columns)
    return encode_png(figure)


def _plot_values(axes: Axes, solid: ReconstructedObject) -> None:
    """Plot the fused values, with colours symmetric about the object's level, or about 0."""
    values, line, level = solid.fused.value, solid.fused.line, solid.level or 0.0
    measured = ~np.isnan(values)
    span = np.percentile(np.abs(values[measured] - level), 98) if measured.any() else 1.0
    span = max(float(span), 1e-9)
    low, high, extent = level - span, level + span, (line[0], line[-1], line[0], line[-1])
    image = axes.imshow(values, origin="lower", extent=extent, cmap="RdBu_r", vmin=low, vmax=high)
    _add_scale(image, [axes], "growth of cells" if solid.level is None else "height, mm")
    axes.contour(line, line, solid.true, levels=[0.5], colors="0.3", linewidths=0.6)


def _add_scale(
    image: ScalarMappable, panels: list[Axes], text: str, fontsize: float = LABEL
) -> None:
    """Add a scale of colours to the right of panels."""
    scale = panels[0].figure.colorbar(image, ax=panels, shrink=0.7, pad=0.02, aspect=16)
    scale.set_label(text, fontsize=fontsize)
    scale.ax.tick_params(labelsize=fontsize)


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
    cells = np.argwhere(~np.isnan(solid.fused.value))
    if len(cells):
        line = solid.fused.line
        low, high = line[cells.min(axis=0)], line[cells.max(axis=0)]
        axes.set(xlim=(low[1], high[1]), ylim=(low[0], high[0]))


class SurfaceRow(NamedTuple):
    """One row of surfaces."""

    name: str
    heights: Mapping[str, np.ndarray]  # (P,) by kind of image; NaN if pins are not identified


def plot_contacts(
    places_mm: np.ndarray, names: tuple[str, ...], contacts: SimulatedContacts, geometry: Geometry
) -> bytes:
    """Plot one contact of every stimulus as a PNG, with a row for each method.

    `places_mm` (P, 2) are the pins' rest positions. The contact is the one of median correlation
    between its sheared geometry and the truth.
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
    return _plot_surfaces(places_mm, rows)


def plot_recordings(places_mm: np.ndarray, shown: tuple[list[str], dict[str, np.ndarray]]) -> bytes:
    """Plot a row of surfaces for each recorded image as a PNG, without truth."""
    names, kinds = shown
    rows = []
    for i, name in enumerate(names):
        rows.append(SurfaceRow(name, {kind: height[i] for kind, height in kinds.items()}))
    return _plot_surfaces(places_mm, rows)


def _plot_surfaces(places_mm: np.ndarray, rows: list[SurfaceRow]) -> bytes:
    columns = len(rows[0].heights) if rows else 1
    width = SURFACE_IN * columns
    figure = Figure(figsize=(width, 2.6 * max(1, len(rows))), layout="constrained", dpi=DPI)
    fontsize = LABEL * max(1, width / (ABREAST * PANEL_IN))  # a page shrinks wider pictures
    place, panels = 0, []
    for row in rows:
        known = [height for height in row.heights.values() if not np.isnan(height[0])]
        span = np.percentile(np.concatenate(known or [np.zeros(2)]), [0.5, 99.5])
        for column, (kind, height) in enumerate(row.heights.items()):
            place += 1
            axes = figure.add_subplot(len(rows), columns, place, projection="3d")
            panels.append(axes)
            title = kind if place <= columns else ""
            if np.isnan(height[0]):
                middle = {"ha": "center", "transform": axes.transAxes, "fontsize": fontsize}
                axes.set_axis_off()
                axes.text2D(0.5, 0.5, "pins not sure", **middle)
            else:
                _plot_surface(axes, places_mm, height, span)
                if TRUTH in row.heights and kind != TRUTH:
                    correlation = compute_correlation(height[None], row.heights[TRUTH][None])[0]
                    title += f"\ncorrelation {correlation:.2f}"
            axes.set_title(title, fontsize=fontsize)
            if column == 0:
                name = row.name[-30:]
                axes.text2D(0.0, 0.92, name, transform=axes.transAxes, fontsize=fontsize)
        scale = ScalarMappable(Normalize(*span), "viridis")
        _add_scale(scale, panels[-columns:], "indentation, mm", fontsize)
    return encode_png(figure)


def _plot_surface(axes: Any, places_mm: np.ndarray, height: np.ndarray, span: np.ndarray) -> None:
    low, high = places_mm.min(axis=0), places_mm.max(axis=0)
    x, y = np.meshgrid(*(np.linspace(low[i], high[i], SURFACE_CELLS) for i in (0, 1)))
    z = interpolate_surface(places_mm, height, SURFACE_CELLS)
    strides = {"rstride": 1, "cstride": 1, "lw": 0}
    axes.plot_surface(x, -y, z, cmap="viridis", vmin=span[0], vmax=span[1], **strides)
    axes.set_zlim(*span)
    axes.set(xticks=TICKS_MM, yticks=TICKS_MM, zticks=[])
    axes.tick_params(labelsize=LABEL, pad=-3)
    axes.set_xlabel("x, mm", fontsize=LABEL, labelpad=-7)
    axes.set_ylabel("y, mm", fontsize=LABEL, labelpad=-7)
    axes.set_box_aspect(None, zoom=0.85)
    axes.view_init(**VIEW)


def plot_pins(lattice: Lattice, images: Sequence[ShownImage]) -> bytes:
    """Plot the pins of images as a PNG.

    Rings of pins alternate between two colours, which makes a mistaken identity visible.
    """
    figure, panels = make_panels(len(images), PIN_COLUMNS, (3.6, 3.9), dpi=110)
    for axes, image in zip(panels, images, strict=True):
        _plot_image(axes, lattice, image)
    figure.suptitle(
        "Lines lead from where each pin stands untouched to where it is; circled: not found",
        fontsize=9,
    )
    return encode_png(figure)


def _plot_image(axes: Axes, lattice: Lattice, tracked: ShownImage) -> None:
    track, visible = tracked.track, tracked.track.visible
    text = "identities not sure: left out"
    if track.identified:
        text = f"{visible.sum()} of {len(visible)} pins, doubt {track.max_offset:.2f}"
    axes.imshow(tracked.image, cmap="gray", vmin=0, vmax=400, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.set_title(f"{tracked.name[-28:]}\n{text}", fontsize=8)
    if not track.identified:
        return
    colours = colormaps["Set1"](lattice.ring % 2)[visible]
    ends = np.stack([lattice.rest, lattice.rest + track.motion], 1)[visible]
    axes.add_collection(LineCollection(list(ends), colors=colours, linewidths=1))
    axes.scatter(ends[:, 1, 0], ends[:, 1, 1], s=5, c=colours)
    missed = lattice.rest[~visible]
    x, y = missed.T
    axes.scatter(x, y, s=18, facecolors="none", edgecolors="yellow", linewidths=0.8)
