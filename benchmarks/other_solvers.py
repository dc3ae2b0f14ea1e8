"""Other solvers of an increment, to be measured beside the simulator's own ADMM.

All have the signature of `friction.solve_increment`, without its relaxation, are for contacts
without tilt, and stop on the same kind of length:

- `projected_gradient`, and `accelerated` (Nesterov 1983, restarted as by O'Donoghue & Candes 2015)
- `solve_anderson`: the simulator's ADMM as a fixed point of one variable, extrapolated from its
  last steps (Walker & Ni 2011)
- `solve_newton`: semismooth (Alart & Curnier 1991), each increment from a cold start
"""

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from jaxunshear.simulator.friction import (
    BETWEEN_CHECKS,
    OVER_RELAXATION,
    RHO,
    SolverResult,
    System,
    project,
)

Start = tuple[jax.Array, ...]  # force f, dual, W f
Solver = Callable[..., SolverResult]
State = TypeVar("State")
ANDERSON_DEPTH = 5  # earlier steps that Anderson's extrapolation uses
MAX_GROWTH = 2.0  # of its residual, beyond which an extrapolated step is undone
NEWTON_LIMIT = 40  # iterations, each a matrix factorised for every scene


def _multiply(matrix: jax.Array, force: jax.Array) -> jax.Array:
    return (force.reshape(force.shape[0], -1) @ matrix).reshape(force.shape)


def _compute_length(
    system: System, miss: jax.Array, force: jax.Array, factor: jax.Array | float
) -> jax.Array:
    """Compute the simulator's length (B,) mm of a miss of the forces.

    It has the motion of the skin that the miss causes, and `factor` times the miss.
    """
    touching = jnp.maximum(jnp.sum(force[..., -1] > 0, axis=-1), 1)
    squared = _multiply(system.w, miss) ** 2 + (factor * miss) ** 2
    return jnp.sqrt(jnp.sum(squared, axis=(1, 2)) / touching)


def _compute_largest_eigenvalue(system: System) -> jax.Array:
    """Compute the largest eigenvalue of w by the power method, a little too large."""

    def step(_: jax.Array, v: jax.Array) -> jax.Array:
        product = v @ system.w
        return product / jnp.linalg.norm(product)

    count = len(system.w)
    start = jnp.ones(count, system.w.dtype) / count**0.5
    start += jnp.linspace(0, 1, count, dtype=system.w.dtype)
    vector = jax.lax.fori_loop(0, 30, step, start / jnp.linalg.norm(start))
    return 1.02 * jnp.linalg.norm(vector @ system.w)


class _Iteration(NamedTuple, Generic[State]):
    """The state of a solver, and how far it is."""

    state: State
    error: jax.Array  # (B,) mm
    iterations: jax.Array  # (B,)
    steps: jax.Array  # of all scenes


def _iterate(
    step: Callable[[State], tuple[State, jax.Array]],
    state: State,
    tolerance: jax.Array,
    limit: int,
    every: int,
) -> _Iteration[State]:
    """Repeat `step` until the errors (B,) that it returns are below their tolerance.

    It is repeated `every` times between checks.
    """

    def is_unfinished(now: _Iteration[State]) -> jax.Array:
        return jnp.any(~(now.error <= tolerance)) & (now.steps < limit)

    def repeat(now: _Iteration[State]) -> _Iteration[State]:
        state, error = jax.lax.fori_loop(
            0, every, lambda _, both: step(both[0]), (now.state, now.error)
        )
        iterations = now.iterations + every * (now.error > tolerance)
        return _Iteration(state, error, iterations, now.steps + every)

    error = jnp.where(jnp.isinf(tolerance), 0.0, jnp.inf).astype(tolerance.dtype)
    iterations = jnp.zeros(tolerance.shape, jnp.int32)
    start = _Iteration(state, error, iterations, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(is_unfinished, repeat, start)


class _GradientState(NamedTuple):
    force: jax.Array
    extrapolated: jax.Array
    momentum: jax.Array  # (B,)


def _make_gradient_solver(accelerate: bool) -> Solver:
    def solve(
        system: System,
        frame: jax.Array | None,
        offset: jax.Array,
        friction: jax.Array,
        start: Start,
        tolerance: jax.Array,
        limit: int,
    ) -> SolverResult:
        _check_untilted(frame)
        largest = _compute_largest_eigenvalue(system)

        def step(state: _GradientState) -> tuple[_GradientState, jax.Array]:
            z, extrapolated, momentum = state
            gradient = _multiply(system.w, extrapolated) + offset
            after = project(extrapolated - gradient / largest, friction)
            error = _compute_length(system, after - extrapolated, after, largest)
            if not accelerate:
                return _GradientState(after, after, momentum), error
            against = jnp.sum((extrapolated - after) * (after - z), axis=(1, 2)) > 0
            momentum = jnp.where(against, 1.0, momentum).astype(z.dtype)
            following = (1 + jnp.sqrt(1 + 4 * momentum**2)) / 2
            share = jnp.where(against, 0, (momentum - 1) / following)
            ahead = after + share[:, None, None] * (after - z)
            return _GradientState(after, ahead, following), error

        force, dual, _ = start
        state = _GradientState(force, force, jnp.ones(len(force), force.dtype))
        end = _iterate(step, state, tolerance, limit, BETWEEN_CHECKS)
        return end.state.force, dual, end.error, end.iterations

    return solve


projected_gradient, accelerated = _make_gradient_solver(False), _make_gradient_solver(True)


class _AndersonState(NamedTuple):
    v: jax.Array
    plain: jax.Array  # v without extrapolation
    v_changes: jax.Array  # (B, ANDERSON_DEPTH, size) of the last steps
    move_changes: jax.Array  # (B, ANDERSON_DEPTH, size)
    v_before: jax.Array
    move_before: jax.Array
    residual: jax.Array  # (B,)
    z: jax.Array
    number: jax.Array


def solve_anderson(
    system: System,
    frame: jax.Array | None,
    offset: jax.Array,
    friction: jax.Array,
    start: Start,
    tolerance: jax.Array,
    limit: int,
) -> SolverResult:
    """Solve with Anderson's extrapolation of ADMM, which is undone if it does harm.

    ADMM moves v = z + y by 1.8 (x - z), with z = P(v).
    """
    _check_untilted(frame)
    count = len(offset)

    def compute_z(v: jax.Array) -> jax.Array:
        return project(v, friction)

    def compute_x(v: jax.Array, z: jax.Array) -> jax.Array:
        return _multiply(system.inverse, RHO * (2 * z - v) - offset)

    def step(state: _AndersonState) -> tuple[_AndersonState, jax.Array]:
        v = state.v
        z = compute_z(v)
        x = compute_x(v, z)
        move = OVER_RELAXATION * (x - z)
        residual = jnp.linalg.norm(move.reshape(count, -1), axis=-1)
        worse = (residual > MAX_GROWTH * state.residual)[:, None, None]
        # a step that did harm is undone: on from the plain one, with nothing remembered
        slot = state.number % ANDERSON_DEPTH
        v_change = (v - state.v_before).reshape(count, -1)
        move_change = (move - state.move_before).reshape(count, -1)
        v_changes = jnp.where(worse, 0, state.v_changes.at[:, slot].set(v_change))
        move_changes = jnp.where(worse, 0, state.move_changes.at[:, slot].set(move_change))
        share = _fit_changes(move_changes, move.reshape(count, -1))
        back = jnp.einsum("bm,bmi->bi", share, v_changes + move_changes).reshape(v.shape)
        touching = jnp.maximum(jnp.sum(z[..., -1] > 0, axis=-1), 1)
        squared = _multiply(system.w, x - z) ** 2 + (RHO * (z - state.z)) ** 2
        error = jnp.sqrt(jnp.sum(squared, axis=(1, 2)) / touching)
        after = _AndersonState(
            jnp.where(worse, state.plain, v + move - back),
            v + move,
            v_changes,
            move_changes,
            v,
            move,
            jnp.where(worse[:, 0, 0], state.residual, residual),
            z,
            state.number + 1,
        )
        return after, error

    force, dual, _ = start
    v = force + dual
    z = compute_z(v)
    move = OVER_RELAXATION * (compute_x(v, z) - z)
    none = jnp.zeros((count, ANDERSON_DEPTH, offset[0].size), v.dtype)
    residual = jnp.full(count, jnp.inf, v.dtype)
    number = jnp.zeros((), jnp.int32)
    first = _AndersonState(v + move, v + move, none, none, v, move, residual, z, number)
    end = _iterate(step, first, tolerance, limit, BETWEEN_CHECKS)
    force = project(end.state.v, friction)
    return force, end.state.v - force, end.error, end.iterations


def _fit_changes(changes: jax.Array, move: jax.Array) -> jax.Array:
    """Fit a move (B, size) by earlier changes (B, M, size): factors (B, M)."""
    gram = jnp.einsum("bmi,bni->bmn", changes, changes)
    ridge = 1e-7 * jnp.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-30
    right = jnp.einsum("bmi,bi->bm", changes, move)
    matrix = gram + ridge * jnp.eye(ANDERSON_DEPTH, dtype=move.dtype)
    return jnp.linalg.solve(matrix, right[..., None])[..., 0]


def solve_newton(
    system: System,
    frame: jax.Array | None,
    offset: jax.Array,
    friction: jax.Array,
    start: Start,
    tolerance: jax.Array,
    limit: int,
) -> SolverResult:
    """Solve f - P(f - (W f + b)) = 0 with full Newton steps, from zero."""
    _check_untilted(frame)
    count, nodes, unknowns = offset.shape
    compute_node_slope = jax.jacfwd(lambda force, mu: project(force[None, None], mu[None])[0, 0])
    compute_slopes = jax.vmap(jax.vmap(compute_node_slope, (0, None)))
    identity = jnp.eye(nodes * unknowns, dtype=offset.dtype)

    def step(force: jax.Array) -> tuple[jax.Array, jax.Array]:
        inner = force - _multiply(system.w, force) - offset
        miss = force - project(inner, friction)

        def solve_scene(item: tuple[jax.Array, jax.Array]) -> jax.Array:
            slopes, miss = item
            rows = (identity - system.w).reshape(nodes, unknowns, -1)
            through = jnp.einsum("nij,njk->nik", slopes, rows).reshape(identity.shape)
            return jnp.linalg.solve(identity - through, miss.ravel()).reshape(miss.shape)

        change = jax.lax.map(solve_scene, (compute_slopes(inner, friction), miss))
        after = force - change
        miss = after - project(after - _multiply(system.w, after) - offset, friction)
        return after, _compute_length(system, miss, after, 1.0)

    zeros = jnp.zeros_like(offset)
    end = _iterate(step, zeros, tolerance, min(limit, NEWTON_LIMIT), 1)
    return end.state, start[1], end.error, end.iterations


def _check_untilted(frame: jax.Array | None) -> None:
    if frame is not None:
        raise NotImplementedError("these solvers are for contacts without tilt")


OTHER_SOLVERS: dict[str, Solver | None] = {
    "admm": None,
    "admm with anderson": solve_anderson,
    "accelerated projected gradient": accelerated,
    "projected gradient": projected_gradient,
    "newton, cold": solve_newton,
}
