"""Planned batches of contacts, solved one by one.

A batch solves only the nodes that its scenes need. Afterwards we check that no node was needed that
was left out.
"""

from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.config.contact_rings import compute_ring_arcs, compute_ring_spacing
from jaxunshear.config.sensor import Sensor
from jaxunshear.progress import Counter
from jaxunshear.simulator.contact_problem import (
    ContactProblem,
    NodeCounts,
    Quality,
    Skin,
    count_node_states,
    make_undeformed_skins,
)
from jaxunshear.simulator.contacts import Contacts, Skins
from jaxunshear.simulator.dome import load_shared_dome
from jaxunshear.simulator.friction import Solver, follow_path
from jaxunshear.simulator.harmonics import make_sixfold_permutations
from jaxunshear.simulator.level import STRONG_FRICTION
from jaxunshear.simulator.paths import TILT_X, YAW, Paths, cut_increments
from jaxunshear.simulator.scheduler import (
    BATCHES,
    PATH_LENGTHS,
    ContactBatch,
    Simulation,
    compute_gaps,
    make_plan,
    pad_count,
)
from jaxunshear.simulator.systems import (
    LatticePlacement,
    build_matrices,
    build_system,
    place_on_lattice,
)

# a node that was left out and ends deeper than this in the stimulus was needed
PENETRATION_MM = 0.03
NEIGHBOURS = 1.6  # ring spacings: a contact grows from node to neighbouring node


class BatchResult(NamedTuple):
    contacts: Contacts
    skins: Skins
    incomplete: np.ndarray  # (B,) bool: nodes that were left out turn out to be needed


def solve_batches(
    simulation: Simulation,
    paths: Paths,
    start: Skins | None,
    progress: Counter | None = None,
    wide: bool = False,
) -> BatchResult:
    """Solve B paths batch by batch, and return contacts and skins at their ends in order.

    `wide` solves for more nodes, for paths that turned out to need them.
    """
    batches, results = make_plan(simulation, paths, wide), []
    for batch in batches:
        here = paths.take(batch.rows)
        before = None if start is None else start.take(batch.rows)
        if before is not None:
            batch = _add_loaded_nodes(batch, before)
        if len(batch.nodes):
            results.append(_solve_batch(simulation, here, batch, before))
        else:
            results.append(_make_untouched_contacts(simulation, here))
        if progress is not None:
            progress.advance(len(batch.rows))
    back = np.argsort(np.concatenate([batch.rows for batch in batches]), kind="stable")
    merged: BatchResult = jax.tree.map(lambda *arrays: np.concatenate(arrays)[back], *results)
    return merged


def _add_loaded_nodes(batch: ContactBatch, start: Skins) -> ContactBatch:
    """Let a batch also solve for the nodes that carry a force at its start."""
    permutations = make_sixfold_permutations(start.force_n.shape[1])
    loaded = [
        np.flatnonzero(np.any(force[permutations[sixth]] != 0, axis=-1))
        for sixth, force in zip(batch.turn, start.force_n, strict=True)
    ]
    friction = batch.friction or bool(np.any(start.force_n[..., :2]))
    nodes = np.union1d(batch.nodes, np.concatenate(loaded)).astype(int)
    return batch._replace(nodes=nodes, friction=friction)


def make_undeformed_contacts(simulation: Simulation, paths: Paths) -> tuple[Contacts, Skins]:
    """Make the contacts and skins of an undeformed dome, as converged."""
    count, dome = len(paths), simulation.dome
    zeros = np.zeros(count, np.int64)
    contacts = Contacts(
        pins=np.repeat(dome.pins[None].astype(simulation.level.precision), count, axis=0),
        residual_mm=np.zeros(count),
        converged=np.ones(count, bool),
        iterations=zeros,
        stuck_nodes=zeros,
        slipping_nodes=zeros,
        free_nodes=np.full(count, len(dome.nodes)),
        force_n=np.zeros((count, 3)),
        nodes=zeros,
        retried=np.zeros(count, bool),
    )
    return contacts, Skins(np.zeros((count, len(dome.nodes), 3)), paths.points[:, -1])


def _make_untouched_contacts(simulation: Simulation, paths: Paths) -> BatchResult:
    """Make undeformed contacts for paths that seemed to need no node.

    A path that ends inside the stimulus shows that it needs some: a grazing touch.
    """
    nodes = simulation.dome.nodes
    still = np.zeros((len(paths), *nodes.shape))
    gap = compute_gaps(simulation, nodes, paths.stimulus, paths.radians[:, -1], still)
    contacts, skins = make_undeformed_contacts(simulation, paths)
    return BatchResult(contacts, skins, np.min(gap, axis=1) < -PENETRATION_MM)


class _EndState(NamedTuple):
    """Skins at the ends of their paths."""

    skin: Skin
    quality: Quality
    counts: NodeCounts


def _solve_batch(
    simulation: Simulation, paths: Paths, batch: ContactBatch, start: Skins | None
) -> BatchResult:
    count, nodes = len(paths), len(simulation.dome.nodes)
    placement = place_on_lattice(batch, nodes)
    poses = _cut_on_lattice(simulation, paths, batch, placement)
    start_n = None if start is None else placement.gather(start.force_n)
    lattice_n, (_, quality, counts) = _solve_on_lattice(simulation, paths, batch, poses, start_n)
    force_n = placement.scatter(lattice_n, nodes)
    pins = _compute_pins(simulation, force_n)
    stuck, slipping = np.asarray(counts.stuck), np.asarray(counts.slipping)
    solved_well = np.asarray(quality.residual_mm <= quality.tolerance_mm)
    contacts = Contacts(
        pins=pins,
        residual_mm=np.asarray(quality.residual_mm),
        converged=solved_well & np.isfinite(pins).all(axis=(1, 2)),
        iterations=np.asarray(quality.iterations),
        stuck_nodes=stuck,
        slipping_nodes=slipping,
        free_nodes=nodes - stuck - slipping,
        force_n=force_n.sum(axis=1),
        nodes=np.full(count, len(batch.nodes)),
        retried=np.zeros(count, bool),
    )
    incomplete = _needs_more_nodes(simulation, paths, batch, poses[:, -1], lattice_n)
    return BatchResult(contacts, Skins(force_n, paths.points[:, -1]), incomplete)


def _cut_on_lattice(
    simulation: Simulation, paths: Paths, batch: ContactBatch, placement: LatticePlacement
) -> np.ndarray:
    """Cut paths into poses (b, T + 1, 6) of the turned lattice."""
    poses, _ = cut_increments(paths, simulation.level, simulation.sensor.radius_mm)
    poses[..., YAW] += np.radians(60.0 * batch.turn)[:, None]
    poses[..., TILT_X:] = np.einsum(
        "bji,btj->bti", placement.rotation[:, :2, :2], poses[..., TILT_X:]
    )
    return poses


def _solve_on_lattice(
    simulation: Simulation,
    paths: Paths,
    batch: ContactBatch,
    poses: np.ndarray,
    start_n: np.ndarray | None,
) -> tuple[np.ndarray, _EndState]:
    """Solve a batch from forces (b, n, 3), padded by repeats of its last scene.

    Returns forces (b, n, 3) at the end, and the end without its padding.
    """
    level, count, used = simulation.level, len(paths), len(batch.nodes)
    size = min(pad_count(count, BATCHES), max(simulation.batch, count))
    rows = np.minimum(np.arange(size), count - 1)
    length = pad_count(batch.steps, PATH_LENGTHS)
    steps = np.minimum(np.arange(length + 1), poses.shape[1] - 1)
    strong = level.strong_friction if (paths.friction > STRONG_FRICTION).any() else None
    with jax.enable_x64(level.precision == "float64"):
        as_array = partial(jnp.asarray, dtype=level.precision)
        node_bytes = batch.nodes.astype(np.int64).tobytes()
        system, newtons = build_system(
            simulation.sensor, node_bytes, batch.friction, level.precision
        )
        unknowns = len(system.w) // len(system.nodes)
        force = np.zeros((size, len(system.nodes), unknowns))
        if start_n is not None:
            force[:, :used] = (start_n / newtons)[rows][..., 3 - unknowns :]
        problem = ContactProblem(
            system,
            simulation.obstacles,
            jnp.asarray(paths.stimulus[rows], jnp.int32),
            as_array(paths.friction[rows]),
            batch.tilted,
        )
        end = jax.device_get(
            _follow_from_force(
                problem,
                as_array(np.swapaxes(poses[rows][:, steps], 0, 1)),
                batch.steps,
                as_array(force),
                Solver(level.tolerance, level.limit, strong, level.method),
            )
        )
    force_n = np.zeros((count, used, 3))
    force_n[..., 3 - unknowns :] = end.skin.force[:count, :used] * newtons
    return force_n, jax.tree.map(lambda field: field[:count], end)


@partial(jax.jit, static_argnames="solver")
def _follow_from_force(
    problem: ContactProblem, path: jax.Array, steps: jax.Array, force: jax.Array, solver: Solver
) -> _EndState:
    """Follow a path (T + 1, B, 6) from skins under forces (B, N, d)."""
    skin = make_undeformed_skins(problem.system, path[0])
    skin = skin._replace(force=force, displacement=problem.system.displace(force))
    skin, quality = follow_path(problem, path[1:], skin, solver, steps)
    return _EndState(skin, quality, count_node_states(problem, skin))


def _compute_pins(simulation: Simulation, force_n: np.ndarray) -> np.ndarray:
    """Compute the displaced pin tips (B, P, 3) under forces (B, N, 3) on the contact nodes."""
    dome, precision = simulation.dome, simulation.level.precision
    used = np.flatnonzero(np.any(force_n != 0, axis=(0, 2)))
    matrix = build_matrices(simulation.sensor, precision).g_transposed
    matrix = matrix.reshape(len(dome.nodes), 3, -1)[used]
    moved = force_n[:, used].reshape(len(force_n), -1).astype(precision) @ matrix.reshape(
        -1, matrix.shape[-1]
    )
    return (dome.pins + moved.reshape(len(force_n), -1, 3)).astype(precision)


def _needs_more_nodes(
    simulation: Simulation, paths: Paths, batch: ContactBatch, pose: np.ndarray, force_n: np.ndarray
) -> np.ndarray:
    """Find the scenes (B,) that need nodes that were left out.

    Their contact reaches the last ring of a dome, or a neighbour of a loaded node that was left out
    ends inside the stimulus.
    """
    sensor, dome = simulation.sensor, simulation.dome
    last_ring = batch.nodes >= len(dome.nodes) - 6 * (len(compute_ring_arcs(sensor)) - 1)
    # the last ring of a pad is at its rim, and nothing touches beyond
    beyond = np.any(force_n[:, last_ring] != 0, axis=(1, 2)) & (not sensor.is_flat)
    loaded = np.flatnonzero(np.any(force_n != 0, axis=(0, 2)))
    near = np.any(_find_neighbours(sensor)[batch.nodes[loaded]], axis=0)
    near[batch.nodes] = False
    beside = np.flatnonzero(near)
    if not len(beside):
        return beyond
    rows = (3 * beside[:, None] + np.arange(3)).ravel()
    columns = (3 * batch.nodes[loaded][:, None] + np.arange(3)).ravel()
    moved = force_n[:, loaded].reshape(len(paths), -1) @ dome.w[np.ix_(rows, columns)].T
    gap = compute_gaps(
        simulation, dome.nodes[beside], paths.stimulus, pose, moved.reshape(len(paths), -1, 3)
    )
    return beyond | (np.min(gap, axis=1) < -PENETRATION_MM)


@lru_cache(maxsize=4)
def _find_neighbours(sensor: Sensor) -> np.ndarray:
    """Find the pairs of neighbouring contact nodes, (N, N) bool."""
    nodes = load_shared_dome(sensor).nodes
    distance = np.linalg.norm(nodes[:, None] - nodes[None], axis=-1)
    return distance < NEIGHBOURS * compute_ring_spacing(sensor)
