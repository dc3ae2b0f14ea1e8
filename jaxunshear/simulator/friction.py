"""Quasi-static contact with Coulomb friction along a path, for B scenes at once.

At every increment the nodal forces f = (t, p) satisfy: no penetration, no pull, |t| <= mu p, and t
opposes the slip of this increment. With u = W f and a gap g that is linear in u this is a fixed
point f = P(f - (W f + b)), where P cuts p at zero and then t to the disk of radius mu p (Alart &
Curnier 1991). `contact_problem` holds the equation, `admm` solves it. W is scaled to a unit mean
diagonal. Without friction the unknowns are p alone. Read `follow_path` first.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxunshear.simulator.admm import Solver, SolverStart
from jaxunshear.simulator.contact_problem import RHO, ContactProblem, Increment, Quality, Skin
from jaxunshear.simulator.paths import (
    DEPTH,
    YAW,
    compute_increment_length,
    rotate,
    rotate_back,
    rotate_in_plane,
    transform_to_level,
    transpose,
)
from jaxunshear.simulator.stimuli import compute_surface_drop

PASSES = 2
FIRST_PASS = 2.0  # times the tolerance is enough before the last pass: a quarter fewer iterations
MAX_GAP_MM = 5.0  # larger gaps of free nodes would drown the others in rounding
# the length of an increment that its tolerance is relative to, for pauses and for long presses
LEAST_MM, MOST_MM = 0.05, 0.5


class _PathState(NamedTuple):
    number: Array  # () of the increment
    skin: Skin
    worst: Quality


def follow_path(
    problem: ContactProblem,
    path: Float[Array, "T B 6"],
    skin: Skin,
    solver: Solver,
    steps: Int[Array, ""] | None = None,
) -> tuple[Skin, Quality]:
    """Move B skins along a path of poses in the target frame, and report the worst increment.

    A pose is x, y (mm), yaw (rad), depth (mm), tilt_x, tilt_y (rad). `steps`, at most T, may say
    how many of the poses count, without compiling anew.
    """

    def step(state: _PathState) -> _PathState:
        number, skin, worst = state
        # written so that a NaN counts as failed
        failed = ~(worst.residual_mm <= worst.tolerance_mm)
        skin, now = advance_increment(problem, skin, path[number], solver, failed)
        return _PathState(number + 1, skin, _choose_worse(now, worst))

    last = jnp.asarray(len(path) if steps is None else steps, jnp.int32)
    none = jnp.zeros(path.shape[1], path.dtype)
    quality = Quality(none, none + solver.tolerance * LEAST_MM, jnp.zeros(path.shape[1], jnp.int32))
    state = jax.lax.while_loop(
        lambda state: state.number < last, step, _PathState(jnp.zeros((), jnp.int32), skin, quality)
    )
    return state.skin, state.worst


def _choose_worse(now: Quality, worst: Quality) -> Quality:
    """Choose, scene by scene, the larger residual relative to its tolerance; sum iterations."""
    # written so that a NaN counts as the worst
    worse = ~(now.residual_mm * worst.tolerance_mm <= worst.residual_mm * now.tolerance_mm)
    return Quality(
        jnp.where(worse, now.residual_mm, worst.residual_mm),
        jnp.where(worse, now.tolerance_mm, worst.tolerance_mm),
        worst.iterations + now.iterations,
    )


def advance_increment(
    problem: ContactProblem,
    skin: Skin,
    pose: Float[Array, "B 6"],
    solver: Solver,
    failed: Bool[Array, "B"] | bool = False,
) -> tuple[Skin, Quality]:
    """Move B skins by one increment, to `pose`; a skin that does not move is left as it is.

    Scenes that `failed`, by an increment that did not converge, are no longer waited for. The
    increment is solved PASSES times, first with gaps where the nodes were, then with gaps where
    they came to lie.
    """
    length = compute_increment_length(skin.pose, pose, problem.system.centre_mm / 4)
    moving = jnp.any(pose != skin.pose, axis=-1)
    goal = (solver.tolerance * jnp.clip(length, LEAST_MM, MOST_MM)).astype(skin.force.dtype)
    tolerance = jnp.where(moving & ~jnp.asarray(failed), goal, jnp.inf)
    frame = problem.compute_frame(pose)
    force, dual = rotate(frame, skin.force), rotate(frame, skin.dual)
    displacement = skin.displacement
    iterations = jnp.zeros(len(problem.friction), jnp.int32)
    for factor in [FIRST_PASS] * (PASSES - 1) + [1.0]:
        increment = make_increment(problem, skin, pose, displacement)
        start = _make_warm_start(increment, force, dual, displacement)
        force, dual, residual, spent = solver.solve(increment, start, factor * tolerance)
        displacement = problem.system.displace(rotate_back(frame, force))
        iterations = iterations + spent
    back = transpose(frame)
    after = Skin(rotate(back, force), rotate(back, dual), displacement, pose)
    return move_skins(skin, moving, after), Quality(
        jnp.where(moving, residual, 0), goal, iterations
    )


def make_increment(
    problem: ContactProblem,
    skin: Skin,
    pose: Float[Array, "B 6"],
    displacement: Float[Array, "B N 3"],
) -> Increment:
    """Make the equation of the increment from `skin` to a pose.

    Its offset, in mm in the level frame of that pose, is how far each node slips if the skin keeps
    its shape, and its gap. The gap is taken where `displacement` puts the node: that of `skin` to
    begin with, then that of a first solution. At a shape's edge a node that slides by a step
    changes its gap by half of that.
    """
    system = problem.system
    frame = problem.compute_frame(pose)

    def transform_to_target(displaced: Array) -> Array:
        level = transform_to_level(frame, displaced, system.centre_mm)
        return rotate_in_plane(pose[:, YAW], level[..., :2]) + pose[:, None, :2]

    place = system.nodes[None] + skin.displacement
    rest = jnp.broadcast_to(system.nodes, place.shape)
    rest_height = transform_to_level(frame, rest, system.centre_mm)[..., 2]
    drop = compute_surface_drop(
        problem.obstacles,
        problem.obstacle_index,
        transform_to_target(system.nodes[None] + displacement),
    )
    height = jnp.minimum(rest_height - pose[:, DEPTH, None] + drop, MAX_GAP_MM)
    if skin.force.shape[-1] == 1:
        offset = height[..., None]
    else:
        level_before = transform_to_level(problem.compute_frame(skin.pose), place, system.centre_mm)
        before = rotate_in_plane(skin.pose[:, YAW], level_before[..., :2]) + skin.pose[:, None, :2]
        slip = rotate_in_plane(-pose[:, YAW], transform_to_target(place) - before)
        moved = rotate(frame, skin.displacement)
        offset = jnp.concatenate([slip - moved[..., :2], height[..., None]], axis=-1)
    return Increment(
        system.w, system.inverse, frame, offset, problem.friction, problem.max_touching
    )


def _make_warm_start(
    increment: Increment, force: Array, dual: Array, displacement: Array
) -> SolverStart:
    """Start from the force and dual before, but with a new dual for each free node.

    The dual of a free node follows from its gap; carried over, it takes most iterations to forget.
    """
    moved = rotate(increment.frame, displacement)[..., -force.shape[-1] :]
    free_dual = -(moved + increment.offset) / RHO
    return SolverStart(force, jnp.where(force[..., -1:] > 0, dual, free_dual), moved)


def move_skins(before: Skin, moving: Bool[Array, "B"], after: Skin) -> Skin:
    """Replace the skins of the scenes that move; every skin is then at the pose of `after`."""
    keep = moving[:, None, None]
    return Skin(
        jnp.where(keep, after.force, before.force),
        jnp.where(keep, after.dual, before.dual),
        jnp.where(keep, after.displacement, before.displacement),
        after.pose,
    )
