"""Motions in full: way points of the sensor over a stimulus, with slide, twist and tilt.

Many motions are arrays with a leading axis:

    press, slide, twist: points = [[-2, 0, 0, 0, 0, 0], [-2, 0, 0, 3, 0, 0], [0, 0, 20, 3, 0, 0]]

`Scenes` are the paper's two kinds of motion; `make_paths` converts them.

The level frame is the sensor frame with its tilt undone: there the stimulus' top is the plane
z = 0. A `Frame` holds the rotations (B, 3, 3) from the sensor frame to the level frame, or None
where no sensor is tilted.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxunshear.simulator.level import STRONG_FRICTION, Level
from jaxunshear.simulator.scene import Scenes

X, Y, YAW, DEPTH, TILT_X, TILT_Y = range(6)
TURNS = (YAW, TILT_X, TILT_Y)
MIN_LEG_MM = 1e-6  # a shorter motion is none: float32 could not distinguish it from standing still
# an increment at strong friction: a node that touches sticks where the increment began
STRONG_PRESS_MM = 1.0
Frame = Float[jax.Array, "B 3 3"] | None


@dataclass(frozen=True)
class Paths:
    """B motions over K way points (numpy), in the target frame; straight lines in between.

    A point is x, y (mm), yaw (deg), depth (mm), tilt_x, tilt_y (deg). `depth` is how far the lowest
    point of the undeformed dome, above (x, y), would lie below the stimulus' top. The tilt is a
    rotation vector in the yawed frame, about the dome's centre, so that it moves neither the lowest
    point nor its depth. A pad tilts about the middle of its face, which lies at `depth`. At the
    first point the skin is at rest.
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
    tilts at `radius_mm`.
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


def compute_level_frame(pose: Float[jax.Array, "B 6"]) -> Float[jax.Array, "B 3 3"]:
    """Compute the rotations from the sensor frame to the level frame of poses (Rodrigues)."""
    tilt = pose[:, TILT_X:]
    squared = jnp.sum(tilt**2, axis=-1)[:, None, None]
    angle = jnp.sqrt(jnp.maximum(squared, 1e-30))
    zero = jnp.zeros_like(tilt[:, 0])
    x, y = tilt[:, 0], tilt[:, 1]
    rows = [jnp.stack(row, -1) for row in ((zero, zero, y), (zero, zero, -x), (-y, x, zero))]
    cross = jnp.stack(rows, 1)
    return (
        jnp.eye(3, dtype=pose.dtype)[None]
        + jnp.sin(angle) / angle * cross
        + matmul((1 - jnp.cos(angle)) / angle**2 * cross, cross)
    )


def matmul(
    a: Float[jax.Array, "*A m k"], b: Float[jax.Array, "*B k n"]
) -> Float[jax.Array, "*C m n"]:
    """Multiply matrices in their own precision, also on a GPU.

    A GPU would otherwise round float32 to ten bits, which no part of the physics may do.
    """
    return jnp.matmul(a, b, precision="highest")


def transpose(frame: Frame) -> Frame:
    return None if frame is None else jnp.swapaxes(frame, 1, 2)


def rotate(frame: Frame, vectors: Float[jax.Array, "B N d"]) -> Float[jax.Array, "B N d"]:
    if frame is None:
        return vectors
    return jnp.einsum("bij,bnj->bni", frame, vectors, precision="highest")


def rotate_back(frame: Frame, vectors: Float[jax.Array, "B N d"]) -> Float[jax.Array, "B N d"]:
    if frame is None:
        return vectors
    return jnp.einsum("bji,bnj->bni", frame, vectors, precision="highest")


def transform_to_level(
    frame: Frame, points: Float[jax.Array, "B N 3"], centre_mm: Float[jax.Array, ""]
) -> Float[jax.Array, "B N 3"]:
    """Transform points of the sensor frame to the level frame.

    The lowest point of a dome, or the middle of a pad's face, lies at z = 0 in the level frame.
    """
    if frame is None:
        return points
    zero = jnp.zeros_like(centre_mm)
    centre = jnp.stack([zero, zero, centre_mm])[None, None]
    return rotate(frame, points - centre) + centre


def rotate_in_plane(
    angle: Float[jax.Array, "B"], xy: Float[jax.Array, "B N 2"]
) -> Float[jax.Array, "B N 2"]:
    """Rotate points in the plane by angles in rad."""
    cos, sin = jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
    return jnp.stack(
        [cos * xy[..., 0] - sin * xy[..., 1], sin * xy[..., 0] + cos * xy[..., 1]], axis=-1
    )


def compute_increment_length(
    before: Float[jax.Array, "B 6"], after: Float[jax.Array, "B 6"], radius_mm: Float[jax.Array, ""]
) -> Float[jax.Array, "B"]:
    """Compute by how many mm the dome's tip moves; turns count at `radius_mm`."""
    change = after - before
    turns = radius_mm * jnp.linalg.norm(change[:, jnp.array(TURNS)], axis=-1)
    return jnp.linalg.norm(change[:, jnp.array([0, 1, DEPTH])], axis=-1) + turns
