"""The file of a layout: where the markers of a sensor rest in its images.

>>> sensor = read_layout(Path("pad.json"))  # a MarkerSensor, whose `markers` are (P, 2)
"""

from dataclasses import dataclass
from pathlib import Path

from jaxunshear.config.sensor import MarkerSensor
from jaxunshear.errors import UserError
from jaxunshear.results.record_files import read_record

REMEDY = "make one by `jaxunshear layout FRAMES --out FILE`"


@dataclass(frozen=True, kw_only=True)
class LayoutFile:
    """The content of a layout file. The unit of lengths is the shorter side of the image."""

    name: str  # of the sensor
    image_px: tuple[int, int]  # width and height of the frames that it was found in
    dark: bool  # whether markers are dark on a light ground
    marker_radius: float
    markers: tuple[tuple[float, float], ...]  # column and row, from the middle of the image
    neighbours: tuple[tuple[int, int], ...]  # markers that are next to each other, by their rows


def read_layout(file: Path) -> MarkerSensor:
    """Read the sensor in a layout file. Raises UserError."""
    if not file.is_file():
        raise UserError(f"--layout {file} is no file: {REMEDY}")
    stored = read_record(file, LayoutFile, REMEDY)
    sensor = MarkerSensor(name=stored.name, markers=stored.markers, dark=stored.dark)
    for _, problem in sensor.find_problems():
        raise UserError(f"--layout {file}: markers: {problem}; or {REMEDY}")
    return sensor
