"""Motions in full: way points of the sensor over a stimulus, with slide, twist and tilt.

Many motions are arrays with a leading axis:

    press, slide, twist: points = [[-2, 0, 0, 0, 0, 0], [-2, 0, 0, 3, 0, 0], [0, 0, 20, 3, 0, 0]]

`Scenes` are the paper's two kinds of motion; `make_paths` converts them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxunshear.simulator.level import STRONG_FRICTION, Level
from jaxunshear.simulator.scene import Scenes

X, Y, YAW, DEPTH, TILT_X, TILT_Y = range(6)
TURNS = (YAW, TILT_X, TILT_Y)
MIN_LEG_MM = 1e-6  # a shorter motion is none: float32 could not distinguish it from standing still
# an increment at strong friction: a node that touches sticks where the increment began
STRONG_PRESS_MM = 1.0


@dataclass(frozen=True)
class Paths:
    """B motions over K way points (numpy), in the target frame; straight lines in between.

    A point is x, y (mm), yaw (deg), depth (mm), tilt_x, tilt_y (deg). `depth` is how far the lowest
    point of the undeformed dome, above (x, y), would lie below the stimulus' top. The tilt is a
    rotation vector in the yawed frame, about the dome's centre, so that it moves neither the lowest
    point nor its depth. At the first point the skin is at rest.
    """

    stimulus: np.ndarray  # (B,) index into a tuple of stimuli
    friction: np.ndarray  # (B,) Coulomb coefficient, 0 to infinity
    points: np.ndarray  # (B, K, 6)

    def __len__(self) -> int:
        return len(self.stimulus)

    @property
    def radians(self) -> np.ndarray:
        """(B, K, 6) points, with angles in rad."""
        points = np.array(self.points, float)
        points[..., TURNS] = np.radians(points[..., TURNS])
        return points

    def take(self, index: np.ndarray) -> "Paths":
        return Paths(self.stimulus[index], self.friction[index], self.points[index])


def make_paths(scenes: Scenes) -> Paths:
    """Make the paths of scenes: down at `pose - move`, then along `move` (nowhere for a tap).

    The slide keeps its depth and tilt and turns at an even pace.
    """
    points = np.zeros((len(scenes), 3, 6))
    points[..., : scenes.pose.shape[1]] = scenes.pose[:, None]
    points[:, :2, : scenes.move.shape[1]] -= scenes.move[:, None]
    points[:, 0, DEPTH] = 0
    return Paths(scenes.stimulus, scenes.friction, points)


def cut_increments(
    paths: Paths, level: Level, radius_mm: float
) -> tuple[Float[np.ndarray, "B T 6"], Int[np.ndarray, "B"]]:
    """Cut the paths into poses, angles in rad, each padded by staying at its end.

    The numbers of increments come second. Twists count as motion at `radius_mm` / 4 of the axis,
    tilts at the dome's radius.
    """
    points = paths.radians
    change = np.diff(points, axis=1)
    pressed = np.abs(change[..., DEPTH])
    along = np.linalg.norm(change[..., :2], axis=-1) + radius_mm / 4 * np.abs(change[..., YAW])
    along += radius_mm * np.linalg.norm(change[..., TILT_X:], axis=-1)
    pressed = np.where(pressed < MIN_LEG_MM, 0, pressed)
    along = np.where(along < MIN_LEG_MM, 0, along)
    strong = (paths.friction > STRONG_FRICTION)[:, None]
    press_mm = np.where(strong, np.minimum(STRONG_PRESS_MM, level.press_mm), level.press_mm)
    press = np.ceil(pressed / press_mm - 1e-9)
    slide = np.ceil(along / level.slide_mm - 1e-9)
    if "steps" not in level.omit:
        press = np.maximum(press, level.press * (pressed > 0))
        slide = np.maximum(slide, level.slide * (along > 0))
    count = np.maximum(press, slide).astype(int)  # (B, K - 1)
    ends = np.cumsum(count, axis=1)
    total = ends[:, -1]
    number = np.arange(1, max(int(total.max(initial=0)), 1) + 1)
    # of every increment; past the end: K - 1
    leg = np.sum(number[None, :, None] > ends[:, None, :], axis=-1)
    rows = np.arange(len(points))[:, None]
    inside = np.minimum(leg, count.shape[1] - 1)
    before = ends[rows, inside] - count[rows, inside]
    share = np.clip((number - before) / np.maximum(count[rows, inside], 1), 0, 1)[..., None]
    share = np.where((leg < count.shape[1])[..., None], share, 1.0)
    poses = points[rows, inside] + share * change[rows, inside]
    return np.concatenate([points[:, :1], poses], axis=1), total
