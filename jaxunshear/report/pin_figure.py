"""Some images with their pins by identity: the motion of each as a line from where it stands untouched."""

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from jaxunshear.data.recorded_pins import ShownImage
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_track import PinTrack
from jaxunshear.style import encode_png

COLUMNS = 4


def plot_pins(lattice: Lattice, shown: list[ShownImage]) -> bytes:
    """A PNG of (name, image (S, S) uint8, track): shells in turn in two colours, so that an exchanged pin catches the eye."""
    rows = -(-len(shown) // COLUMNS)
    figure = Figure(figsize=(3.6 * COLUMNS, 3.9 * rows), layout="constrained", dpi=110)
    panels = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    colours = colormaps["Set1"](lattice.ring % 2)
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    for axes, (name, image, track) in zip(panels, shown, strict=False):
        axes.imshow(image, cmap="gray", vmin=0, vmax=400, interpolation="nearest")
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"{name[-28:]}\n{_words(lattice, track)}", fontsize=8)
        if not track.identified:
            continue
        seen = track.visible
        ends = np.stack([lattice.rest, lattice.rest + track.motion], 1)[seen]
        axes.add_collection(LineCollection(list(ends), colors=colours[seen], linewidths=1))
        axes.scatter(*ends[:, 1].T, s=5, c=colours[seen])
        lost = lattice.rest[~seen]
        axes.scatter(*lost.T, s=18, facecolors="none", edgecolors="yellow", linewidths=0.8)
    figure.suptitle(
        "Lines lead from where each pin stands untouched to where it is; circled: not found",
        fontsize=9,
    )
    return encode_png(figure)


def _words(lattice: Lattice, track: PinTrack) -> str:
    if not track.identified:
        return "identities not sure: left out"
    return f"{len(lattice.rest) - track.missed} of {len(lattice.rest)} pins, doubt {track.max_offset:.2f}"
