"""A picture of images with their pins, whose motions are lines from the rest positions."""

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from jaxunshear.data.recorded_pins import ShownImage
from jaxunshear.perception.lattice import Lattice
from jaxunshear.report.figures import make_panels
from jaxunshear.style import encode_png

COLUMNS = 4


def plot_pins(lattice: Lattice, images: Sequence[ShownImage]) -> bytes:
    """Plot the pins of images as a PNG.

    Rings of pins alternate between two colours, which makes a mistaken identity visible.
    """
    figure, panels = make_panels(len(images), COLUMNS, (3.6, 3.9), dpi=110)
    for axes, image in zip(panels, images, strict=True):
        _plot_image(axes, lattice, image)
    figure.suptitle(
        "Lines lead from where each pin stands untouched to where it is; circled: not found",
        fontsize=9,
    )
    return encode_png(figure)


def _plot_image(axes: Axes, lattice: Lattice, tracked: ShownImage) -> None:
    track, pins = tracked.track, len(lattice.rest)
    text = "identities not sure: left out"
    if track.identified:
        text = f"{pins - track.missed} of {pins} pins, doubt {track.max_offset:.2f}"
    axes.imshow(tracked.image, cmap="gray", vmin=0, vmax=400, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.set_title(f"{tracked.name[-28:]}\n{text}", fontsize=8)
    if not track.identified:
        return
    visible = track.visible
    colours = colormaps["Set1"](lattice.ring % 2)[visible]
    ends = np.stack([lattice.rest, lattice.rest + track.motion], 1)[visible]
    axes.add_collection(LineCollection(list(ends), colors=colours, linewidths=1))
    axes.scatter(ends[:, 1, 0], ends[:, 1, 1], s=5, c=colours)
    missed = lattice.rest[~visible]
    x, y = missed.T
    axes.scatter(x, y, s=18, facecolors="none", edgecolors="yellow", linewidths=0.8)
