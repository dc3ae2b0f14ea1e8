"""Quasi-static contact with Coulomb friction along a path, for B scenes at once.

At every increment the nodal forces f = (t, p) satisfy: no penetration, no pull, |t| <= mu p, and t
opposes the slip of this increment. With u = W f and a gap g that is linear in u this is a fixed
point f = P(f - (W f + b)), where P cuts p at zero and then t to the disk of radius mu p (Alart &
Curnier 1991). `contact_problem` holds the equation. W is scaled to a unit mean diagonal. Without
friction the unknowns are p alone. Read `follow_path` first.

ADMM solves an increment. It needs one precomputed inverse, (W + RHO I)^-1, and is over-relaxed
(under-relaxed at strong friction): each iteration is one matrix product for the entire batch.

We stop on a length. ADMM has two residuals in mm: W (x - z), by which the elastic forces x and the
admissible ones z move the skin differently, and rho (z - z_before). Both are compared with the
length of the increment. A residual relative to the forces would let small warm-started steps stop
without moving. One in the forces themselves would pass over a small pull on every node, which moves
the entire skin by a hundred times more than the same pull on one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxunshear.simulator.contact_problem import (
    RHO,
    ContactProblem,
    Increment,
    Quality,
    Skin,
    project,
)
from jaxunshear.simulator.level import STRONG_FRICTION
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
OVER_RELAXATION = 1.8
BETWEEN_CHECKS = 5
# At STRONG_FRICTION and above, the same tolerance leaves larger errors: for the first PATIENCE
# iterations we aim at this share of it, which some scenes do not reach.
STRICTER, PATIENCE = 0.5, 100


class SolverStart(NamedTuple):
    """A warm start of a solver, in the level frame, each (B, N, d)."""

    force: Array
    dual: Array
    displacement: Array  # W f


class SolverResult(NamedTuple):
    """What a solver returns for one increment."""

    force: Array  # (B, N, d)
    dual: Array  # (B, N, d)
    residual_mm: Array  # (B,)
    iterations: Array  # (B,)


# increment, start, tolerance (B,) mm, limit of iterations -> result
Method = Callable[[Increment, SolverStart, Array, int], SolverResult]


@dataclass(frozen=True)
class Solver:
    """How exactly each increment is solved; static under jit.

    An increment stops below `tolerance` times its own length, or after `limit` iterations.
    `strong_friction` is the relaxation of scenes whose friction exceeds STRONG_FRICTION, None that
    of all scenes. `method` replaces ADMM.
    """

    tolerance: float
    limit: int
    strong_friction: float | None = None
    method: Method | None = None

    def solve(self, increment: Increment, start: SolverStart, tolerance_mm: Array) -> SolverResult:
        """Solve an increment until every scene is below its tolerance (B,).

        Scenes with an infinite tolerance are not waited for.
        """
        if self.method is not None:
            return self.method(increment, start, tolerance_mm, self.limit)
        relaxation: Array | float = OVER_RELAXATION
        strong = None
        if self.strong_friction is not None:
            strong = increment.friction > STRONG_FRICTION
            relaxation = jnp.where(strong, self.strong_friction, relaxation)[:, None, None]
        admm = _Admm(increment, tolerance_mm, self.limit, relaxation, strong)
        state = jax.lax.while_loop(admm.is_running, admm.advance, admm.start(start))
        return SolverResult(
            state.iterates.force, state.iterates.dual, state.residual_mm, state.iterations
        )


class _Iterates(NamedTuple):
    force: Array  # z, admissible
    dual: Array  # y
    elastic: Array  # x
    force_before: Array


class _State(NamedTuple):
    iterates: _Iterates
    residual_mm: Array  # (B,)
    iterations: Array  # (B,)
    batch_iterations: Array  # ()


@dataclass(frozen=True)
class _Admm:
    """ADMM on one increment."""

    increment: Increment
    tolerance: Array  # (B,) mm
    limit: int
    relaxation: Array | float
    strong: Array | None  # (B,) scenes that take short steps; None: none does

    def start(self, start: SolverStart) -> _State:
        """Begin with residual 0 where the warm start is a solution, as where nothing touches."""
        force, dual, moved = start
        trial = project(force - moved - self.increment.offset, self.increment.friction)
        miss = jnp.max(jnp.abs(force - trial), axis=(1, 2))
        residual = jnp.where(miss > 0, jnp.inf, 0.0)
        residual = jnp.where(jnp.isinf(self.tolerance), 0.0, residual).astype(force.dtype)
        zero = jnp.zeros((), jnp.int32)
        iterations = jnp.zeros(residual.shape, jnp.int32)
        return _State(_Iterates(force, dual, force, force), residual, iterations, zero)

    def is_running(self, state: _State) -> Array:
        unsolved = state.residual_mm > self.compute_goal(state)
        return jnp.any(unsolved) & (state.batch_iterations < self.limit)

    def advance(self, state: _State) -> _State:
        """Iterate up to the next check."""
        before, goal = state.residual_mm, self.compute_goal(state)
        after = jax.lax.fori_loop(0, BETWEEN_CHECKS, self.iterate, state.iterates)
        residual = self.compute_residual(after)
        if self.strong is not None:
            # a scene that is done would leave the solution again while others are waited for
            done = self.strong & (before <= goal)
            after = jax.tree.map(
                lambda old, new: jnp.where(done[:, None, None], old, new), state.iterates, after
            )
            residual = jnp.where(done, before, residual)
        iterations = state.iterations + jnp.where(before > goal, BETWEEN_CHECKS, 0)
        return _State(after, residual, iterations, state.batch_iterations + BETWEEN_CHECKS)

    def iterate(self, _: Array, state: _Iterates) -> _Iterates:
        z, y = state.force, state.dual
        increment = self.increment
        x = increment.multiply(increment.inverse, RHO * (z - y) - increment.offset)
        relaxed = self.relaxation * x + (1 - self.relaxation) * z
        after = project(relaxed + y, increment.friction)
        return _Iterates(after, y + relaxed - after, x, z)

    def compute_residual(self, state: _Iterates) -> Array:
        """Compute ADMM's two residuals together, (B,) mm."""
        z = state.force
        miss = self.increment.displace(state.elastic - z)
        # of a short step as of a long one
        change = RHO * (OVER_RELAXATION / self.relaxation) * (z - state.force_before)
        touching = jnp.sum(z[..., -1] > 0, axis=-1, dtype=z.dtype)
        return jnp.sqrt(jnp.sum(miss**2 + change**2, axis=(1, 2)) / jnp.maximum(touching, 1))

    def compute_goal(self, state: _State) -> Array:
        """Compute the residual (B,) mm that is aimed at."""
        if self.strong is None:
            return self.tolerance
        return self.tolerance * jnp.where(
            self.strong & (state.batch_iterations < PATIENCE), STRICTER, 1.0
        )


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
    length = compute_increment_length(skin.pose, pose, problem.system.radius_mm / 4)
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
