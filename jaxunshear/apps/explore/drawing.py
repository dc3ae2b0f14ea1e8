"""What the page draws: the shape from above with the dome on it, pins' motions, and images as data URLs. Strings of SVG, no state."""

import base64

import numpy as np

from jaxunshear.apps.explore.outline import trace_outlines
from jaxunshear.apps.explore.touch import FREE, SLIPPING, STUCK, Touch
from jaxunshear.config.reach import compute_reach_mm
from jaxunshear.perception.png import encode_png

MAP_PX = 640
HALF_MM = 32.0  # of the map, about the shape's target point
PX_PER_MM = MAP_PX / (2 * HALF_MM)
PINS_PX = 512
STRETCH = 2.0  # of pins' motions as drawn
COLOURS = {STUCK: "#1f6feb", SLIPPING: "#d9822b", FREE: "#aab2bf"}


def encode_data_url(image: np.ndarray) -> str:
    """(S, S) uint8 -> a PNG that an `img` takes."""
    return f"data:image/png;base64,{base64.b64encode(encode_png(image, level=1)).decode()}"


def to_mm(column: float, row: float) -> tuple[float, float]:
    """From px of the map to mm of the target frame: x to the right, y up."""
    return column / MAP_PX * 2 * HALF_MM - HALF_MM, HALF_MM - row / MAP_PX * 2 * HALF_MM


def to_px(xy: np.ndarray) -> np.ndarray:
    """The other way: (..., 2) -> (..., 2)."""
    return (np.asarray(xy, float) * [1, -1] + HALF_MM) * PX_PER_MM


def _path(points: np.ndarray, closed: bool = True) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + ("Z" if closed else "")


def render_map_svg(touch: Touch, line: list[tuple[float, float]] | None = None) -> str:
    """The shape, the dome's outline and contact at the slide's start and end, and the slide; or the line (mm) that is being drawn."""
    every_10_mm = np.arange(HALF_MM % 10, 2 * HALF_MM, 10) * PX_PER_MM
    lines = [f"M{px:.1f} 0V{MAP_PX}M0 {px:.1f}H{MAP_PX}" for px in every_10_mm]
    parts = [f'<path d="{"".join(lines)}" stroke="#dfe4ec" stroke-width="1" fill="none"/>']
    if line is not None:
        shown = _path(to_px(np.array(line)), closed=False) if len(line) > 1 else ""
        parts.append(
            f'<path d="{shown}" stroke="#1c2330" stroke-width="3" fill="#c9d3e4" fill-opacity=".6"/>'
        )
        return "".join(parts)
    shape = "".join(_path(to_px(curve)) for curve in trace_outlines(touch.stimulus, HALF_MM))
    parts.append(
        f'<path d="{shape}" fill="#c9d3e4" stroke="#67758d" stroke-width="2" fill-rule="evenodd"/>'
    )
    parts.append(_scale_bar())
    end = np.array(touch.pose[:2])
    (x, y), (from_x, from_y) = to_px(end), to_px(end - touch.move)
    radius, contact = (
        touch.sensor.dome_radius_mm * PX_PER_MM,
        compute_reach_mm(touch.sensor, touch.pose[3]) * PX_PER_MM,
    )
    yaw = np.radians(touch.pose[2])
    tip = to_px(end + touch.sensor.dome_radius_mm * np.array([np.cos(yaw), np.sin(yaw)]))
    moved = "" if touch.move == (0, 0) else _slide(from_x, from_y, x, y, radius)
    parts += [
        f'{moved}<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}" fill="#1f6feb" fill-opacity=".07" stroke="#1f6feb" stroke-width="2"/>',
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{contact:.1f}" fill="#1f6feb" fill-opacity=".18"/>',
        f'<path d="M{x:.1f} {y:.1f}L{tip[0]:.1f} {tip[1]:.1f}" stroke="#1f6feb" stroke-width="2" stroke-dasharray="5 5"/>',
        f'<circle cx="{tip[0]:.1f}" cy="{tip[1]:.1f}" r="8" fill="#1f6feb"/><circle cx="{x:.1f}" cy="{y:.1f}" r="6" fill="#1c2330"/>',
    ]
    return "".join(parts)


def _slide(from_x: float, from_y: float, x: float, y: float, radius: float) -> str:
    return (
        f'<circle cx="{from_x:.1f}" cy="{from_y:.1f}" r="{radius:.1f}" fill="none" stroke="#8a93a3" stroke-dasharray="4 6"/>'
        f'<path d="M{from_x:.1f} {from_y:.1f}L{x:.1f} {y:.1f}" stroke="#d9822b" stroke-width="5" stroke-linecap="round"/>'
        f'<circle cx="{from_x:.1f}" cy="{from_y:.1f}" r="6" fill="white" stroke="#d9822b" stroke-width="3"/>'
    )


def _scale_bar() -> str:
    y = MAP_PX - 20
    return (
        f'<path d="M20 {y}h{10 * PX_PER_MM:.0f}" stroke="#1c2330" stroke-width="3"/>'
        f'<text x="20" y="{y - 9}" font-size="18" fill="#1c2330">10 mm</text>'
    )


def render_pins_svg(pins: np.ndarray, state: np.ndarray, size: int) -> str:
    """Pins (2, P, 2) px of images of `size` px: where they rest, and how they moved, in the colour of what the skin above does."""
    rest, moved = (pins + 0.5) * (PINS_PX / size)
    parts = [
        f'<circle cx="{PINS_PX / 2}" cy="{PINS_PX / 2}" r="{0.48 * PINS_PX:.0f}" fill="#f6f8fb" stroke="#dfe4ec"/>'
    ]
    for kind in (FREE, STUCK, SLIPPING):
        here = state == kind
        tips = rest[here] + STRETCH * (moved[here] - rest[here])
        lines = "".join(
            f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}"
            for (a, b), (c, d) in zip(rest[here], tips, strict=True)
        )
        parts.append(f'<path d="{lines}" stroke="{COLOURS[kind]}" stroke-width="2.5" fill="none"/>')
        parts += [
            f'<circle cx="{c:.1f}" cy="{d:.1f}" r="4" fill="{COLOURS[kind]}"/>' for c, d in tips
        ]
    return "".join(parts)
