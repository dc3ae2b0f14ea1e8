"""Planned batches of contacts, solved one by one: the nodes a batch needs, their forces, the pins, and what was left out in error."""

from collections.abc import Callable
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.config.reach import compute_ring_arcs, compute_ring_spacing
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.stimuli import Outline
from jaxunshear.progress import Progress
from jaxunshear.simulator.contact_results import Contacts, Skins
from jaxunshear.simulator.frame import matmul
from jaxunshear.simulator.friction import (
    Quality,
    Skin,
    SolverResult,
    System,
    follow_path,
    make_undeformed_skins,
)
from jaxunshear.simulator.harmonics import make_sixfold_permutations
from jaxunshear.simulator.level import STRONG_FRICTION, Level
from jaxunshear.simulator.node_state import count_node_states
from jaxunshear.simulator.obstacle import Obstacles, sample_distances
from jaxunshear.simulator.paths import TILT_X, YAW, Paths
from jaxunshear.simulator.scheduler import (
    BATCHES,
    PATH_LENGTHS,
    ContactBatch,
    compute_gaps,
    cut_increments,
    make_plan,
    pad_count,
)
from jaxunshear.simulator.stimuli import Stimulus, make_stimulus
from jaxunshear.simulator.systems import build_matrices, build_system, load_shared_dome

PENETRATION_MM = (
    0.03  # a node that was left out and ends deeper than this in the stimulus was needed
)
NEIGHBOURS = 1.6  # ring spacings: a contact grows from node to neighbouring node

Stimuli = tuple[str | Outline | Stimulus, ...]


def sample_obstacles(names: Stimuli) -> Obstacles:
    """The shapes as the contact sees them; sampled once."""
    return _obstacles(tuple(make_stimulus(name) for name in names))


@lru_cache(maxsize=16)  # 4 MiB a shape: all that have a name, one by one, and some drawn by hand
def _obstacles(stimuli: tuple[Stimulus, ...]) -> Obstacles:
    return sample_distances(stimuli)


def plan_paths(
    sensor: Sensor,
    obstacles: Obstacles,
    paths: Paths,
    level: Level,
    batch: int,
    wide_margin: bool = False,
) -> list[ContactBatch]:
    """What each batch solves for; `wide_margin`: with more nodes about the contact, for those that turned out to need them."""
    nodes = load_shared_dome(sensor).nodes
    return make_plan(obstacles, nodes, sensor.dome_radius_mm, paths, level, batch, wide_margin)


def solve_batches(
    sensor: Sensor,
    obstacles: Obstacles,
    paths: Paths,
    level: Level,
    start: Skins | None,
    batch: int,
    progress: Progress | None,
    wide: bool,
) -> tuple[Contacts, Skins, np.ndarray]:
    """Contacts and skins at the ends of B paths, and which of them (B,) turn out to need nodes that were left out."""
    parts, order = [], []
    batches = plan_paths(sensor, obstacles, paths, level, batch, wide)
    if start is not None:
        batches = [
            _add_loaded_nodes(part, start, make_sixfold_permutations(start.force_n.shape[1]))
            for part in batches
        ]
    for part in batches:
        before = None if start is None else start.take(part.rows)
        if len(part.nodes):
            parts.append(
                _solve(sensor, obstacles, paths.take(part.rows), part, level, batch, before)
            )
        else:
            parts.append(_make_untouched_contacts(sensor, obstacles, paths.take(part.rows), level))
        order.append(part.rows)
        if progress is not None:
            progress.advance(len(part.rows))
    back = np.argsort(np.concatenate(order), kind="stable")
    fields = [
        np.concatenate(field)[back]
        for field in zip(*((*c, *s, i) for c, s, i in parts), strict=True)
    ]
    return Contacts(*fields[:-3]), Skins(*fields[-3:-1]), fields[-1]


def _add_loaded_nodes(part: ContactBatch, start: Skins, turned: np.ndarray) -> ContactBatch:
    """A batch that also solves for the nodes that carry a force at the start, with what those need."""
    force = start.force_n[part.rows]
    loaded = [
        np.flatnonzero(np.any(f[turned[k]] != 0, axis=-1))
        for k, f in zip(part.turn, force, strict=True)
    ]
    friction = part.friction or bool(np.any(force[..., :2]))
    return part._replace(
        nodes=np.union1d(part.nodes, np.concatenate(loaded)).astype(int), friction=friction
    )


def make_undeformed_contacts(sensor: Sensor, paths: Paths, level: Level) -> tuple[Contacts, Skins]:
    """The undeformed dome, as converged."""
    count, full = len(paths), load_shared_dome(sensor)
    none, nothing = np.zeros(count), np.zeros(count, np.int64)
    pins = np.repeat(full.pins[None].astype(level.precision), count, axis=0)
    free = np.full(count, len(full.nodes))
    good = np.ones(count, bool)
    contacts = Contacts(
        pins, none, good, nothing, nothing, nothing, free, np.zeros((count, 3)), nothing, ~good
    )
    return contacts, Skins(np.zeros((count, len(full.nodes), 3)), paths.points[:, -1])


def _make_untouched_contacts(
    sensor: Sensor, obstacles: Obstacles, paths: Paths, level: Level
) -> tuple[Contacts, Skins, np.ndarray]:
    """Of paths for which no node seemed to be needed. One that ends inside the stimulus shows that some are: a grazing touch."""
    nodes, pose = load_shared_dome(sensor).nodes, paths.radians[:, -1]
    still = np.zeros((len(paths), *nodes.shape))
    gap = compute_gaps(obstacles, nodes, sensor.dome_radius_mm, paths.stimulus, pose, still)
    return *make_undeformed_contacts(sensor, paths, level), np.min(gap, axis=1) < -PENETRATION_MM


def _compute_inverse_rotations(turn: np.ndarray) -> np.ndarray:
    """(B, 3, 3): from the turned lattice to the sensor frame."""
    angle = np.radians(60.0 * turn)
    cos, sin, zero, one = np.cos(angle), np.sin(angle), np.zeros(len(turn)), np.ones(len(turn))
    return np.stack(
        [np.stack(row, -1) for row in ((cos, -sin, zero), (sin, cos, zero), (zero, zero, one))], 1
    )


def _solve(
    sensor: Sensor,
    obstacles: Obstacles,
    paths: Paths,
    part: ContactBatch,
    level: Level,
    batch: int,
    start: Skins | None,
) -> tuple[Contacts, Skins, np.ndarray]:
    """One batch, padded by repeating its last scene."""
    count, full = len(paths), load_shared_dome(sensor)
    rotation, place = (
        _compute_inverse_rotations(part.turn),
        make_sixfold_permutations(len(full.nodes))[part.turn][:, part.nodes],
    )  # (b, n)
    poses, _ = cut_increments(paths, level, sensor.dome_radius_mm)
    poses[..., YAW] += np.radians(60.0 * part.turn)[:, None]
    poses[..., TILT_X:] = np.einsum("bji,btj->bti", rotation[:, :2, :2], poses[..., TILT_X:])
    rows = np.minimum(np.arange(min(pad_count(count, BATCHES), max(batch, count))), count - 1)
    length = pad_count(part.steps, PATH_LENGTHS)
    filled = np.minimum(np.arange(length + 1), poses.shape[1] - 1)
    with jax.enable_x64(level.precision == "float64"):
        system, newtons = build_system(
            sensor, part.nodes.astype(np.int64).tobytes(), part.friction, level.precision
        )
        size, unknowns = len(system.nodes), len(system.w) // len(system.nodes)
        force = np.zeros((len(rows), size, unknowns))
        if start is not None:
            loaded = (
                np.einsum(
                    "bji,bnj->bni", rotation, np.take_along_axis(start.force_n, place[..., None], 1)
                )
                / newtons
            )
            force[:, : len(part.nodes)] = loaded[rows][..., 3 - unknowns :]
        skin, quality, states = jax.device_get(
            _run(
                system,
                obstacles,
                jnp.asarray(paths.stimulus[rows], jnp.int32),
                jnp.asarray(paths.friction[rows], level.precision),
                jnp.asarray(np.swapaxes(poses[rows][:, filled], 0, 1), level.precision),
                part.steps,
                jnp.asarray(force, level.precision),
                level.tolerance,
                level.limit,
                part.tilted,
                level.strong_friction if (paths.friction > STRONG_FRICTION).any() else None,
                level.solver,
            )
        )
    turned = np.zeros((count, len(part.nodes), 3))
    turned[..., 3 - unknowns :] = skin.force[:count, : len(part.nodes)] * newtons
    on_nodes = np.zeros((count, len(full.nodes), 3))
    np.put_along_axis(on_nodes, place[..., None], np.einsum("bij,bnj->bni", rotation, turned), 1)
    pins = _pins(sensor, on_nodes, level.precision)
    residual, goal = quality.residual_mm[:count], quality.tolerance_mm[:count]
    converged = (residual <= goal) & np.isfinite(pins).all(axis=(1, 2))
    stuck, slipping, _ = (state[:count] for state in states)
    contacts = Contacts(
        pins,
        residual,
        converged,
        quality.iterations[:count],
        stuck,
        slipping,
        len(full.nodes) - stuck - slipping,
        on_nodes.sum(axis=1),
        np.full(count, len(part.nodes)),
        np.zeros(count, bool),
    )
    incomplete = _needs_more_nodes(sensor, obstacles, paths, part, poses[:, -1], turned)
    return contacts, Skins(on_nodes, paths.points[:, -1]), incomplete


def _pins(sensor: Sensor, force_n: np.ndarray, precision: str) -> np.ndarray:
    """Displaced pin tips (B, P, 3) under forces (B, N, 3) on the contact nodes."""
    full = load_shared_dome(sensor)
    used = np.flatnonzero(np.any(force_n != 0, axis=(0, 2)))
    matrix = build_matrices(sensor, precision)[1].reshape(len(full.nodes), 3, -1)[used]
    moved = force_n[:, used].reshape(len(force_n), -1).astype(precision) @ matrix.reshape(
        -1, matrix.shape[-1]
    )
    return (full.pins + moved.reshape(len(force_n), -1, 3)).astype(precision)


def _needs_more_nodes(
    sensor: Sensor,
    obstacles: Obstacles,
    paths: Paths,
    part: ContactBatch,
    pose: np.ndarray,
    force_n: np.ndarray,
) -> np.ndarray:
    """(B,) whether the contact reaches the last ring, or a node beside it that was left out ends inside the stimulus."""
    full = load_shared_dome(sensor)
    last_ring = part.nodes >= len(full.nodes) - 6 * (len(compute_ring_arcs(sensor)) - 1)
    beyond = np.any(force_n[:, last_ring] != 0, axis=(1, 2))
    loaded = np.flatnonzero(np.any(force_n != 0, axis=(0, 2)))
    near = np.any(_find_neighbours(sensor)[part.nodes[loaded]], axis=0)
    near[part.nodes] = False
    beside = np.flatnonzero(near)
    if not len(beside):
        return beyond
    columns = (3 * part.nodes[loaded][:, None] + np.arange(3)).ravel()
    matrix = full.w[np.ix_((3 * beside[:, None] + np.arange(3)).ravel(), columns)]
    moved = (force_n[:, loaded].reshape(len(paths), -1) @ matrix.T).reshape(len(paths), -1, 3)
    gap = compute_gaps(
        obstacles, full.nodes[beside], sensor.dome_radius_mm, paths.stimulus, pose, moved
    )
    return beyond | (np.min(gap, axis=1) < -PENETRATION_MM)


@lru_cache(maxsize=4)
def _find_neighbours(sensor: Sensor) -> np.ndarray:
    """(N, N) bool: pairs of neighbouring contact nodes."""
    nodes = load_shared_dome(sensor).nodes
    return np.linalg.norm(
        nodes[:, None] - nodes[None], axis=-1
    ) < NEIGHBOURS * compute_ring_spacing(sensor)


@partial(jax.jit, static_argnames=("tolerance", "limit", "tilted", "strong", "solver"))
def _run(
    system: System,
    obstacles: Obstacles,
    which: jax.Array,
    friction: jax.Array,
    path: jax.Array,
    steps: jax.Array,
    force: jax.Array,
    tolerance: float,
    limit: int,
    tilted: bool,
    strong: float | None,
    solver: Callable[..., SolverResult] | None,
) -> tuple[Skin, Quality, tuple[jax.Array, jax.Array, jax.Array]]:
    count = len(which)
    skin = make_undeformed_skins(system, path[0])
    displacement = matmul(force.reshape(count, -1), system.spread).reshape(count, -1, 3)
    skin = skin._replace(force=force, displacement=displacement)
    skin, quality = follow_path(
        system,
        obstacles,
        which,
        friction,
        path[1:],
        skin,
        tolerance,
        limit,
        tilted,
        steps,
        strong,
        solver,
    )
    return skin, quality, count_node_states(skin, friction, tilted)
