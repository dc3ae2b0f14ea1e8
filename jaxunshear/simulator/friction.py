"""Quasi-static contact with Coulomb friction along a path, for a batch of scenes that share one compliance.

At every increment the nodal forces f = (t, p) answer: no penetration, no pull, |t| <= mu p, and t opposes the slip of this
increment. With u = W f and a gap g that is linear in u this is a fixed point f = P(f - (W f + b)), where P cuts p at zero
and then t to the disk of radius mu p (Alart & Curnier 1991). It is found by ADMM with one precomputed inverse,
(W + rho I)^-1, over-relaxed (under-relaxed at strong friction): each iteration is one matrix product for the entire batch.
W is scaled to a unit mean diagonal. Without friction the unknowns are p alone.

We stop on a length: ADMM's two residuals, W (x - z), by which the elastic forces x and the admissible ones z move the skin
differently, and rho (z - z_before), both in mm, against the length of the increment. A residual relative to the forces would
let small warm-started steps stop without moving; one in the forces themselves would pass over a small pull on every node,
which moves the entire skin by a hundred times more than the same pull on one.

The level frame is the sensor frame with its tilt undone: there the stimulus' top is the plane z = 0, and P is as above.
Read `follow_path` first; `solve_increment` is the solver.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxunshear.simulator.frame import (
    compute_increment_length,
    compute_level_frame,
    matmul,
    rotate,
    rotate_back,
    rotate_in_plane,
    transform_to_level,
)
from jaxunshear.simulator.level import STRONG_FRICTION
from jaxunshear.simulator.obstacle import Obstacles, compute_surface_drop
from jaxunshear.simulator.paths import DEPTH, YAW

OVER_RELAXATION = 1.8
RHO = 12.0
BETWEEN_CHECKS = 5
PASSES = 2
FIRST_PASS = 2.0  # of the tolerance is enough for all but the last pass: a quarter fewer iterations
# Where friction is STRONG the same tolerance leaves larger errors: half of it is aimed at first, which some scenes do not reach.
STRICTER, PATIENCE = 0.5, 100
MAX_GAP_MM = 5.0  # gaps count no further: a hundred millimetres on a free node would drown the others in rounding
LEAST_MM, MOST_MM = (
    0.05,
    0.5,
)  # an increment's length for its tolerance: pauses and long presses are judged sensibly


class System(NamedTuple):
    """What a batch shares, for d = 3 unknowns of a node, or d = 1 (pressure only) where no scene has friction.

    `w` and `inverse` = (w + RHO)^-1 (dN, dN) are scaled to a unit mean diagonal of w; `spread` (dN, 3N) moves the nodes in all
    directions (w itself where d = 3); `nodes` (N, 3) mm; `centre_mm`: height of the dome's centre above its apex.
    """

    w: Array
    inverse: Array
    spread: Array
    nodes: Array
    centre_mm: Array


class Skin(NamedTuple):
    """State of B skins after a motion, in the sensor frame: all that a later motion needs to continue."""

    force: Array  # (B, N, d) scaled, mm
    dual: Array  # (B, N, d) of the solver, a warm start only
    displacement: Array  # (B, N, 3) mm
    pose: Array  # (B, 6) x, y (mm), yaw (rad), depth (mm), tilt_x, tilt_y (rad)


class Quality(NamedTuple):
    """How good the worst increment was: residual (B,) mm, its tolerance (B,) mm, iterations (B,) summed over the path."""

    residual_mm: Array
    tolerance_mm: Array
    iterations: Array


# what a solver of increments gives: force, dual, residual mm and iterations
SolverResult = tuple[
    Float[Array, "B N d"], Float[Array, "B N d"], Float[Array, "B"], Int[Array, "B"]
]
_Iterates = tuple[Array, Array, Array, Array]  # z, its dual, x, and z before
_Solving = tuple[
    _Iterates, Array, Array, Array
]  # with residual (B,), iterations (B,), and the count of them


def project(force: Float[Array, "B N d"], friction: Float[Array, "B"]) -> Float[Array, "B N d"]:
    """Cut to p >= 0 and |t| <= friction * p; friction infinite for pure stick."""
    normal = jnp.maximum(force[..., -1:], 0)
    if force.shape[-1] == 1:
        return normal
    tangential = force[..., :2]
    squared = jnp.sum(tangential**2, axis=-1, keepdims=True)
    sticks = jnp.isinf(friction)[:, None, None]
    limit = jnp.where(sticks, 0, friction[:, None, None]) * normal
    cut = limit * jax.lax.rsqrt(jnp.maximum(squared, 1e-30))
    shrink = jnp.where(
        sticks, jnp.where(normal > 0, 1.0, 0.0), jnp.where(squared > limit**2, cut, 1.0)
    )
    return jnp.concatenate([tangential * shrink.astype(force.dtype), normal], axis=-1)


def _times(matrix: Array, force: Array, frame: Array | None) -> Array:
    """matrix . force with both in the level frame (the matrix, symmetric, in the sensor frame)."""
    inside = force if frame is None else rotate_back(frame, force)
    moved = matmul(inside.reshape(force.shape[0], -1), matrix).reshape(force.shape)
    return moved if frame is None else rotate(frame, moved)


def solve_increment(
    system: System,
    frame: Float[Array, "B 3 3"] | None,
    offset: Float[Array, "B N d"],
    friction: Float[Array, "B"],
    start: tuple[Float[Array, "B N d"], Float[Array, "B N d"], Float[Array, "B N d"]],
    tolerance: Float[Array, "B"],
    limit: int,
    strong_friction: float | None = None,
) -> SolverResult:
    """Forces of f = P(f - (W f + b)) with offset b, from a warm start (force f, dual, W f).

    Iterates until every scene is below its tolerance in mm, or `limit` iterations. Returns force, dual, residual in mm and
    iterations. Scenes with an infinite tolerance are not waited for. `strong_friction`: the relaxation of scenes whose friction is above STRONG;
    None: that of all.
    """
    hard = friction > STRONG_FRICTION
    share = (
        OVER_RELAXATION
        if strong_friction is None
        else jnp.where(hard, strong_friction, OVER_RELAXATION)[:, None, None]
    )

    def iterate(_: Array, state: _Iterates) -> _Iterates:
        z, y, _, _ = state
        x = _times(system.inverse, RHO * (z - y) - offset, frame)
        relaxed = share * x + (1 - share) * z
        after = project(relaxed + y, friction)
        return after, y + relaxed - after, x, z

    def error(state: _Iterates) -> Array:
        z, _, x, before = state
        apart = _times(system.w, x - z, frame)
        change = RHO * (OVER_RELAXATION / share) * (z - before)  # of a short step as of a long one
        touching = jnp.sum(z[..., -1] > 0, axis=-1, dtype=z.dtype)
        return jnp.sqrt(jnp.sum(apart**2 + change**2, axis=(1, 2)) / jnp.maximum(touching, 1))

    def aim(count: Array) -> Array:
        return (
            tolerance
            if strong_friction is None
            else tolerance * jnp.where(hard & (count < PATIENCE), STRICTER, 1.0)
        )

    def is_unfinished(state: _Solving) -> Array:
        _, error, _, count = state
        return jnp.any(error > aim(count)) & (count < limit)

    def step(state: _Solving) -> _Solving:
        inner, before, spent, count = state
        after = jax.lax.fori_loop(0, BETWEEN_CHECKS, iterate, inner)
        now = error(after)
        if strong_friction is not None:
            done = hard & (
                before <= aim(count)
            )  # and would leave the solution again, while others are waited for
            after = jax.tree.map(
                lambda old, new: jnp.where(done[:, None, None], old, new), inner, after
            )
            now = jnp.where(done, before, now)
        return (
            after,
            now,
            spent + jnp.where(before > aim(count), BETWEEN_CHECKS, 0),
            count + BETWEEN_CHECKS,
        )

    # what holds already, as where nothing touches, needs no iteration
    force, dual, moved = start
    miss = jnp.max(jnp.abs(force - project(force - moved - offset, friction)), axis=(1, 2))
    missing = jnp.where(miss > 0, jnp.inf, 0.0)
    missing = jnp.where(jnp.isinf(tolerance), 0.0, missing).astype(force.dtype)
    zero = jnp.zeros((), jnp.int32)
    state = ((force, dual, force, force), missing, jnp.zeros(missing.shape, jnp.int32), zero)
    (z, y, _, _), missing, spent, _ = jax.lax.while_loop(is_unfinished, step, state)
    return z, y, missing, spent


def compute_increment_offset(
    system: System,
    obstacles: Obstacles,
    which: Int[Array, "B"],
    skin: Skin,
    pose: Float[Array, "B 6"],
    tilted: bool,
    displacement: Float[Array, "B N 3"],
) -> Float[Array, "B N d"]:
    """Offset b in mm of the increment from `skin` to a pose, in the level frame there.

    How far each node slips if the skin keeps its shape, and its gap, taken where `displacement` puts the node: that
    of `skin` to begin with, then that of a first answer. At a shape's edge a node that slides by a step changes its gap
    by half of that.
    """
    frame = compute_level_frame(pose) if tilted else None

    def in_target_frame(displaced: Array) -> Array:
        return (
            rotate_in_plane(
                pose[:, YAW], transform_to_level(frame, displaced, system.centre_mm)[..., :2]
            )
            + pose[:, None, :2]
        )

    place = system.nodes[None] + skin.displacement
    rest_height = transform_to_level(
        frame, jnp.broadcast_to(system.nodes, place.shape), system.centre_mm
    )[..., 2]
    fall = compute_surface_drop(
        obstacles, which, in_target_frame(system.nodes[None] + displacement)
    )
    height = jnp.minimum(rest_height - pose[:, DEPTH, None] + fall, MAX_GAP_MM)
    if skin.force.shape[-1] == 1:
        return height[..., None]
    level_before = transform_to_level(
        compute_level_frame(skin.pose) if tilted else None, place, system.centre_mm
    )
    before = rotate_in_plane(skin.pose[:, YAW], level_before[..., :2]) + skin.pose[:, None, :2]
    slip = rotate_in_plane(-pose[:, YAW], in_target_frame(place) - before)
    moved = skin.displacement if frame is None else rotate(frame, skin.displacement)
    return jnp.concatenate([slip - moved[..., :2], height[..., None]], axis=-1)


def make_undeformed_skins(system: System, pose: Float[Array, "B 6"]) -> Skin:
    """B undeformed skins."""
    count, nodes = pose.shape[0], system.nodes.shape[0]
    force = jnp.zeros((count, nodes, len(system.w) // nodes), pose.dtype)
    return Skin(force, force, jnp.zeros((count, nodes, 3), pose.dtype), pose)


def advance_increment(
    system: System,
    obstacles: Obstacles,
    which: Int[Array, "B"],
    friction: Float[Array, "B"],
    pose: Float[Array, "B 6"],
    skin: Skin,
    tolerance: float,
    limit: int,
    tilted: bool,
    failed: Bool[Array, "B"] | bool = False,
    strong_friction: float | None = None,
    solver: Callable[..., SolverResult] | None = None,
) -> tuple[Skin, Quality]:
    """Move B skins by one increment, to `pose`; a skin that does not move is left as it is.

    Those `failed`, by an increment that did not converge, are no longer waited for. Solved PASSES times, the first time with
    gaps where the nodes were, then with gaps where they came to lie.
    """
    length = compute_increment_length(skin.pose, pose, system.centre_mm / 4)
    moving = jnp.any(pose != skin.pose, axis=-1)
    goal = (tolerance * jnp.clip(length, LEAST_MM, MOST_MM)).astype(skin.force.dtype)
    wanted = jnp.where(moving & ~jnp.asarray(failed), goal, jnp.inf)
    frame = compute_level_frame(pose) if tilted else None
    force, dual, displacement = skin.force, skin.dual, skin.displacement
    if frame is not None:
        force, dual = rotate(frame, force), rotate(frame, dual)
    solve = partial(solve_increment, strong_friction=strong_friction) if solver is None else solver
    count = jnp.zeros(len(which), jnp.int32)
    for allowed in [FIRST_PASS] * (PASSES - 1) + [1.0]:
        offset = compute_increment_offset(
            system, obstacles, which, skin, pose, tilted, displacement
        )
        # a free node's dual follows from the gap; carried over, it is what takes most iterations to forget
        moved = (displacement if frame is None else rotate(frame, displacement))[
            ..., -force.shape[-1] :
        ]
        start = (force, jnp.where(force[..., -1:] > 0, dual, -(moved + offset) / RHO), moved)
        force, dual, error, spent = solve(
            system, frame, offset, friction, start, allowed * wanted, limit
        )
        inside = force if frame is None else rotate_back(frame, force)
        displacement = matmul(inside.reshape(force.shape[0], -1), system.spread).reshape(
            skin.displacement.shape
        )
        count = count + spent
    if frame is not None:
        back = jnp.swapaxes(frame, 1, 2)
        force, dual = rotate(back, force), rotate(back, dual)
    keep = moving[:, None, None]
    after = Skin(
        jnp.where(keep, force, skin.force),
        jnp.where(keep, dual, skin.dual),
        jnp.where(keep, displacement, skin.displacement),
        pose,
    )
    return after, Quality(jnp.where(moving, error, 0), goal, count)


def follow_path(
    system: System,
    obstacles: Obstacles,
    which: Int[Array, "B"],
    friction: Float[Array, "B"],
    path: Float[Array, "T B 6"],
    skin: Skin,
    tolerance: float,
    limit: int,
    tilted: bool = False,
    steps: Int[Array, ""] | None = None,
    strong_friction: float | None = None,
    solver: Callable[..., SolverResult] | None = None,
) -> tuple[Skin, Quality]:
    """Move B skins along a path of poses x, y (mm), yaw (rad), depth (mm), tilt_x, tilt_y (rad) in the target frame.

    `which` indexes the obstacles; an increment stops below `tolerance` times its own length; `tilted` False leaves the
    rotations out. `steps`, at most T, may say how many of the poses count, without compiling anew. `strong_friction` and `solver`: see `Level`.
    """

    def step(state: tuple[Array, Skin, Quality]) -> tuple[Array, Skin, Quality]:
        number, skin, worst = state
        # both are written so that a NaN counts as the worst
        lost = ~(worst.residual_mm <= worst.tolerance_mm)
        skin, now = advance_increment(
            system,
            obstacles,
            which,
            friction,
            path[number],
            skin,
            tolerance,
            limit,
            tilted,
            lost,
            strong_friction,
            solver,
        )
        worse = ~(now.residual_mm * worst.tolerance_mm <= worst.residual_mm * now.tolerance_mm)
        pick = lambda new, old: jnp.where(worse, new, old)  # noqa: E731
        residual, goal = (
            pick(now.residual_mm, worst.residual_mm),
            pick(now.tolerance_mm, worst.tolerance_mm),
        )
        return number + 1, skin, Quality(residual, goal, worst.iterations + now.iterations)

    last = jnp.asarray(len(path) if steps is None else steps, jnp.int32)
    none = jnp.zeros(path.shape[1], path.dtype)
    start = Quality(none, none + tolerance * LEAST_MM, jnp.zeros(path.shape[1], jnp.int32))
    _, skin, worst = jax.lax.while_loop(
        lambda state: state[0] < last, step, (jnp.zeros((), jnp.int32), skin, start)
    )
    return skin, worst
