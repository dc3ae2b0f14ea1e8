"""Draws for the page: the shape with the dome on it, pins' motions, and images as data URLs.

Drawings are strings of SVG.
"""

import base64
from functools import lru_cache, partial

import jax
import numpy as np
from scipy.spatial import Delaunay
from skimage.measure import find_contours

from jaxunshear.angles import rotate_2d
from jaxunshear.apps.explore.explorer import FREE, SLIPPING, STUCK, Touch, TouchResult
from jaxunshear.config.contact_rings import compute_reach_mm
from jaxunshear.config.sensor import Sensor
from jaxunshear.perception.drawing import encode_png
from jaxunshear.simulator.dome import load_shared_dome
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.stimuli import Stimulus, compute_signed_distance

MAP_PX = 640
HALF_MM = 32.0  # of the map, about the shape's target point
PX_PER_MM = MAP_PX / (2 * HALF_MM)
GRID_MM = 0.4  # between the points that outlines are sought from
PINS_PX = 512
STRETCH = 2.0  # of pins' motions as drawn
FORCE, MM_PER_N = "#c0392b", 12.0  # the colour of forces, and their length on the map
LONGEST_MM = 4.0  # of forces on the skin as drawn
VIEW_YAW_DEG, VIEW_TILT_DEG = 30.0, -35.0  # of the drawing of the dome, seen from below
COLOURS = {STUCK: "#1f6feb", SLIPPING: "#d9822b", FREE: "#aab2bf"}


def encode_data_url(image: np.ndarray) -> str:
    """Encode an image (S, S) or (S, S, 3) uint8 as a PNG that an `img` takes."""
    return f"data:image/png;base64,{base64.b64encode(encode_png(image, level=1)).decode()}"


def to_mm(column: float, row: float) -> tuple[float, float]:
    """Convert px of the map to mm of the target frame: x to the right, y up."""
    return column / MAP_PX * 2 * HALF_MM - HALF_MM, HALF_MM - row / MAP_PX * 2 * HALF_MM


def to_px(xy: np.ndarray) -> np.ndarray:
    """Convert mm of the target frame (..., 2) to px of the map (..., 2)."""
    return (np.asarray(xy, float) * [1, -1] + HALF_MM) * PX_PER_MM


def _format_path(points: np.ndarray) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + "Z"


@lru_cache(maxsize=32)
def trace_outlines(stimulus: Stimulus, half_mm: float) -> tuple[np.ndarray, ...]:
    """Trace the shape's edge within `half_mm` of its target point.

    Returns closed curves (K, 2) mm, cut at the border.
    """
    steps = round(2 * half_mm / GRID_MM)
    line = np.linspace(-half_mm, half_mm, steps + 1)
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), -1)
    compute_distance = jax.jit(partial(compute_signed_distance, stimulus))
    distances = np.asarray(compute_distance(grid.astype(np.float32)))
    distances = np.pad(distances, 1, constant_values=1.0)  # closes what goes on beyond the border
    curves = find_contours(distances, 0.0)
    return tuple((curve - 1) * (2 * half_mm / steps) - half_mm for curve in curves)


def render_map_svg(touch: Touch, force_n: np.ndarray | None = None) -> str:
    """Draw the shape, the dome at the slide's start and end, the slide, and the force sideways.

    `force_n` (3,) is on the sensor, in its frame.
    """
    every_10_mm = np.arange(HALF_MM % 10, 2 * HALF_MM, 10) * PX_PER_MM
    lines = [f"M{px:.1f} 0V{MAP_PX}M0 {px:.1f}H{MAP_PX}" for px in every_10_mm]
    parts = [f'<path d="{"".join(lines)}" stroke="#dfe4ec" stroke-width="1" fill="none"/>']
    shape = "".join(_format_path(to_px(curve)) for curve in trace_outlines(touch.stimulus, HALF_MM))
    parts.append(
        f'<path d="{shape}" fill="#c9d3e4" stroke="#67758d" stroke-width="2" fill-rule="evenodd"/>'
    )
    parts.append(_draw_scale_bar())
    end = np.array(touch.pose[:2])
    (x, y), (from_x, from_y) = to_px(end), to_px(end - touch.move)
    radius = touch.sensor.dome_radius_mm * PX_PER_MM
    contact = compute_reach_mm(touch.sensor, touch.pose[3]) * PX_PER_MM
    yaw = np.radians(touch.pose[2])
    tip = to_px(end + touch.sensor.dome_radius_mm * np.array([np.cos(yaw), np.sin(yaw)]))
    if touch.move != (0, 0):
        parts.append(_draw_slide((from_x, from_y), (x, y), radius))
    centre = f'cx="{x:.1f}" cy="{y:.1f}"'
    parts += [
        f'<circle {centre} r="{radius:.1f}" fill="#1f6feb" fill-opacity=".07" '
        'stroke="#1f6feb" stroke-width="2"/>',
        f'<circle {centre} r="{contact:.1f}" fill="#1f6feb" fill-opacity=".18"/>',
        f'<path d="M{x:.1f} {y:.1f}L{tip[0]:.1f} {tip[1]:.1f}" '
        'stroke="#1f6feb" stroke-width="2" stroke-dasharray="5 5"/>',
        f'<circle cx="{tip[0]:.1f}" cy="{tip[1]:.1f}" r="8" fill="#1f6feb"/>',
        f'<circle {centre} r="6" fill="#1c2330"/>',
    ]
    if force_n is not None:
        along = rotate_2d(force_n[:2], np.radians(touch.pose[2]))
        parts.append(_draw_arrow(to_px(end), to_px(end + MM_PER_N * along), 6, FORCE))
    return "".join(parts)


def _draw_arrow(start: np.ndarray, end: np.ndarray, width: float, colour: str) -> str:
    along = end - start
    length = float(np.hypot(*along))
    if length < 2 * width:  # shorter than its head
        return ""
    head = 3 * width * along / length
    side = 0.5 * np.array([-head[1], head[0]])
    corners = _format_path(np.stack([end, end - head + side, end - head - side]))
    (a, b), (c, d) = start, end - head
    return (
        f'<path d="M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" stroke="{colour}" stroke-width="{width}"/>'
        f'<path d="{corners}" fill="{colour}"/>'
    )


def render_dome_svg(result: TouchResult) -> str:
    """Draw the dome from below at a slant: a mesh of pin tips, and the forces on its skin.

    The colour of a triangle shows whether the skin above one of its pins sticks or slips.
    """
    sensor = result.sensor
    triangles = _triangulate(sensor)
    place, away = _project(result.tips[0], sensor.dome_radius_mm)
    parts = []
    for pins in triangles[np.argsort(-away[triangles].mean(axis=1))]:
        fill = COLOURS[int(result.state[pins].max())] if result.state[pins].any() else "#eef2f8"
        parts.append(
            f'<path d="{_format_path(place[pins])}" fill="{fill}" stroke="#8a93a3" '
            'stroke-width="0.6"/>'
        )
    forces = result.skin_force_n
    touched = np.flatnonzero(forces[:, 2] > 0)
    nodes, longest = load_shared_dome(sensor).nodes, np.abs(forces).max(initial=1e-9)
    ends = nodes + LONGEST_MM * forces / longest
    starts = _project(nodes, sensor.dome_radius_mm)[0]
    ends = _project(ends, sensor.dome_radius_mm)[0]
    parts += [_draw_arrow(starts[node], ends[node], 1.2, FORCE) for node in touched]
    return "".join(parts)


@lru_cache(maxsize=8)
def _triangulate(sensor: Sensor) -> np.ndarray:
    """Join neighbouring pins to triangles (T, 3)."""
    return Delaunay(compute_pin_tips(sensor)[:, :2]).simplices


def _project(points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Project points (K, 3) mm to px (K, 2) of the drawing; also how far away (K,) they are."""
    turned = rotate_2d(points[:, :2], np.radians(VIEW_YAW_DEG))
    x, y, z = turned[:, 0], turned[:, 1], points[:, 2] - radius / 2
    sine, cosine = np.sin(np.radians(VIEW_TILT_DEG)), np.cos(np.radians(VIEW_TILT_DEG))
    scale = 0.58 * PINS_PX / radius
    up, away = z * cosine + y * sine, y * cosine - z * sine
    return PINS_PX / 2 + scale * np.stack([x, -up], -1), away


def _draw_slide(start: tuple[float, float], end: tuple[float, float], radius: float) -> str:
    centre = f'cx="{start[0]:.1f}" cy="{start[1]:.1f}"'
    return (
        f'<circle {centre} r="{radius:.1f}" fill="none" stroke="#8a93a3" stroke-dasharray="4 6"/>'
        f'<path d="M{start[0]:.1f} {start[1]:.1f}L{end[0]:.1f} {end[1]:.1f}" '
        'stroke="#d9822b" stroke-width="5" stroke-linecap="round"/>'
        f'<circle {centre} r="6" fill="white" stroke="#d9822b" stroke-width="3"/>'
    )


def _draw_scale_bar() -> str:
    y = MAP_PX - 20
    return (
        f'<path d="M20 {y}h{10 * PX_PER_MM:.0f}" stroke="#1c2330" stroke-width="3"/>'
        f'<text x="20" y="{y - 9}" font-size="18" fill="#1c2330">10 mm</text>'
    )


def render_pins_svg(pins: np.ndarray, state: np.ndarray, size: int) -> str:
    """Draw pins (2, P, 2) px of images of `size` px: rest positions and motions.

    The colour of a pin shows whether the skin above it is free, sticks or slips.
    """
    rest, moved = (pins + 0.5) * (PINS_PX / size)
    parts = [
        f'<circle cx="{PINS_PX / 2}" cy="{PINS_PX / 2}" r="{0.48 * PINS_PX:.0f}" '
        'fill="#f6f8fb" stroke="#dfe4ec"/>'
    ]
    for kind in (FREE, STUCK, SLIPPING):
        of_kind = state == kind
        tips = rest[of_kind] + STRETCH * (moved[of_kind] - rest[of_kind])
        lines = "".join(
            f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}"
            for (a, b), (c, d) in zip(rest[of_kind], tips, strict=True)
        )
        parts.append(f'<path d="{lines}" stroke="{COLOURS[kind]}" stroke-width="2.5" fill="none"/>')
        parts += [
            f'<circle cx="{c:.1f}" cy="{d:.1f}" r="4" fill="{COLOURS[kind]}"/>' for c, d in tips
        ]
    return "".join(parts)
