"""A scene: which stimulus is touched, at which pose, after which slide. Many scenes are arrays side by side.

A tap presses down at the pose. A slide presses at `pose - move` and then moves by `move` to the pose; `move` is in the
target frame, as the pose is, and may turn the sensor, too. What the sensor touches at the end is the same; what friction did to its skin
is not.
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
    """B scenes (numpy): `pose` is x, y (mm), yaw (deg), depth (mm) in the target frame of the stimulus; where sensors lean also their tilt
    as in `paths.Paths` (deg)."""

    stimulus: np.ndarray  # (B,) index into a tuple of stimuli
    pose: np.ndarray  # (B, 4), or (B, 6) with tilt
    move: np.ndarray  # (B, 2) mm, target frame, or (B, 3) with the turn that goes along with it, deg; zero for a tap
    friction: np.ndarray  # (B,) Coulomb coefficient

    def __len__(self) -> int:
        return len(self.stimulus)

    def take(self, index: np.ndarray) -> "Scenes":
        return Scenes(
            *(field[index] for field in (self.stimulus, self.pose, self.move, self.friction))
        )


def sample_poses(
    generator: np.random.Generator,
    count: int,
    lateral_mm: float,
    yaw_deg: float,
    depth_mm: tuple[float, float],
) -> Float[np.ndarray, "{count} 4"]:
    """Uniform poses as in section 3.2 of the paper."""
    if count < 1:
        raise UserError(f"poses = {count}: draw at least one")
    low = [-lateral_mm, -lateral_mm, -yaw_deg, depth_mm[0]]
    high = [lateral_mm, lateral_mm, yaw_deg, depth_mm[1]]
    return generator.uniform(low, high, (count, 4))


def sample_slides(
    generator: np.random.Generator, count: int, move_mm: float
) -> Float[np.ndarray, "{count} 2"]:
    """Slide offsets in mm: uniform along x alone, along y alone or along both, a third of the chances each."""
    offset = generator.uniform(-move_mm, move_mm, (count, 2))
    axis = generator.integers(3, size=count)
    return np.where(axis[:, None] == [1, 0], 0, offset)


def sample_tilts(
    generator: np.random.Generator, count: int, tilt_deg: float
) -> Float[np.ndarray, "{count} 2"]:
    """Tilts in deg, as in `paths.Paths`: uniform over the disk of this radius, so none leans by more."""
    size, way = (
        tilt_deg * np.sqrt(generator.uniform(size=count)),
        generator.uniform(0, 2 * np.pi, count),
    )
    return size[:, None] * np.stack([np.cos(way), np.sin(way)], axis=-1)


def make_scenes(
    stimuli: tuple[str | Outline, ...],
    stimulus: np.ndarray,
    pose: np.ndarray,
    move: np.ndarray,
    mu: float | None = None,
) -> Scenes:
    """Scenes with friction `mu`, or None for that of each stimulus' material."""
    friction = np.array([make_stimulus(one).friction if mu is None else mu for one in stimuli])
    return Scenes(
        np.asarray(stimulus), np.asarray(pose, float), np.asarray(move, float), friction[stimulus]
    )


def compute_edge_labels(
    stimuli: tuple[str | Outline, ...], scenes: Scenes
) -> Float[np.ndarray, "B 2"]:
    """Signed distance (mm, negative inside) of the sensor's lowest point, on its axis where it is upright, from the nearest edge,
    and the direction of that edge's outward normal in the sensor frame (deg, in (-180, 180]): the pose that is not ambiguous on a
    smooth edge."""
    labels = np.zeros((len(scenes), 2))
    for index in np.unique(scenes.stimulus):
        here = scenes.stimulus == index
        labels[here] = make_edge_labeler(make_stimulus(stimuli[index]))(scenes.pose[here, :3])
    return labels


def has_one_edge(
    stimuli: tuple[str | Outline, ...],
    stimulus: Num[np.ndarray, "B"],
    pose: Num[np.ndarray, "B P"],
) -> Bool[np.ndarray, "B"]:
    """Say at which poses the direction of the nearest edge is unambiguous.

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
        own, others = normal(xy), normal(xy[:, None] + jnp.asarray(around, jnp.float32)[None])
        turn = jnp.sum(own[:, None] * others, axis=-1)
        one[here] = np.asarray(turn).min(axis=1) >= np.cos(np.radians(TURN_DEG))
    return one


def make_edge_labeler(stimulus: Stimulus) -> Callable[[np.ndarray], np.ndarray]:
    """A function that gives the same two labels of points, x y mm and yaw deg; NaN where they are."""

    @jax.jit
    def both(xy: jax.Array) -> tuple[jax.Array, jax.Array]:
        return compute_signed_distance(stimulus, xy), compute_outward_normal(stimulus, xy)

    def report(point: Float[np.ndarray, "B 3"]) -> Float[np.ndarray, "B 2"]:
        distance, normal = both(jnp.asarray(np.nan_to_num(point[:, :2]), jnp.float32))
        angle = np.degrees(np.arctan2(normal[:, 1], normal[:, 0])) - point[:, 2]
        return np.stack(
            [np.where(np.isnan(point[:, 0]), np.nan, distance), wrap_degrees(angle)], -1
        )

    return report
