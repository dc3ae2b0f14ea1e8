"""Quasi-static contact with Coulomb friction along a path, for B scenes at once.

At every increment the nodal forces f = (t, p) satisfy: no penetration, no pull, |t| <= mu p, and t
opposes the slip of this increment. With u = W f and a gap g that is linear in u this is a fixed
point f = P(f - (W f + b)), where P cuts p at zero and then t to the disk of radius mu p (Alart &
Curnier 1991). `admm` solves it. W is scaled to a unit mean diagonal. Without friction the unknowns
are p alone.

The level frame is the sensor frame with its tilt undone: there the stimulus' top is the plane
z = 0, and P is as above. Read `follow_path` first.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxunshear.simulator.admm import (
    RHO,
    Increment,
    Solver,
    SolverOptions,
    SolverStart,
    solve_increment,
)
from jaxunshear.simulator.contact_problem import ContactProblem, Quality, Skin, System
from jaxunshear.simulator.frame import (
    compute_increment_length,
    compute_level_frame,
    rotate,
    rotate_back,
    rotate_in_plane,
    transform_to_level,
)
from jaxunshear.simulator.obstacle import compute_surface_drop
from jaxunshear.simulator.paths import DEPTH, YAW

PASSES = 2
FIRST_PASS = 2.0  # times the tolerance is enough before the last pass: a quarter fewer iterations
MAX_GAP_MM = 5.0  # larger gaps of free nodes would drown the others in rounding
# the length of an increment that its tolerance is relative to, for pauses and for long presses
LEAST_MM, MOST_MM = 0.05, 0.5


def compute_increment_offset(
    problem: ContactProblem,
    skin: Skin,
    pose: Float[Array, "B 6"],
    displacement: Float[Array, "B N 3"],
) -> Float[Array, "B N d"]:
    """Compute the offset b of the increment from `skin` to a pose.

    b, in mm in the level frame of that pose, is how far each node slips if the skin keeps its
    shape, and its gap. The gap is taken where `displacement` puts the node: that of `skin` to begin
    with, then that of a first solution. At a shape's edge a node that slides by a step changes its
    gap by half of that.
    """
    system = problem.system
    frame = compute_level_frame(pose) if problem.tilted else None

    def transform_to_target(displaced: Array) -> Array:
        level = transform_to_level(frame, displaced, system.centre_mm)
        return rotate_in_plane(pose[:, YAW], level[..., :2]) + pose[:, None, :2]

    place = system.nodes[None] + skin.displacement
    rest_height = transform_to_level(
        frame, jnp.broadcast_to(system.nodes, place.shape), system.centre_mm
    )[..., 2]
    drop = compute_surface_drop(
        problem.obstacles,
        problem.obstacle_index,
        transform_to_target(system.nodes[None] + displacement),
    )
    height = jnp.minimum(rest_height - pose[:, DEPTH, None] + drop, MAX_GAP_MM)
    if skin.force.shape[-1] == 1:
        return height[..., None]
    level_before = transform_to_level(
        compute_level_frame(skin.pose) if problem.tilted else None, place, system.centre_mm
    )
    before = rotate_in_plane(skin.pose[:, YAW], level_before[..., :2]) + skin.pose[:, None, :2]
    slip = rotate_in_plane(-pose[:, YAW], transform_to_target(place) - before)
    moved = skin.displacement if frame is None else rotate(frame, skin.displacement)
    return jnp.concatenate([slip - moved[..., :2], height[..., None]], axis=-1)


def make_undeformed_skins(system: System, pose: Float[Array, "B 6"]) -> Skin:
    """Make B undeformed skins."""
    count, nodes = pose.shape[0], system.nodes.shape[0]
    force = jnp.zeros((count, nodes, len(system.w) // nodes), pose.dtype)
    return Skin(force, force, jnp.zeros((count, nodes, 3), pose.dtype), pose)


def advance_increment(
    problem: ContactProblem,
    skin: Skin,
    pose: Float[Array, "B 6"],
    options: SolverOptions,
    failed: Bool[Array, "B"] | bool = False,
) -> tuple[Skin, Quality]:
    """Move B skins by one increment, to `pose`; a skin that does not move is left as it is.

    Scenes that `failed`, by an increment that did not converge, are no longer waited for. The
    increment is solved PASSES times, first with gaps where the nodes were, then with gaps where
    they came to lie.
    """
    length = compute_increment_length(skin.pose, pose, problem.system.centre_mm / 4)
    moving = jnp.any(pose != skin.pose, axis=-1)
    goal = (options.tolerance * jnp.clip(length, LEAST_MM, MOST_MM)).astype(skin.force.dtype)
    tolerance = jnp.where(moving & ~jnp.asarray(failed), goal, jnp.inf)
    frame = compute_level_frame(pose) if problem.tilted else None
    force, dual, displacement = skin.force, skin.dual, skin.displacement
    if frame is not None:
        force, dual = rotate(frame, force), rotate(frame, dual)
    iterations = jnp.zeros(len(problem.friction), jnp.int32)
    for factor in [FIRST_PASS] * (PASSES - 1) + [1.0]:
        offset = compute_increment_offset(problem, skin, pose, displacement)
        increment = Increment(problem.system.w, frame, offset, problem.friction)
        force, dual, residual, spent = _choose_solver(options)(
            increment,
            problem.system.inverse,
            _make_warm_start(increment, force, dual, displacement),
            factor * tolerance,
            options.limit,
        )
        inside = force if frame is None else rotate_back(frame, force)
        displacement = problem.system.displace(inside)
        iterations = iterations + spent
    if frame is not None:
        back = jnp.swapaxes(frame, 1, 2)
        force, dual = rotate(back, force), rotate(back, dual)
    after = move_skins(skin, moving, Skin(force, dual, displacement, pose))
    return after, Quality(jnp.where(moving, residual, 0), goal, iterations)


def move_skins(before: Skin, moving: Bool[Array, "B"], after: Skin) -> Skin:
    """Replace the skins of the scenes that move; every skin is then at the pose of `after`."""
    keep = moving[:, None, None]
    return Skin(
        jnp.where(keep, after.force, before.force),
        jnp.where(keep, after.dual, before.dual),
        jnp.where(keep, after.displacement, before.displacement),
        after.pose,
    )


def _choose_solver(options: SolverOptions) -> Solver:
    if options.solver is not None:
        return options.solver
    return partial(solve_increment, strong_friction=options.strong_friction)


def _make_warm_start(
    increment: Increment, force: Array, dual: Array, displacement: Array
) -> SolverStart:
    """Start from the force and dual before, but with a new dual for each free node.

    The dual of a free node follows from its gap; carried over, it takes most iterations to forget.
    """
    level = displacement if increment.frame is None else rotate(increment.frame, displacement)
    moved = level[..., -force.shape[-1] :]
    free_dual = -(moved + increment.offset) / RHO
    return SolverStart(force, jnp.where(force[..., -1:] > 0, dual, free_dual), moved)


class _PathState(NamedTuple):
    number: Array  # () of the increment
    skin: Skin
    worst: Quality


def follow_path(
    problem: ContactProblem,
    path: Float[Array, "T B 6"],
    skin: Skin,
    options: SolverOptions,
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
        skin, now = advance_increment(problem, skin, path[number], options, failed)
        return _PathState(number + 1, skin, _choose_worse(now, worst))

    last = jnp.asarray(len(path) if steps is None else steps, jnp.int32)
    none = jnp.zeros(path.shape[1], path.dtype)
    quality = Quality(
        none, none + options.tolerance * LEAST_MM, jnp.zeros(path.shape[1], jnp.int32)
    )
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
