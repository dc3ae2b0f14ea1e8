"""Draws the moving picture of the README: the dome slides along an outline, in the simulator.

python -m docs.make_animation          # writes docs/figures/slide.gif, in a minute
"""

from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image

from jaxunshear import load_model
from jaxunshear.data.chunks import unpack_bits
from jaxunshear.data.simulation import render_images
from jaxunshear.downstream.contour import Contour
from jaxunshear.downstream.servo import ServoTask
from jaxunshear.downstream.servo_scores import servo
from jaxunshear.inference.edge_methods import TRUE_POSE
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.perception.pin_tracking import measure_motions
from jaxunshear.simulator.paths import Paths
from jaxunshear.simulator.simulate import follow
from jaxunshear.simulator.stimuli import make_stimulus
from jaxunshear.style import FAINT, INK, STYLE

FILE = Path(__file__).parent / "figures" / "slide.gif"
TASK = ServoTask("teardrop", starts=1, start_offset_mm=0.0, start_rotation_deg=0.0)
STRIDE = 8  # steps of the slide between two pictures
PICTURE_MS = 160
VIEW_MM = 9.0  # of the object, to each side of the dome's apex
ARROW_SCALE = 3.0  # motions are drawn this many times as long
ARROW_KEY = f"motion of a pin, {ARROW_SCALE:g} times as long"
OBJECT = "#e9dcc9"
COLOURS = {"sheared": "#d9822b", "unsheared": "#1f6feb", "tap": "#2a9d6f"}
PALETTE = 40  # colours of the file, which keep it small


class Slide(NamedTuple):
    """T steps of a slide along an outline, by kind of image: sheared, unsheared, tap."""

    contour: Contour
    point: np.ndarray  # (T, 3) x, y mm and yaw deg of the sensor
    images: dict[str, np.ndarray]  # (T, S, S) in [0, 1]
    motion: dict[str, np.ndarray]  # (T, P, 2) px of the pins from rest
    edge: dict[str, np.ndarray]  # (T, 2) mm and deg in the sensor frame, from PoseNet


def simulate_slide(model: TrainedModel) -> Slide:
    """Simulate the slide and a tap at every pose of it, and unshear and read all images."""
    (result,) = servo(model, [TASK], (TRUE_POSE,))
    walk = result.trajectories
    steps = np.flatnonzero(~np.isnan(walk.point[0, :, 0]))[::STRIDE]
    point = walk.point[0, steps]
    sheared, tap = unpack_bits(walk.images[0, steps], model.size), simulate_taps(model, point)
    images = {"sheared": sheared / 255, "unsheared": model.unshear(sheared), "tap": tap / 255}
    from_sheared, from_unsheared = model.pose(sheared).values()
    poses = (from_sheared, from_unsheared, model.pose(tap)["as_recorded"])
    return Slide(
        contour=result.contour,
        point=point,
        images=images,
        motion={
            kind: measure_motions(model.lattice, 255 * (image > 0.5).astype(np.uint8))
            for kind, image in images.items()
        },
        edge={
            kind: np.stack([pose["edge_mm"], pose["edge_deg"]], -1)
            for kind, pose in zip(images, poses, strict=True)
        },
    )


def simulate_taps(model: TrainedModel, point: np.ndarray) -> np.ndarray:
    """Simulate taps at the poses (T, 3) x, y mm and yaw deg: images (T, S, S) in {0, 255}."""
    count = len(point)
    points = np.zeros((count, 2, 6))  # above the object, then pressed
    points[:, :, :3] = point[:, None]
    points[:, 1, 3] = TASK.depth_mm
    friction = np.full(count, make_stimulus(TASK.stimulus).friction)
    paths = Paths(np.zeros(count, int), friction, points)
    contacts, _ = follow(model.sensor, (TASK.stimulus,), paths)
    settings = model.require_simulation("the animation")
    return render_images(settings, model.sensor, contacts.pins, np.arange(count), np.zeros(count))[
        0
    ]


def locate_edges(slide: Slide, kind: str) -> np.ndarray:
    """Locate the edge that the images of a kind show: (T, 2) x, y mm."""
    distance, direction = slide.edge[kind].T
    angle = np.radians(slide.point[:, 2] + direction)
    return slide.point[:, :2] - distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)


def draw_scene(axes: Axes, slide: Slide, step: int) -> None:
    """Draw the object from above around the dome's apex, and the edge as estimated so far."""
    axes.fill(*slide.contour.points.T, color=OBJECT)
    axes.plot(*slide.point[: step + 1, :2].T, color=FAINT, lw=0.8)
    x, y = slide.point[step, :2]
    axes.plot(x, y, "+", color=INK)
    for kind in ("sheared", "unsheared"):
        axes.plot(*locate_edges(slide, kind)[: step + 1].T, ".-", color=COLOURS[kind], lw=1, ms=6)
    axes.set_xlim(x - VIEW_MM, x + VIEW_MM)
    axes.set_ylim(y - VIEW_MM, y + VIEW_MM)
    axes.set_aspect("equal")
    axes.set_title("object and estimated edge", fontsize=9)
    text = f"{2 * VIEW_MM:.0f} mm, from above"
    axes.text(0.5, -0.09, text, transform=axes.transAxes, ha="center", fontsize=9)


def draw_image(axes: Axes, slide: Slide, rest: np.ndarray, kind: str, step: int) -> None:
    """Draw an image, the motion of every pin from rest, and the pose estimated from it."""
    axes.imshow(slide.images[kind][step], cmap="gray", vmax=1.8)
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1 / ARROW_SCALE, "width": 0.007}
    axes.quiver(*rest.T, *slide.motion[kind][step].T, color=COLOURS[kind], **arrows)
    axes.set_title(kind, color=COLOURS[kind], fontweight="bold")
    distance, direction = slide.edge[kind][step]
    text = f"edge {distance:+.1f} mm, {direction:+.0f} deg"
    axes.text(0.5, -0.09, text, transform=axes.transAxes, ha="center", fontsize=9)


def make_keys() -> list[Line2D | Patch]:
    """Make the keys of what the pictures draw."""
    edges = [
        Line2D([], [], color=COLOURS[kind], marker=".", lw=1, label=f"edge from {kind}")
        for kind in ("sheared", "unsheared")
    ]
    return [
        Patch(color=OBJECT, label="object"),
        Line2D([], [], color=INK, marker="+", lw=0, label="apex of the dome"),
        Line2D([], [], color=FAINT, lw=0.8, label="its path"),
        *edges,
        Line2D([], [], color=INK, marker=r"$\rightarrow$", ms=12, lw=0, label=ARROW_KEY),
    ]


def draw_picture(slide: Slide, model: TrainedModel, step: int) -> Image.Image:
    """Draw one picture of the animation."""
    figure = Figure(figsize=(8.4, 2.8), dpi=100, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    scene, *panels = figure.subplots(1, 4)
    figure.subplots_adjust(left=0.01, right=0.99, top=0.9, bottom=0.19, wspace=0.05)
    draw_scene(scene, slide, step)
    for axes, kind in zip(panels, slide.images, strict=True):
        draw_image(axes, slide, model.lattice.rest, kind, step)
    for axes in (scene, *panels):
        axes.set_xticks([])
        axes.set_yticks([])
    keys = make_keys()
    place = {"loc": "lower center", "bbox_to_anchor": (0.5, -0.02), "ncols": len(keys)}
    figure.legend(handles=keys, fontsize=8, frameon=False, columnspacing=1.0, **place)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])


def main() -> None:
    model = load_model("standard")
    slide = simulate_slide(model)
    with mpl.rc_context(STYLE):
        pictures = [draw_picture(slide, model, step) for step in range(len(slide.point))]
    palette = pictures[len(pictures) // 2].quantize(PALETTE)
    first, *rest = (each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures)
    first.save(FILE, save_all=True, append_images=rest, duration=PICTURE_MS, loop=0, optimize=True)


if __name__ == "__main__":
    main()
