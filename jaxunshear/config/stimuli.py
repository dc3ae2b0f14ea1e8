"""What can be touched: a shape by its name, or an outline of one's own, which settings hold as points.

>>> PairedData(stimuli=("disk", Outline("kite", ((0, -15), (12, 0), (0, 25), (-12, 0)))))

`outlines.py` reads outlines from files and traces them from functions; `simulator/stimuli.py` makes shapes of them.
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
# Of a pose, what shapes show that are alike in many places; all others show all of it.
STIMULUS_TEXTS = {
    "edge": ("x_mm", "yaw_deg", "depth_mm", "edge_mm", "edge_deg", "tilt_x_deg", "tilt_y_deg"),
    "surface": ("depth_mm", "tilt_x_deg", "tilt_y_deg"),
}

# Rubber on hard plastic lies between about 0.5 and 0.9. The evidence is divided (docs/simulator.md): with 0.35 a PoseNet
# trained on taps hardly minds the slide, where the paper's is no better than chance (its Table 2), but recordings of another
# sensor, whose pins stay behind by no more than 0.8-1 mm, suggest 0.2 to 0.4.
ABS_FRICTION = 0.7
MIN_AREA_MM2 = 9.0  # a shape of 3 mm; the contact's edges are rounded by 1 mm
MAX_DISTANCE_MM = 120.0  # from the target: the contact sees shapes to 125 mm
MAX_CORNERS = 400
NORMAL_WINDOW_MM = 0.5  # along an outline to either side of its target: a mean over that has no steps where curves are polygons

Points = tuple[tuple[float, float], ...]
Target = tuple[float, float, float]


@dataclass(frozen=True)
class Outline:
    """A closed polygon of mm that does not cross itself; a soft one is a polygon of many corners. Refuses what is none, as a UserError.

    `target` is the place x, y that poses are relative to, and the direction of the outward normal there in degrees; by default where
    a line from the area's centre along x leaves the shape for good. `str` gives the name, as for a shape that has only that.
    """

    name: str  # as the shape is called in tables; of none of ours
    points: Points  # (x, y) mm, any way round; rows of an array will do
    target: Target | None = None
    friction: float = ABS_FRICTION

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not re.fullmatch(
            r"[A-Za-z0-9_][A-Za-z0-9_-]{0,39}", self.name
        ):
            raise UserError(f"outline '{self.name}': name it by letters, digits, '-' and '_'")
        if self.name in typing.get_args(StimulusName):
            raise UserError(f"outline '{self.name}': there is a shape of this name: use another")
        object.__setattr__(self, "points", self._numbers("points", self.points))
        if self.target is not None:
            object.__setattr__(self, "target", self._numbers("target", (self.target,))[0])
        if not self._numbers("friction", ((self.friction,),))[0][0] >= 0:
            raise UserError(f"outline '{self.name}': its friction is below zero: use 0 or more")
        if complaint := self._complaint():
            raise UserError(f"outline '{self.name}' {complaint}")

    def __str__(self) -> str:
        return self.name

    @property
    def place(self) -> Target:
        """The target, whether it was given or not."""
        return self.target or _rightmost(np.array(self.points))

    @property
    def extent_mm(self) -> float:
        """The shape lies within this radius of its own origin."""
        return float(np.linalg.norm(self.points, axis=-1).max())

    def _numbers(self, field: str, rows: Iterable[Iterable[float]]) -> tuple:
        wanted = {
            "points": "pairs x, y in mm",
            "target": "x and y in mm and degrees",
            "friction": "a number",
        }[field]
        try:
            found = tuple(tuple(float(value) for value in row) for row in rows)
        except (TypeError, ValueError):
            raise UserError(f"outline '{self.name}': its {field} must be {wanted}") from None
        if any(len(row) != {"points": 2, "target": 3, "friction": 1}[field] for row in found):
            raise UserError(f"outline '{self.name}': its {field} must be {wanted}")
        if not all(np.isfinite(row).all() for row in found):
            raise UserError(
                f"outline '{self.name}': its {field} must be finite, not NaN or infinite"
            )
        return found

    def _complaint(self) -> str:
        corners = _drop_repeated(np.array(self.points).reshape(-1, 2))
        if len(corners) < 3:
            return "is a point or a line: give at least 3 points around an area"
        if len(corners) > MAX_CORNERS:
            return f"has {len(corners)} corners: use at most {MAX_CORNERS}"
        if _crosses(corners):
            return "crosses itself: give points in their order around the area"
        if abs(_area(corners)) < MIN_AREA_MM2:
            return f"encloses less than {MIN_AREA_MM2:g} mm²: make it larger; points are in mm"
        farthest = float(np.linalg.norm(corners - self.place[:2], axis=-1).max())
        if farthest > MAX_DISTANCE_MM:
            return f"goes {farthest:.0f} mm from its target: make it smaller, at most {MAX_DISTANCE_MM:g} mm; points are in mm"
        return ""


StimulusSetting = StimulusName | Outline  # what a field takes


def list_stimulus_names(stimuli: Iterable[object]) -> tuple[str, ...]:
    """Of settings, or of settings as they are stored."""
    return tuple(str(one["name"] if isinstance(one, dict) else one) for one in stimuli)


def _drop_repeated(points: np.ndarray) -> np.ndarray:
    """Without those that repeat the one before; the first may be given again as the last."""
    return points[np.any(points != np.roll(points, 1, axis=0), axis=-1)]


def _area(corners: np.ndarray) -> float:
    """mm², positive where they go round counter-clockwise."""
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def _rightmost(points: np.ndarray) -> Target:
    """Where the line along x through the area's centre leaves a polygon for good, and the outward normal of its outline about there."""
    corners = _drop_repeated(points)
    corners = corners if _area(corners) > 0 else corners[::-1]
    after = np.roll(corners, -1, axis=0)
    (x, y), (x_after, y_after) = corners.T, after.T
    height = float(np.sum((y + y_after) * (x * y_after - x_after * y)) / (6 * _area(corners)))
    met = (np.minimum(y, y_after) <= height) & (height <= np.maximum(y, y_after))
    share = np.clip((height - y) / np.where(y == y_after, 1, y_after - y), 0, 1)
    at = np.where(met, x + share * (x_after - x), -np.inf)
    last, length = int(np.argmax(at)), np.linalg.norm(after - corners, axis=-1)
    arc = np.append(0, np.cumsum(length))
    ends = arc[last] + share[last] * length[last] + np.array([-NORMAL_WINDOW_MM, NORMAL_WINDOW_MM])
    before, behind = np.stack(
        [np.interp(ends, arc[:-1], of, period=arc[-1]) for of in (x, y)], axis=-1
    )
    along = behind - before
    return float(at[last]), height, float(np.degrees(np.arctan2(-along[0], along[1])))


def _crosses(corners: np.ndarray) -> bool:
    """Whether a closed polygon (V, 2) folds back on itself, or any two of its sides that are not neighbours meet."""
    start, end = corners, np.roll(corners, -1, axis=0)
    sides, following = end - start, np.roll(end - start, -1, axis=0)
    turn = sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]
    folds = (turn == 0) & (np.sum(sides * following, axis=-1) < 0)

    def side(of: np.ndarray) -> np.ndarray:
        """(V, V): on which side of each line (first index) a point of each other side lies."""
        to = of[None] - start[:, None]
        return np.sign(sides[:, None, 0] * to[..., 1] - sides[:, None, 1] * to[..., 0])

    apart = side(start) * side(end) <= 0
    low, high = np.minimum(start, end), np.maximum(start, end)
    near = np.all(low[:, None] <= high[None], axis=-1)  # of sides on one line, those that overlap
    number = np.arange(len(corners))
    gap = np.abs(number[:, None] - number)
    neighbours = (gap <= 1) | (gap == len(corners) - 1)
    return bool(np.any(folds) or np.any(apart & apart.T & near & near.T & ~neighbours))
