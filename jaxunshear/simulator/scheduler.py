"""Which nodes and increments a scene needs; scenes of similar need share a batch.

    simulation = Simulation(TACTIP_331, ("disk",), LEVELS["auto"])
    for batch in make_plan(simulation, paths): ...

Left out are scenes that touch nothing, friction where there is none, nodes that cannot touch, and
increments of motions too short to need them. `batches` detects a node that was left out and would
have touched after all.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxunshear.config.contact_rings import REACHED_SHARE
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.stimuli import Outline
from jaxunshear.simulator.dome import load_shared_dome
from jaxunshear.simulator.elasticity import Compliance
from jaxunshear.simulator.harmonics import make_sixfold_permutations
from jaxunshear.simulator.level import Level
from jaxunshear.simulator.paths import (
    DEPTH,
    TILT_X,
    TURNS,
    YAW,
    Paths,
    compute_level_frame,
    cut_increments,
    matmul,
    rotate_in_plane,
    transform_to_level,
)
from jaxunshear.simulator.stimuli import (
    Obstacles,
    Stimulus,
    compute_surface_drop,
    interpolate_distance,
    sample_obstacles,
)

Stimuli = tuple[str | Outline | Stimulus, ...]

BATCH = 64

MARGIN_MM = 1.25  # outside the shape: the skin is dragged and bulges
WIDE_MARGINS = (1.1, 3.0)  # REACHED_SHARE and MARGIN_MM, where those were not enough
# A tap without friction differs from one with it by 0.08 px rms (of 256) at 1 to 1.5 mm of depth
# and by 0.9 px at 6 mm.
FRICTIONLESS_TAP_MM = 1.0
BETWEEN_POSES_MM = 1.5  # along a leg, where contact is checked
# padded sizes, so that few programs are compiled
NODE_COUNTS = (16, 32, 48, 64, 96, 128, 160, 192, 224, 256, 320, 384, 448, 512, 640, 768, 1024)
BATCHES = (1, 4, 16, 32, 64, 256)
MIN_SPLIT = 24  # scenes in a batch that is worth splitting
MIN_SPLIT_SAVING = 0.9  # of the unsplit cost: more parts must save more than this
PRODUCTS = 16  # of a matrix with the forces, an increment
MIN_ROWS = 12  # a matrix product with fewer rows than this takes as long as one with this many
PATH_LENGTHS = (16, 64, 256, 1024, 4096)


@dataclass(frozen=True)
class Simulation:
    """What all contacts of one call share."""

    sensor: Sensor
    stimuli: Stimuli
    level: Level
    batch: int = BATCH  # scenes that are solved together, at most

    @property
    def dome(self) -> Compliance:
        return load_shared_dome(self.sensor)

    @property
    def obstacles(self) -> Obstacles:
        return sample_obstacles(self.stimuli)


class ContactBatch(NamedTuple):
    """Scenes that are solved together, scene i on a lattice turned by 60 `turn[i]` deg."""

    rows: np.ndarray  # (b,) of the paths
    nodes: np.ndarray  # (n,) contact nodes of the turned lattice; none where nothing touches
    turn: np.ndarray  # (b,) 0 to 5
    steps: int  # increments of the longest path
    friction: bool  # False: pressures only
    tilted: bool


class _PlacedNodes(NamedTuple):
    """Nodes under B poses; heights are over the apex, or a dome's lowest point."""

    xy: jax.Array  # (B, N, 2) of the displaced nodes, in the target frame
    rest_height: jax.Array  # (B, N)
    height: jax.Array  # (B, N)


def _place_nodes(
    nodes: jax.Array, displacement: jax.Array, centre: jax.Array, pose: jax.Array, tilted: bool
) -> _PlacedNodes:
    frame = compute_level_frame(pose) if tilted else None
    place = transform_to_level(frame, nodes[None] + displacement, centre)
    height = jnp.broadcast_to(nodes[..., 2], displacement.shape[:2])
    if frame is not None:
        lift = jnp.array([0, 0, 1.0], nodes.dtype) * centre
        height = matmul(frame[:, 2], (nodes - lift[None]).T) + centre
    xy = rotate_in_plane(pose[:, YAW], place[..., :2]) + pose[:, None, :2]
    return _PlacedNodes(xy, height, place[..., 2])


@partial(jax.jit, static_argnames=("tilted", "wide"))
def _can_touch(
    obstacles: Obstacles,
    nodes: jax.Array,
    centre: jax.Array,
    stimulus_index: jax.Array,
    poses: jax.Array,
    tilted: bool,
    wide: bool,
) -> jax.Array:
    """Find the nodes (B, N) that can touch at any of poses (S, B, 6)."""
    reached, margin = WIDE_MARGINS if wide else (REACHED_SHARE, MARGIN_MM)

    def can_touch_at(pose: jax.Array) -> jax.Array:
        still = jnp.zeros((pose.shape[0], *nodes.shape), nodes.dtype)
        placed = _place_nodes(nodes, still, centre, pose, tilted)
        return (placed.rest_height < reached * pose[:, DEPTH, None]) & (
            interpolate_distance(obstacles, stimulus_index, placed.xy) < margin
        )

    return jnp.any(jax.lax.map(can_touch_at, poses), axis=0)


@partial(jax.jit, static_argnames="tilted")
def _compute_gaps(
    obstacles: Obstacles,
    nodes: jax.Array,
    centre: jax.Array,
    stimulus_index: jax.Array,
    pose: jax.Array,
    displacement: jax.Array,
    tilted: bool,
) -> jax.Array:
    placed = _place_nodes(nodes, displacement, centre, pose, tilted)
    drop = compute_surface_drop(obstacles, stimulus_index, placed.xy)
    return placed.height - pose[:, DEPTH, None] + drop


def compute_gaps(
    simulation: Simulation,
    nodes: Float[np.ndarray, "N 3"],
    stimulus_index: Int[np.ndarray, "B"],
    pose: Float[np.ndarray, "B 6"],
    displacement: Float[np.ndarray, "B N 3"],
) -> Float[np.ndarray, "B N"]:
    """Compute the gaps in mm between displaced nodes and the stimulus, negative inside.

    Poses have angles in rad.
    """
    count, size = len(pose), pad_count(len(nodes), NODE_COUNTS)
    rows = np.minimum(np.arange(pad_count(count, BATCHES)), count - 1)
    columns = np.minimum(np.arange(size), len(nodes) - 1)
    gaps = _compute_gaps(
        simulation.obstacles,
        jnp.asarray(nodes[columns], jnp.float32),
        jnp.float32(simulation.sensor.pivot_mm),
        jnp.asarray(stimulus_index[rows], jnp.int32),
        jnp.asarray(pose[rows], jnp.float32),
        jnp.asarray(displacement[rows][:, columns], jnp.float32),
        bool(np.any(pose[:, TILT_X:])),
    )
    return np.asarray(gaps)[:count, : len(nodes)]


def find_reachable_nodes(
    simulation: Simulation, paths: Paths, wide: bool
) -> Bool[np.ndarray, "B N"]:
    """Find the contact nodes that each path can bring into contact; `wide` searches further."""
    radius_mm = simulation.sensor.radius_mm
    points = paths.radians
    change = np.diff(points, axis=1)
    swept = np.linalg.norm(change[..., :2], axis=-1) + radius_mm * np.linalg.norm(
        change[..., TURNS], axis=-1
    )
    pieces = 1 << int(np.ceil(np.log2(max(swept.max(initial=0) / BETWEEN_POSES_MM, 1))))
    share = (np.arange(pieces) + 1) / pieces
    poses = points[:, :-1, None] + share[:, None] * change[:, :, None]
    poses = poses.reshape(len(points), -1, 6)
    # a press passes only through poses that touch less than its end
    poses = np.concatenate([points[:, :1], poses], axis=1).astype(np.float32)
    tilted = bool(np.any(points[..., TILT_X:]))
    masks = []
    for start in range(0, len(paths), 64):
        rows = np.minimum(np.arange(start, start + 64), len(paths) - 1)
        mask = _can_touch(
            simulation.obstacles,
            jnp.asarray(simulation.dome.nodes, jnp.float32),
            jnp.float32(simulation.sensor.pivot_mm),
            jnp.asarray(paths.stimulus[rows], jnp.int32),
            jnp.asarray(np.swapaxes(poses[rows], 0, 1)),
            tilted,
            wide,
        )
        masks.append(np.asarray(mask)[: len(paths) - start])
    return np.concatenate(masks)


def make_plan(simulation: Simulation, paths: Paths, wide: bool = False) -> list[ContactBatch]:
    """Put every path in one batch of at most `batch`; the nodes are those of complete rings.

    A batch solves the nodes and increments that any of its scenes needs, so a scene's solution
    depends on its companions, within the level's error.

    The dome is the same after a turn by 60 deg, so each scene is turned to bring its contact to the
    side of +x: scenes that touch with half of the dome then need the same half. `wide` includes
    more nodes about the contact.
    """
    count, level, nodes = len(paths), simulation.level, simulation.dome.nodes
    if "nodes" in level.omit:
        mask = find_reachable_nodes(simulation, paths, wide or level.wide_margin)
    else:
        mask = np.ones((count, len(nodes)), bool)
    if "untouched" not in level.omit:
        mask[~mask.any(axis=1)] = True
    grouping = "grouping" in level.omit
    turn = _choose_turns(mask, nodes) if grouping and count > 1 else np.zeros(count, int)
    mask = np.take_along_axis(mask, make_sixfold_permutations(len(nodes))[turn], axis=1)
    tilted = np.any(paths.points[..., TILT_X:] != 0, axis=(1, 2))
    friction = np.ones(count, bool)
    if "friction" in level.omit:
        friction = _needs_friction(paths, simulation.sensor) | tilted
    _, steps = cut_increments(paths, level, simulation.sensor.radius_mm)
    kinds = np.stack([mask.any(axis=1), friction, tilted], -1)
    batches = []
    for kind in np.unique(kinds, axis=0):
        _, has_friction, is_tilted = map(bool, kind)
        rows = np.flatnonzero(np.all(kinds == kind, axis=-1))
        features = _compute_features(mask, steps, nodes)
        group = _Group(mask, steps, features, 3 if has_friction else 1, simulation.batch)
        parts = np.array_split(rows, range(group.batch, len(rows), group.batch))
        for index in _split_rows(group, rows) if grouping else parts:
            used = np.flatnonzero(mask[index].any(axis=0))
            most_steps = int(steps[index].max())
            part = ContactBatch(index, used, turn[index], most_steps, has_friction, is_tilted)
            batches.append(part)
    return batches


def _needs_friction(paths: Paths, sensor: Sensor) -> np.ndarray:
    """Find the paths (B,) that need friction: not those without, nor shallow presses of a dome."""
    sideways = np.delete(paths.points, DEPTH, axis=-1)
    straight = np.all(sideways == sideways[:, :1], axis=(1, 2))
    shallow = np.max(paths.points[..., DEPTH], axis=1) <= FRICTIONLESS_TAP_MM
    # a pad that is pressed by a tenth of its thickness spreads: friction holds it back
    return (paths.friction > 0) & ~(straight & shallow & (not sensor.is_flat))


def _choose_turns(mask: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Choose the sixths of a turn (B,) that, undone, bring each contact's middle to +x."""
    middle = mask @ nodes[:, :2]
    return np.round(np.degrees(np.arctan2(middle[:, 1], middle[:, 0])) / 60).astype(int) % 6


class _Group(NamedTuple):
    """What B scenes need that may share batches."""

    mask: np.ndarray  # (B, N) needed nodes
    steps: np.ndarray  # (B,) increments
    features: np.ndarray  # (B, 4)
    unknowns: int  # of a node
    batch: int  # scenes in a batch, at most


def _compute_features(mask: np.ndarray, steps: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Compute what scenes are sorted by: nodes, increments, and the contact's middle; (B, 4)."""
    count = mask.sum(axis=1)
    return np.column_stack([count, steps, mask @ nodes[:, :2] / np.maximum(count, 1)[:, None]])


def _estimate_cost(group: _Group, rows: np.ndarray) -> float:
    """Estimate the multiplications of solving rows together.

    They are those of the increments and of the inverse, which runs at half the rate of a product.
    """
    unknowns = group.unknowns * pad_count(int(group.mask[rows].any(axis=0).sum()), NODE_COUNTS)
    products = PRODUCTS * max(int(group.steps[rows].max()), 1)
    batches = -(-len(rows) // group.batch)
    size = max(min(len(rows), group.batch), MIN_ROWS)
    return batches * (products * size * unknowns**2 + 2 * unknowns**3)


def _split_rows(group: _Group, rows: np.ndarray) -> list[np.ndarray]:
    """Halve rows along the feature that saves most, again and again while that saves cost."""
    fits = len(rows) <= group.batch
    if fits and len(rows) <= MIN_SPLIT:
        return [rows]
    half = len(rows) // 2 if fits else group.batch * -(-(len(rows) // 2) // group.batch)
    best, halves = np.inf, [rows]
    for values in group.features.T:
        order = rows[np.argsort(values[rows], kind="stable")]
        pair = [order[:half], order[half:]]
        cost = sum(_estimate_cost(group, part) for part in pair)
        if cost < best:
            best, halves = cost, pair
    parts = [index for part in halves for index in _split_rows(group, np.sort(part))]
    cost = sum(_estimate_cost(group, part) for part in parts)
    if fits and cost > MIN_SPLIT_SAVING * _estimate_cost(group, rows):
        return [rows]
    return parts


def pad_count(count: int, sizes: tuple[int, ...]) -> int:
    """Choose the smallest of `sizes` that holds `count`; beyond them `count` itself."""
    return next((size for size in sizes if size >= count), count)
