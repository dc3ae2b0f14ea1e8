"""Scenes: which stimulus is touched, at which pose, after which slide.

A tap presses down at the pose. A slide presses at `pose - move` and then moves by `move` to the
pose; `move` is in the target frame, as the pose is, and may turn the sensor, too. Both end over the
same place, but friction has deformed the skin of the slide.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Num

from jaxunshear.angles import wrap_degrees
from jaxunshear.config.stimuli import Outline
from jaxunshear.errors import UserError
from jaxunshear.simulator.stimuli import (
    Stimulus,
    compute_outward_normal,
    compute_signed_distance,
    make_stimulus,
)

NEAR_MM, TURN_DEG = 1.0, 30.0  # a direction that turns by more than this so near by is ambiguous
AMBIGUITY_SAMPLES = 16  # places that it is compared with


@dataclass(frozen=True)
class Scenes:
    """B scenes (numpy).

    `pose` is x, y (mm), yaw (deg), depth (mm) in the target frame of the stimulus, and the tilt as
    in `paths.Paths` (deg) where sensors are tilted.
    """

    stimulus: np.ndarray  # (B,) index into a tuple of stimuli
    pose: np.ndarray  # (B, 4), or (B, 6) with tilt
    move: np.ndarray  # (B, 2) mm, target frame, or (B, 3) with a turn in deg; zero for a tap
    friction: np.ndarray  # (B,) Coulomb coefficient

    def __len__(self) -> int:
        return len(self.stimulus)

    def take(self, index: np.ndarray) -> "Scenes":
        return Scenes(
            self.stimulus[index], self.pose[index], self.move[index], self.friction[index]
        )


def sample_poses(
    generator: np.random.Generator,
    count: int,
    lateral_mm: float,
    yaw_deg: float,
    depth_mm: tuple[float, float],
) -> Float[np.ndarray, "{count} 4"]:
    """Sample uniform poses as in section 3.2 of the paper."""
    if count < 1:
        raise UserError(f"poses = {count}: draw at least one")
    low = [-lateral_mm, -lateral_mm, -yaw_deg, depth_mm[0]]
    high = [lateral_mm, lateral_mm, yaw_deg, depth_mm[1]]
    return generator.uniform(low, high, (count, 4))


def sample_slides(
    generator: np.random.Generator, count: int, move_mm: float
) -> Float[np.ndarray, "{count} 2"]:
    """Sample slides in mm: uniform along x, y or both, with a chance of a third each."""
    offset = generator.uniform(-move_mm, move_mm, (count, 2))
    axis = generator.integers(3, size=count)
    return np.where(axis[:, None] == [1, 0], 0, offset)


def sample_tilts(
    generator: np.random.Generator, count: int, tilt_deg: float
) -> Float[np.ndarray, "{count} 2"]:
    """Sample tilts in deg, as in `paths.Paths`: uniform over the disk of this radius."""
    size = tilt_deg * np.sqrt(generator.uniform(size=count))
    direction = generator.uniform(0, 2 * np.pi, count)
    return size[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=-1)


def make_scenes(
    stimuli: tuple[str | Outline, ...],
    stimulus: np.ndarray,
    pose: np.ndarray,
    move: np.ndarray,
    mu: float | None = None,
) -> Scenes:
    """Make scenes with friction `mu`, or None for that of each stimulus' material."""
    friction = np.array([make_stimulus(one).friction if mu is None else mu for one in stimuli])
    return Scenes(
        np.asarray(stimulus), np.asarray(pose, float), np.asarray(move, float), friction[stimulus]
    )


def compute_edge_labels(
    stimuli: tuple[str | Outline, ...], scenes: Scenes
) -> Float[np.ndarray, "B 2"]:
    """Compute the pose relative to the nearest edge, which is not ambiguous on a smooth edge.

    It is the signed distance (mm, negative inside) of the sensor's lowest point, on its axis where
    it is upright, from the nearest edge, and the direction of that edge's outward normal in the
    sensor frame (deg, in (-180, 180]).
    """
    labels = np.zeros((len(scenes), 2))
    for index in np.unique(scenes.stimulus):
        here = scenes.stimulus == index
        labels[here] = make_edge_labeler(make_stimulus(stimuli[index]))(scenes.pose[here, :3])
    return labels


def has_one_edge(
    stimuli: tuple[str | Outline, ...], stimulus: Num[np.ndarray, "B"], pose: Num[np.ndarray, "B P"]
) -> Bool[np.ndarray, "B"]:
    """Find the poses at which the direction of the nearest edge is unambiguous.

    Two edges are as near on the medial axis of a shape: there the direction jumps, and about the
    centre of a tight curve it turns fast. A pose counts as ambiguous if the outward normal turns by
    more than TURN_DEG anywhere on a circle of NEAR_MM about the sensor's point, or if it has no
    direction. `stimulus` is an index into `stimuli`; `pose` has x, y in mm in its first columns.
    """
    angle = 2 * np.pi * np.arange(AMBIGUITY_SAMPLES) / AMBIGUITY_SAMPLES
    around = NEAR_MM * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    one = np.zeros(len(stimulus), bool)
    for index in np.unique(stimulus):
        here = stimulus == index
        normal = jax.jit(partial(compute_outward_normal, make_stimulus(stimuli[index])))
        xy = jnp.asarray(pose[here, :2], jnp.float32)
        others = normal(xy[:, None] + jnp.asarray(around, jnp.float32)[None])
        cosine = jnp.sum(normal(xy)[:, None] * others, axis=-1)
        one[here] = np.asarray(cosine).min(axis=1) >= np.cos(np.radians(TURN_DEG))
    return one


def make_edge_labeler(stimulus: Stimulus) -> Callable[[np.ndarray], np.ndarray]:
    """Make a function from points to the labels of `compute_edge_labels`.

    A point is x, y (mm) and yaw (deg). Labels of points that are NaN are NaN.
    """

    @jax.jit
    def measure(xy: jax.Array) -> tuple[jax.Array, jax.Array]:
        return compute_signed_distance(stimulus, xy), compute_outward_normal(stimulus, xy)

    def label(point: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "B 2"]:
        distance, normal = measure(jnp.asarray(np.nan_to_num(point[:, :2]), jnp.float32))
        angle = np.degrees(np.arctan2(normal[:, 1], normal[:, 0])) - point[:, 2]
        return np.stack(
            [np.where(np.isnan(point[:, 0]), np.nan, distance), wrap_degrees(angle)], -1
        )

    return label
