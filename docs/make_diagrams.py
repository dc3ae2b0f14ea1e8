"""Draws the diagrams of the documents.

python docs/make_diagrams.py          # writes docs/figures/*.svg
"""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch, Polygon, Wedge

from jaxunshear.config.sensor import GEL_PAD, TACTIP_331, Sensor
from jaxunshear.simulator.mesh import make_dome_mesh
from jaxunshear.simulator.pin_layout import compute_pin_levers, compute_pin_tips
from jaxunshear.simulator.scene import make_scenes
from jaxunshear.simulator.simulate import simulate
from jaxunshear.style import FAINT, INK, STYLE

FIGURES = Path(__file__).with_name("figures")
SKIN, GEL, OBJECT, BLUE, ORANGE, GREEN = (
    "#444c5c",
    "#dfe6f1",
    "#e9dcc9",
    "#1f6feb",
    "#d9822b",
    "#2a9d6f",
)
DRAWN_MOTION = 2.5  # times the motion of a pad's markers
LINE, CODE, SHEAR = "#cfe0fb", "#d5efe2", "#f6e3cc"
NETWORK_BOXES = (  # x, y, width, height, text, colour
    (0.6, 1.5, 1.3, 0.8, "sheared\nimage", GEL),
    (2.6, 1.5, 1.1, 0.8, "E", LINE),
    (4.7, 2.5, 1.5, 0.7, "pose code $z_p$", CODE),
    (4.7, 0.5, 1.5, 0.7, "shear code $z_s$", SHEAR),
    (7.0, 2.5, 1.1, 0.7, "DC", LINE),
    (7.0, 0.5, 1.1, 0.7, "DS", LINE),
    (9.3, 2.5, 1.5, 0.7, "tap", GEL),
    (9.3, 0.5, 1.5, 0.7, "sheared\nimage", GEL),
)
NETWORK_ARROWS = (  # from x, y to x, y
    (1.3, 1.5, 2.0, 1.5),
    (3.2, 1.6, 3.9, 2.4),
    (3.2, 1.4, 3.9, 0.6),
    (5.5, 2.5, 6.4, 2.5),
    (5.5, 0.5, 6.4, 0.5),
    (5.5, 2.3, 6.5, 0.9),
    (7.6, 2.5, 8.5, 2.5),
    (7.6, 0.5, 8.5, 0.5),
)
STEPS = (  # x, y, name, text
    (0.9, 0.4, "your recordings", "taps and slides"),
    (0.9, 2.4, "scene", "shape, pose, slide"),
    (3.2, 2.4, "contact", "elastic dome, friction"),
    (5.5, 2.4, "image", "camera, threshold"),
    (5.5, 0.4, "dataset", "a tap for every slide"),
    (7.8, 0.4, "model", "sheared to tap"),
    (7.8, 2.4, "evaluation", "pose, MS-SSIM, pins"),
    (10.1, 2.4, "report", "one page"),
)
STEP_ARROWS = ((1, 2), (2, 3), (3, 4), (0, 4), (4, 5), (5, 6), (6, 7))


def make_figure(width: float, height: float, limits: Sequence[float]) -> tuple[Figure, Axes]:
    """Make a figure in inches without axes, over x and y in `limits`: left, right, bottom, top."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_aspect("equal")
    axes.set_xlim(limits[:2])
    axes.set_ylim(limits[2:])
    return figure, axes


def draw_arrow(
    axes: Axes,
    start: tuple[float, float],
    end: tuple[float, float],
    text: str = "",
    colour: str = INK,
) -> None:
    axes.annotate(
        "",
        end,
        start,
        arrowprops={"arrowstyle": "-|>", "color": colour, "shrinkA": 0, "shrinkB": 0},
    )
    if text:
        axes.annotate(text, end, xytext=(4, 2), textcoords="offset points", color=colour)


def draw_box(
    axes: Axes, middle: tuple[float, float], size: tuple[float, float], text: str, colour: str = GEL
) -> None:
    corner = (middle[0] - size[0] / 2, middle[1] - size[1] / 2)
    axes.add_patch(
        FancyBboxPatch(
            corner, *size, boxstyle="round,pad=0.02,rounding_size=0.12", fc=colour, ec=FAINT
        )
    )
    axes.text(*middle, text, ha="center", va="center")


def draw_dome(axes: Axes, sensor: Sensor, x: float, lag: float = 0.0) -> None:
    """Draw a section with its apex at (x, 0) mm, the lowest pins held back by `lag` mm."""
    radius = sensor.dome_radius_mm
    axes.add_patch(Wedge((x, radius), radius, 180, 360, fc=SKIN, ec="none"))
    axes.add_patch(Wedge((x, radius), radius - sensor.skin_mm, 180, 360, fc=GEL, ec="none"))
    tips = compute_pin_tips(sensor)
    roots = tips - compute_pin_levers(sensor)
    for tip, root in zip(tips, roots, strict=True):
        if abs(tip[1]) < 0.1 * sensor.pin_spacing_mm:
            held = lag * np.exp(-((root[0] / (0.3 * radius)) ** 2))
            axes.plot(
                [x + root[0] - held, x + tip[0] - held],
                [root[2], tip[2]],
                color=FAINT,
                linewidth=1.5,
            )
            axes.plot(
                x + tip[0] - held, tip[2], "o", color="white", markeredgecolor=INK, markersize=4
            )


def draw_sensor_section() -> Figure:
    figure, axes = make_figure(6, 4.2, (-34, 46, -4, 52))
    draw_dome(axes, TACTIP_331, 0.0)
    axes.add_patch(Polygon([(-4, 44), (4, 44), (4, 49), (-4, 49)], fc=SKIN, ec="none"))
    for side in (-1, 1):
        axes.plot([side * 1.5, side * 17], [44, 21], color=FAINT, linewidth=0.8, linestyle="--")
    for text, at, to in (
        ("camera", (10, 46.5), (4.5, 46.5)),
        ("gel", (-33, 15), (-8, 14)),
        ("skin", (26, 16), (19.4, 16)),
        ("pins with white tips", (26, 8), (13, 6.9)),
        ("apex", (10, -3), (0.4, -0.3)),
    ):
        axes.annotate(text, to, at, va="center", arrowprops={"arrowstyle": "-", "color": FAINT})
    draw_arrow(axes, (-28, 0), (-28, 10), "z")
    draw_arrow(axes, (-28, 0), (-18, 0), "x")
    axes.text(-30, -3.4, "sensor frame", color=FAINT)
    return figure


def draw_mesh() -> Figure:
    """Draw half of the cross-section: elements of gel and skin, the clamped base, pins."""
    figure, axes = make_figure(5, 4.2, (-1, 29, -1.5, 22))
    sensor = TACTIP_331
    mesh = make_dome_mesh(sensor.dome_radius_mm, sensor.skin_mm, 1.0)
    for colour, line, elements in (
        (GEL, FAINT, mesh.elements[~mesh.skin]),
        (SKIN, "white", mesh.elements[mesh.skin]),
    ):
        corners = mesh.nodes[elements[:, :4]]
        axes.add_collection(PolyCollection(corners, fc=colour, ec=line, linewidth=0.4))
    base = mesh.nodes[mesh.clamped]
    axes.plot(base[:, 0], base[:, 1], color=BLUE, linewidth=3)
    tips = compute_pin_tips(sensor)
    levers = compute_pin_levers(sensor)
    shown = (np.abs(tips[:, 1]) < 0.1 * sensor.pin_spacing_mm) & (tips[:, 0] > -0.1)
    for tip, lever in zip(tips[shown], levers[shown], strict=True):
        axes.plot([tip[0] - lever[0], tip[0]], [tip[2] - lever[2], tip[2]], color=ORANGE)
    axes.text(10, 20.8, "clamped base", color=BLUE, ha="center")
    axes.text(21, 12, "skin", color=SKIN)
    axes.text(14, 1, "pins", color=ORANGE)
    axes.text(0, -1.4, "apex", ha="left", color=INK)
    return figure


def draw_frames() -> Figure:
    figure, axes = make_figure(6, 4, (-26, 24, -16, 17))
    angle = np.linspace(-0.75, 0.75, 60)
    outline = np.stack([-22 + 22 * np.cos(angle), 22 * np.sin(angle)], axis=1)
    axes.add_patch(
        Polygon([*outline, (-26, outline[-1, 1]), (-26, outline[0, 1])], fc=OBJECT, ec=INK)
    )
    axes.text(-24, -1, "object")
    draw_arrow(axes, (0, 0), (13, 0), "x: outward normal")
    draw_arrow(axes, (0, 0), (0, 13), "y")
    axes.plot(0, 0, "o", color=INK)
    axes.text(-1.2, -1.8, "target point", ha="right", color=INK)
    place, yaw = np.array([5.0, -8.0]), np.radians(25)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    ring = place + 4.5 * np.stack(
        [np.cos(2 * np.pi * np.arange(60) / 60), np.sin(2 * np.pi * np.arange(60) / 60)], 1
    )
    axes.add_patch(Polygon(ring, fc=GEL, ec=BLUE, alpha=0.8))
    for direction in ((1.0, 0.0), (0.0, 1.0)):
        draw_arrow(axes, tuple(place), tuple(place + 7 * turn @ direction), colour=BLUE)
    axes.plot([place[0], place[0] + 9], [place[1], place[1]], color=FAINT, linestyle=":")
    axes.text(14.5, -6.8, "yaw", color=BLUE)
    axes.text(5.0, -15, "sensor at (x, y)", ha="center", color=BLUE)
    centre = np.array([-22.0, 0.0])
    nearest = centre + 22 * (place - centre) / np.linalg.norm(place - centre)
    axes.plot([nearest[0], place[0]], [nearest[1], place[1]], color=ORANGE)
    axes.text(-2.5, -10.2, "edge distance", color=ORANGE, ha="right")
    return figure


def draw_tap_slide() -> Figure:
    figure, axes = make_figure(7, 3, (-28, 92, -12, 32))
    for x, text, lag in ((0.0, "tap: canonical", 0.0), (58.0, "slide: sheared", 5.0)):
        axes.add_patch(
            Polygon(
                [(x - 26, -10), (x + 8, -10), (x + 8, 2.5), (x - 26, 2.5)], fc=OBJECT, ec="none"
            )
        )
        draw_dome(axes, TACTIP_331, x, lag)
        axes.text(x, 28, text, ha="center")
    draw_arrow(axes, (-24, 24), (-24, 12), colour=BLUE)
    draw_arrow(axes, (34, 24), (34, 14), colour=BLUE)
    draw_arrow(axes, (34, 12), (48, 12), colour=BLUE)
    axes.text(49, -7, "friction holds the pins back", ha="center", color=ORANGE)
    return figure


def draw_pad() -> Figure:
    """Draw how the markers of a pad move in a tap on an edge, and in a slide to the same pose."""
    pose, move = np.tile([1.0, 0.0, 30.0, 0.9], (2, 1)), np.array([[0, 0, 0], [1.2, 0.8, 0]])
    scenes = make_scenes(("edge",), np.zeros(2, int), pose, move, 0.7)
    pins, rest = simulate(GEL_PAD, ("edge",), scenes).pins, compute_pin_tips(GEL_PAD)
    half = GEL_PAD.radius_mm + 0.5
    figure, axes = make_figure(7.2, 3.7, (-half, 3 * half, -half, half))
    for number, title in enumerate(("tap", "slide to the same pose")):
        middle = 2 * half * number
        axes.add_patch(Circle((middle, 0), GEL_PAD.radius_mm, color=GEL))
        start = rest[:, :2] + [middle, 0]
        end = start + DRAWN_MOTION * (pins[number] - rest)[:, :2]
        axes.add_collection(LineCollection(np.stack([start, end], 1), color=BLUE, linewidth=1))
        axes.plot(*start.T, "o", color=FAINT, markersize=2.5)
        axes.text(middle, -12.0, title, ha="center", color=INK)
    return figure


def draw_networks() -> Figure:
    figure, axes = make_figure(8, 3, (-0.4, 10.2, -0.3, 3.3))
    for x, y, width, height, text, colour in NETWORK_BOXES:
        draw_box(axes, (x, y), (width, height), text, colour)
    for x, y, end_x, end_y in NETWORK_ARROWS:
        draw_arrow(axes, (x, y), (end_x, end_y))
    return figure


def draw_flow() -> Figure:
    figure, axes = make_figure(9, 3, (-0.2, 11.2, -0.4, 3.2))
    middle = {"ha": "center", "va": "center"}
    for x, y, name, text in STEPS:
        draw_box(axes, (x, y), (1.9, 0.9), "")
        axes.text(x, y + 0.13, name, weight="bold", **middle)
        axes.text(x, y - 0.2, text, fontsize=7.5, color=SKIN, **middle)
    places = np.array([step[:2] for step in STEPS])
    for start, end in STEP_ARROWS:
        direction = np.sign(places[end] - places[start])
        # along a row from side to side, else upwards or downwards
        gap = [1.0, 0.0] * direction if direction[1] == 0 else [0.0, 0.5] * direction
        draw_arrow(axes, tuple(places[start] + gap), tuple(places[end] - gap))
    return figure


DIAGRAMS = {
    "sensor": draw_sensor_section,
    "mesh": draw_mesh,
    "frames": draw_frames,
    "tap_slide": draw_tap_slide,
    "networks": draw_networks,
    "pad": draw_pad,
    "flow": draw_flow,
}


if __name__ == "__main__":
    FIGURES.mkdir(exist_ok=True)
    with mpl.rc_context(STYLE):
        for name, draw in DIAGRAMS.items():
            draw().savefig(FIGURES / f"{name}.svg", metadata={"Date": None})
