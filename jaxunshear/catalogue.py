"""Lists and drawings of the sensors and the stimuli."""

import io
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from jaxunshear.config.data import Ranges
from jaxunshear.config.outlines import parse_stimulus
from jaxunshear.config.sensor import SENSORS, Sensor, get_sensor
from jaxunshear.errors import UserError
from jaxunshear.files import write_bytes
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.stimuli import (
    STIMULI,
    TRAINING,
    UNSEEN,
    Stimulus,
    compute_distances,
    make_stimulus,
)

SUFFIXES = (".png", ".svg", ".pdf")
USES = {**dict.fromkeys(TRAINING, "trained on"), **dict.fromkeys(UNSEEN, "kept unseen")}
DRAWING_POINTS = 500  # along a side


def list_names(catalogue: str) -> list[str]:
    """List the names in a catalogue, "sensors" or "stimuli"."""
    return list(SENSORS) if catalogue == "sensors" else list(STIMULI)


def format_listing(catalogue: str) -> str:
    """Format one line for each sensor or stimulus."""
    lines = [
        f"{sensor.name:16} {sensor.pins} pins, {sensor.layout}, {sensor.pin_spacing_mm:g} mm "
        f"apart; {'pad' if sensor.is_flat else 'dome'} radius {sensor.radius_mm:g} mm"
        for sensor in SENSORS.values()
    ]
    if catalogue == "stimuli":
        lines = [
            f"{stimulus.name:12} {stimulus.material}, friction {stimulus.friction:g}; "
            f"{USES.get(stimulus.name, 'for recordings of it')}"
            for stimulus in STIMULI.values()
        ]
    return "\n".join(lines)


def draw(catalogue: str, name: str, out: Path) -> None:
    """Draw a sensor's pins or the outline of a stimulus in mm to `out`, a PNG, SVG or PDF."""
    if out.suffix.lower() not in SUFFIXES:
        raise UserError(f"--out {out}: name a file that ends in {', '.join(SUFFIXES)}")
    figure = Figure(figsize=(6, 6), layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel="x / mm", ylabel="y / mm")
    if catalogue == "sensors":
        _draw_sensor(axes, get_sensor(name))
    else:
        _draw_stimulus(axes, make_stimulus(parse_stimulus(name)))
    data = io.BytesIO()
    figure.savefig(data, format=out.suffix[1:].lower(), dpi=150)
    write_bytes(out, data.getvalue())


def _draw_sensor(axes: Axes, sensor: Sensor) -> None:
    axes.add_patch(Circle((0, 0), sensor.radius_mm, fill=False, color="0.5"))
    for x, y, _ in compute_pin_tips(sensor):
        axes.add_patch(Circle((x, y), sensor.pin_radius_mm, color="black"))
    axes.autoscale_view()
    axes.set_title(f"{sensor.name}: {sensor.pins} pins, undeformed, as the camera sees them")
    axes.invert_yaxis()


def _draw_stimulus(axes: Axes, stimulus: Stimulus) -> None:
    """Draw a stimulus in the target frame, with the square of the sensor's positions."""
    reach = 2.1 * stimulus.extent_mm
    side = np.linspace(-reach, reach, DRAWING_POINTS, dtype=np.float32)
    xy = np.stack(np.meshgrid(side, side), axis=-1)
    distance = compute_distances(stimulus, xy)
    axes.contourf(side, side, distance, levels=[distance.min(), 0], colors=["0.8"])
    if distance.max() > 0:
        axes.contour(side, side, distance, levels=[0], colors=["black"])
    lateral = Ranges().lateral_mm
    corners_x, corners_y = np.array([-1, 1, 1, -1, -1]), np.array([-1, -1, 1, 1, -1])
    axes.plot(lateral * corners_x, lateral * corners_y, "r-", linewidth=1)
    axes.plot([0], [0], "r.")
    inside = xy[distance < 0]
    axes.set_xlim(inside[:, 0].min() - 8, inside[:, 0].max() + 8)
    axes.set_ylim(inside[:, 1].min() - 8, inside[:, 1].max() + 8)
    axes.set_title(f"{stimulus.name}: target point and poses in red")
