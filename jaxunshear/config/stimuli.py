"""What can be touched: a shape by its name, or an outline, which settings hold as points.

>>> PairedData(stimuli=("disk", Outline("kite", ((0, -15), (12, 0), (0, 25), (-12, 0)))))

`outlines.py` reads outlines from files and traces them from functions; `simulator/stimuli.py` makes
shapes of them.
"""

import re
import typing
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from jaxunshear.errors import UserError

StimulusName = Literal[
    "disk", "clover", "teardrop", "flower", "leaf", "spiral_1", "spiral_2", "edge", "surface"
]
# The targets that a contact determines on shapes with many places that are the same. On all other
# shapes it determines all targets.
SHOWN_TARGETS = {
    "edge": ("x_mm", "yaw_deg", "depth_mm", "edge_mm", "edge_deg", "tilt_x_deg", "tilt_y_deg"),
    "surface": ("depth_mm", "tilt_x_deg", "tilt_y_deg"),
}

# Rubber on hard plastic has about 0.5 to 0.9. The evidence is divided (docs/calibration.md): with
# 0.35, slides hardly disturb a PoseNet trained on taps, while the paper's is then no better than
# chance (its Table 2); but recordings of another sensor, whose pins lag by no more than 0.8-1 mm,
# suggest 0.2 to 0.4.
ABS_FRICTION = 0.7
MIN_AREA_MM2 = 9.0  # a shape of 3 mm; the contact's edges are rounded by 1 mm
MAX_DISTANCE_MM = 120.0  # from the target: the contact model samples shapes to 125 mm
MAX_CORNERS = 400
# A normal is a mean over an outline this far to either side of its target: along a curve that is
# a polygon of many corners such a mean has no steps.
NORMAL_WINDOW_MM = 0.5

Points = tuple[tuple[float, float], ...]
Target = tuple[float, float, float]


_FIELDS = {  # of an outline: what a row of its numbers is
    "points": ("pairs x, y in mm", 2),
    "target": ("x, y in mm and degrees", 3),
    "friction": ("a number", 1),
}


@dataclass(frozen=True)
class Outline:
    """A closed polygon in mm that does not cross itself; a curve is a polygon of many corners.

    `target` is the point x, y that poses are relative to, and the direction of the outward normal
    there in degrees. By default it is where a line from the area's centre along x leaves the shape
    for the last time. `str` returns the name, as for a shape that has only a name. Raises UserError
    for what is no such polygon.
    """

    name: str  # in tables; not that of a built-in shape
    points: Points  # (x, y) mm, in either direction; rows of an array will do
    target: Target | None = None
    friction: float = ABS_FRICTION

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not re.fullmatch(
            r"[A-Za-z0-9_][A-Za-z0-9_-]{0,39}", self.name
        ):
            raise UserError(f"outline '{self.name}': name it by letters, digits, '-' and '_'")
        if self.name in typing.get_args(StimulusName):
            raise UserError(f"outline '{self.name}': there is a shape of this name: use another")
        object.__setattr__(self, "points", self._to_numbers("points", self.points))
        if self.target is not None:
            object.__setattr__(self, "target", self._to_numbers("target", (self.target,))[0])
        if not self._to_numbers("friction", ((self.friction,),))[0][0] >= 0:
            raise UserError(f"outline '{self.name}': its friction is below zero: use 0 or more")
        if problem := self._find_problem():
            raise UserError(f"outline '{self.name}' {problem}")

    def __str__(self) -> str:
        return self.name

    @property
    def place(self) -> Target:
        """The target, or else the default one."""
        return self.target or _find_rightmost_point(np.array(self.points))

    @property
    def extent_mm(self) -> float:
        """The radius about the origin within which the shape lies."""
        return float(np.linalg.norm(self.points, axis=-1).max())

    def _to_numbers(self, field: str, rows: Iterable[Iterable[float]]) -> tuple:
        """Convert rows to tuples of finite floats. Raises UserError."""
        description, width = _FIELDS[field]
        complaint = f"outline '{self.name}': its {field} must be"
        try:
            numbers = tuple(tuple(map(float, row)) for row in rows)
        except (TypeError, ValueError):
            numbers = ((),)
        if any(len(row) != width for row in numbers):
            raise UserError(f"{complaint} {description}")
        if not all(np.isfinite(row).all() for row in numbers):
            raise UserError(f"{complaint} finite, not NaN or infinite")
        return numbers

    def _find_problem(self) -> str:
        """Return what is wrong with the polygon and what to do, or nothing."""
        corners = _drop_repetitions(np.array(self.points).reshape(-1, 2))
        if len(corners) < 3:
            return "is a point or a line: give at least 3 points around an area"
        if len(corners) > MAX_CORNERS:
            return f"has {len(corners)} corners: use at most {MAX_CORNERS}"
        if _crosses_itself(corners):
            return "crosses itself: give points in their order around the area"
        if abs(_compute_area(corners)) < MIN_AREA_MM2:
            return f"encloses less than {MIN_AREA_MM2:g} mm²: make it larger; points are in mm"
        farthest = float(np.linalg.norm(corners - self.place[:2], axis=-1).max())
        if farthest > MAX_DISTANCE_MM:
            return (
                f"goes {farthest:.0f} mm from its target: make it smaller, "
                f"at most {MAX_DISTANCE_MM:g} mm; points are in mm"
            )
        return ""


StimulusSetting = StimulusName | Outline


def list_stimulus_names(stimuli: Iterable[object]) -> tuple[str, ...]:
    """List the names of stimuli, which may be settings or settings read from JSON."""
    return tuple(str(item["name"] if isinstance(item, dict) else item) for item in stimuli)


def _drop_repetitions(points: np.ndarray) -> np.ndarray:
    """Drop points that repeat the one before; the last may repeat the first."""
    return points[np.any(points != np.roll(points, 1, axis=0), axis=-1)]


def _compute_area(corners: np.ndarray) -> float:
    """Compute the area in mm², positive if the corners go round counter-clockwise."""
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def _find_rightmost_point(points: np.ndarray) -> Target:
    """Find where the line along x through a polygon's centre leaves it for the last time.

    Returns x and y in mm, and the direction of the outward normal about there in degrees.
    """
    corners = _drop_repetitions(points)
    corners = corners if _compute_area(corners) > 0 else corners[::-1]
    ends = np.roll(corners, -1, axis=0)
    (x, y), (x_end, y_end) = corners.T, ends.T
    moment = np.sum((y + y_end) * (x * y_end - x_end * y))
    height = float(moment / (6 * _compute_area(corners)))
    is_crossed = (np.minimum(y, y_end) <= height) & (height <= np.maximum(y, y_end))
    share = np.clip((height - y) / np.where(y == y_end, 1, y_end - y), 0, 1)
    crossing_x = np.where(is_crossed, x + share * (x_end - x), -np.inf)
    side = int(np.argmax(crossing_x))
    lengths = np.linalg.norm(ends - corners, axis=-1)
    arc = np.append(0, np.cumsum(lengths))
    window = np.array([-NORMAL_WINDOW_MM, NORMAL_WINDOW_MM])
    places = arc[side] + share[side] * lengths[side] + window
    along_x = np.diff(np.interp(places, arc[:-1], x, period=arc[-1])).item()
    along_y = np.diff(np.interp(places, arc[:-1], y, period=arc[-1])).item()
    return float(crossing_x[side]), height, float(np.degrees(np.arctan2(-along_x, along_y)))


def _crosses_itself(corners: np.ndarray) -> bool:
    """Return whether a closed polygon (V, 2) folds back, or sides that are no neighbours meet."""
    start, end = corners, np.roll(corners, -1, axis=0)
    sides, next_sides = end - start, np.roll(end - start, -1, axis=0)
    turn = sides[:, 0] * next_sides[:, 1] - sides[:, 1] * next_sides[:, 0]
    folds = (turn == 0) & (np.sum(sides * next_sides, axis=-1) < 0)

    def find_side(points: np.ndarray) -> np.ndarray:
        """Return the sign (V, V) of the side of each line, first index, on which a point lies."""
        offset = points[None] - start[:, None]
        return np.sign(sides[:, None, 0] * offset[..., 1] - sides[:, None, 1] * offset[..., 0])

    is_split = find_side(start) * find_side(end) <= 0  # a line splits the ends of another side
    low, high = np.minimum(start, end), np.maximum(start, end)
    overlaps = np.all(low[:, None] <= high[None], axis=-1)  # also for sides on one line
    number = np.arange(len(corners))
    gap = np.abs(number[:, None] - number)
    are_neighbours = (gap <= 1) | (gap == len(corners) - 1)
    meets = is_split & is_split.T & overlaps & overlaps.T & ~are_neighbours
    return bool(np.any(folds) or np.any(meets))
