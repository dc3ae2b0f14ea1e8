"""Planned batches of contacts, solved one by one.

A batch solves only the nodes that its scenes need. Afterwards we check that no node was needed that
was left out.
"""

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.config.reach import compute_ring_arcs, compute_ring_spacing
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.stimuli import Outline
from jaxunshear.progress import Progress
from jaxunshear.simulator.admm import SolverOptions
from jaxunshear.simulator.contact_problem import ContactProblem, Quality, Skin
from jaxunshear.simulator.contact_results import Contacts, Skins
from jaxunshear.simulator.friction import follow_path, make_undeformed_skins
from jaxunshear.simulator.harmonics import make_sixfold_permutations
from jaxunshear.simulator.level import STRONG_FRICTION, Level
from jaxunshear.simulator.node_state import NodeCounts, count_node_states
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
from jaxunshear.simulator.turned_lattice import place_on_lattice

# a node that was left out and ends deeper than this in the stimulus was needed
PENETRATION_MM = 0.03
NEIGHBOURS = 1.6  # ring spacings: a contact grows from node to neighbouring node

Stimuli = tuple[str | Outline | Stimulus, ...]


@dataclass(frozen=True)
class Simulation:
    """What all contacts of one call share."""

    sensor: Sensor
    stimuli: Stimuli
    level: Level
    batch: int  # scenes that are solved together, at most

    @property
    def obstacles(self) -> Obstacles:
        return sample_obstacles(self.stimuli)


class BatchResult(NamedTuple):
    contacts: Contacts
    skins: Skins
    incomplete: np.ndarray  # (B,) bool: nodes that were left out turn out to be needed


def sample_obstacles(names: Stimuli) -> Obstacles:
    """Sample the shapes as the contact sees them, once for each combination of shapes."""
    return _sample_obstacles(tuple(make_stimulus(name) for name in names))


@lru_cache(maxsize=16)  # 4 MiB a shape: all that have a name, one by one, and some drawn by hand
def _sample_obstacles(stimuli: tuple[Stimulus, ...]) -> Obstacles:
    return sample_distances(stimuli)


def plan_paths(
    sensor: Sensor,
    obstacles: Obstacles,
    paths: Paths,
    level: Level,
    batch: int,
    wide_margin: bool = False,
) -> list[ContactBatch]:
    """Plan what each batch solves for; `wide_margin` includes more nodes about the contact."""
    nodes = load_shared_dome(sensor).nodes
    return make_plan(obstacles, nodes, sensor.dome_radius_mm, paths, level, batch, wide_margin)


def solve_batches(
    simulation: Simulation,
    paths: Paths,
    start: Skins | None,
    progress: Progress | None,
    wide: bool,
) -> BatchResult:
    """Solve B paths batch by batch, and return contacts and skins at their ends in order.

    `wide` solves for more nodes, for paths that turned out to need them.
    """
    sensor, level = simulation.sensor, simulation.level
    parts = plan_paths(sensor, simulation.obstacles, paths, level, simulation.batch, wide)
    results = []
    for part in parts:
        before = None if start is None else start.take(part.rows)
        if before is not None:
            part = _add_loaded_nodes(part, before)
        here = paths.take(part.rows)
        if len(part.nodes):
            results.append(_solve_batch(simulation, here, part, before))
        else:
            results.append(_make_untouched_contacts(simulation, here))
        if progress is not None:
            progress.advance(len(part.rows))
    back = np.argsort(np.concatenate([part.rows for part in parts]), kind="stable")
    merged: BatchResult = jax.tree.map(lambda *arrays: np.concatenate(arrays)[back], *results)
    return merged


def _add_loaded_nodes(part: ContactBatch, start: Skins) -> ContactBatch:
    """Let a batch also solve for the nodes that carry a force at its start."""
    permutations = make_sixfold_permutations(start.force_n.shape[1])
    loaded = [
        np.flatnonzero(np.any(force[permutations[sixth]] != 0, axis=-1))
        for sixth, force in zip(part.turn, start.force_n, strict=True)
    ]
    friction = part.friction or bool(np.any(start.force_n[..., :2]))
    nodes = np.union1d(part.nodes, np.concatenate(loaded)).astype(int)
    return part._replace(nodes=nodes, friction=friction)


def make_undeformed_contacts(sensor: Sensor, paths: Paths, level: Level) -> tuple[Contacts, Skins]:
    """Make the contacts and skins of an undeformed dome, as converged."""
    count, full = len(paths), load_shared_dome(sensor)
    zeros = np.zeros(count, np.int64)
    contacts = Contacts(
        pins=np.repeat(full.pins[None].astype(level.precision), count, axis=0),
        residual_mm=np.zeros(count),
        converged=np.ones(count, bool),
        iterations=zeros,
        stuck_nodes=zeros,
        slipping_nodes=zeros,
        free_nodes=np.full(count, len(full.nodes)),
        force_n=np.zeros((count, 3)),
        nodes=zeros,
        retried=np.zeros(count, bool),
    )
    return contacts, Skins(np.zeros((count, len(full.nodes), 3)), paths.points[:, -1])


def _make_untouched_contacts(simulation: Simulation, paths: Paths) -> BatchResult:
    """Make undeformed contacts for paths that seemed to need no node.

    A path that ends inside the stimulus shows that it needs some: a grazing touch.
    """
    sensor = simulation.sensor
    nodes, pose = load_shared_dome(sensor).nodes, paths.radians[:, -1]
    still = np.zeros((len(paths), *nodes.shape))
    gap = compute_gaps(
        simulation.obstacles, nodes, sensor.dome_radius_mm, paths.stimulus, pose, still
    )
    contacts, skins = make_undeformed_contacts(sensor, paths, simulation.level)
    return BatchResult(contacts, skins, np.min(gap, axis=1) < -PENETRATION_MM)


class _EndState(NamedTuple):
    """Padded skins at the ends of their paths."""

    skin: Skin
    quality: Quality
    counts: NodeCounts


class _SolvedBatch(NamedTuple):
    """The solution of one batch on its turned lattice, without its padding."""

    force_n: np.ndarray  # (b, n, 3)
    residual_mm: np.ndarray  # (b,) as the others
    tolerance_mm: np.ndarray
    iterations: np.ndarray
    stuck: np.ndarray
    slipping: np.ndarray


def _solve_batch(
    simulation: Simulation, paths: Paths, part: ContactBatch, start: Skins | None
) -> BatchResult:
    sensor, level = simulation.sensor, simulation.level
    count, nodes = len(paths), len(load_shared_dome(sensor).nodes)
    placement = place_on_lattice(part.turn, part.nodes, nodes)
    poses, _ = cut_increments(paths, level, sensor.dome_radius_mm)
    poses[..., YAW] += np.radians(60.0 * part.turn)[:, None]
    poses[..., TILT_X:] = np.einsum(
        "bji,btj->bti", placement.rotation[:, :2, :2], poses[..., TILT_X:]
    )
    force_n = None if start is None else placement.gather(start.force_n)
    solved = _solve_and_unpad(simulation, paths, part, poses, force_n)
    force_n = placement.scatter(solved.force_n, nodes)
    pins = _compute_pins(sensor, force_n, level.precision)
    solved_well = solved.residual_mm <= solved.tolerance_mm
    contacts = Contacts(
        pins=pins,
        residual_mm=solved.residual_mm,
        converged=solved_well & np.isfinite(pins).all(axis=(1, 2)),
        iterations=solved.iterations,
        stuck_nodes=solved.stuck,
        slipping_nodes=solved.slipping,
        free_nodes=nodes - solved.stuck - solved.slipping,
        force_n=force_n.sum(axis=1),
        nodes=np.full(count, len(part.nodes)),
        retried=np.zeros(count, bool),
    )
    incomplete = _needs_more_nodes(simulation, paths, part, poses[:, -1], solved.force_n)
    return BatchResult(contacts, Skins(force_n, paths.points[:, -1]), incomplete)


def _solve_and_unpad(
    simulation: Simulation,
    paths: Paths,
    part: ContactBatch,
    poses: np.ndarray,
    start_n: np.ndarray | None,
) -> _SolvedBatch:
    """Solve one batch from forces (b, n, 3), padded by repeats of its last scene."""
    level, count, used = simulation.level, len(paths), len(part.nodes)
    size = min(pad_count(count, BATCHES), max(simulation.batch, count))
    rows = np.minimum(np.arange(size), count - 1)
    length = pad_count(part.steps, PATH_LENGTHS)
    steps = np.minimum(np.arange(length + 1), poses.shape[1] - 1)
    strong = level.strong_friction if (paths.friction > STRONG_FRICTION).any() else None
    with jax.enable_x64(level.precision == "float64"):
        system, newtons = build_system(
            simulation.sensor,
            part.nodes.astype(np.int64).tobytes(),
            part.friction,
            level.precision,
        )
        unknowns = len(system.w) // len(system.nodes)
        force = np.zeros((size, len(system.nodes), unknowns))
        if start_n is not None:
            force[:, :used] = (start_n / newtons)[rows][..., 3 - unknowns :]
        problem = ContactProblem(
            system,
            simulation.obstacles,
            jnp.asarray(paths.stimulus[rows], jnp.int32),
            jnp.asarray(paths.friction[rows], level.precision),
            part.tilted,
        )
        skin, quality, counts = jax.device_get(
            _follow_from_force(
                problem,
                jnp.asarray(np.swapaxes(poses[rows][:, steps], 0, 1), level.precision),
                part.steps,
                jnp.asarray(force, level.precision),
                SolverOptions(level.tolerance, level.limit, strong, level.solver),
            )
        )
    force_n = np.zeros((count, used, 3))
    force_n[..., 3 - unknowns :] = skin.force[:count, :used] * newtons
    fields = (*quality, counts.stuck, counts.slipping)
    return _SolvedBatch(force_n, *(field[:count] for field in fields))


@partial(jax.jit, static_argnames="options")
def _follow_from_force(
    problem: ContactProblem,
    path: jax.Array,
    steps: jax.Array,
    force: jax.Array,
    options: SolverOptions,
) -> _EndState:
    """Follow a path (T + 1, B, 6) from skins under forces (B, N, d)."""
    skin = make_undeformed_skins(problem.system, path[0])
    skin = skin._replace(force=force, displacement=problem.system.displace(force))
    skin, quality = follow_path(problem, path[1:], skin, options, steps)
    return _EndState(skin, quality, count_node_states(skin, problem.friction, problem.tilted))


def _compute_pins(sensor: Sensor, force_n: np.ndarray, precision: str) -> np.ndarray:
    """Compute the displaced pin tips (B, P, 3) under forces (B, N, 3) on the contact nodes."""
    full = load_shared_dome(sensor)
    used = np.flatnonzero(np.any(force_n != 0, axis=(0, 2)))
    matrix = build_matrices(sensor, precision).g_transposed
    matrix = matrix.reshape(len(full.nodes), 3, -1)[used]
    moved = force_n[:, used].reshape(len(force_n), -1).astype(precision) @ matrix.reshape(
        -1, matrix.shape[-1]
    )
    return (full.pins + moved.reshape(len(force_n), -1, 3)).astype(precision)


def _needs_more_nodes(
    simulation: Simulation,
    paths: Paths,
    part: ContactBatch,
    pose: np.ndarray,
    force_n: np.ndarray,
) -> np.ndarray:
    """Find the scenes (B,) that need nodes that were left out.

    Their contact reaches the last ring, or a neighbour of a loaded node that was left out ends
    inside the stimulus.
    """
    sensor = simulation.sensor
    full = load_shared_dome(sensor)
    last_ring = part.nodes >= len(full.nodes) - 6 * (len(compute_ring_arcs(sensor)) - 1)
    beyond = np.any(force_n[:, last_ring] != 0, axis=(1, 2))
    loaded = np.flatnonzero(np.any(force_n != 0, axis=(0, 2)))
    near = np.any(_find_neighbours(sensor)[part.nodes[loaded]], axis=0)
    near[part.nodes] = False
    beside = np.flatnonzero(near)
    if not len(beside):
        return beyond
    rows = (3 * beside[:, None] + np.arange(3)).ravel()
    columns = (3 * part.nodes[loaded][:, None] + np.arange(3)).ravel()
    moved = force_n[:, loaded].reshape(len(paths), -1) @ full.w[np.ix_(rows, columns)].T
    gap = compute_gaps(
        simulation.obstacles,
        full.nodes[beside],
        sensor.dome_radius_mm,
        paths.stimulus,
        pose,
        moved.reshape(len(paths), -1, 3),
    )
    return beyond | (np.min(gap, axis=1) < -PENETRATION_MM)


@lru_cache(maxsize=4)
def _find_neighbours(sensor: Sensor) -> np.ndarray:
    """Find the pairs of neighbouring contact nodes, (N, N) bool."""
    nodes = load_shared_dome(sensor).nodes
    distance = np.linalg.norm(nodes[:, None] - nodes[None], axis=-1)
    return distance < NEIGHBOURS * compute_ring_spacing(sensor)
