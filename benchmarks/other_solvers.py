"""Other solvers of an increment, to be measured beside the simulator's own ADMM.

All are an `friction.Method`, for contacts without tilt, and stop on the same kind of length:

- `projected_gradient`, and `accelerated` (Nesterov 1983, restarted as by O'Donoghue & Candes 2015)
- `solve_anderson`: the simulator's ADMM, as a fixed point of one variable, extrapolated from its
  last steps (Walker & Ni 2011)
- `solve_newton`: semismooth (Alart & Curnier 1991), each increment from a cold start
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from jaxunshear.simulator.contact_problem import RHO, Increment, project
from jaxunshear.simulator.friction import (
    BETWEEN_CHECKS,
    OVER_RELAXATION,
    Method,
    SolverResult,
    SolverStart,
)

State = TypeVar("State")
_Walk = tuple[
    jax.Array,
    jax.Array,
    jax.Array,
    jax.Array,
    tuple[jax.Array, jax.Array],
    jax.Array,
    jax.Array,
    jax.Array,
]
ANDERSON_DEPTH = 5  # earlier steps that Anderson's extrapolation uses
GROWTH = 2.0  # of its residual, beyond which an extrapolated step is taken back
NEWTON_LIMIT = 40  # iterations, each a matrix factorised for every scene


def _multiply(matrix: jax.Array, force: jax.Array) -> jax.Array:
    return (force.reshape(force.shape[0], -1) @ matrix).reshape(force.shape)


def _compute_length(
    w: jax.Array, miss: jax.Array, force: jax.Array, factor: jax.Array | float
) -> jax.Array:
    """Compute the simulator's length (B,) mm of a miss of the forces.

    It has the motion of the skin that the miss causes, and `factor` times the miss.
    """
    touching = jnp.maximum(jnp.sum(force[..., -1] > 0, axis=-1), 1)
    squared = _multiply(w, miss) ** 2 + (factor * miss) ** 2
    return jnp.sqrt(jnp.sum(squared, axis=(1, 2)) / touching)


def _compute_largest_eigenvalue(w: jax.Array) -> jax.Array:
    """Of w, by the power method; a little above."""

    def step(_: jax.Array, v: jax.Array) -> jax.Array:
        moved = v @ w
        return moved / jnp.linalg.norm(moved)

    count = len(w)
    start = jnp.ones(count, w.dtype) / count**0.5 + jnp.linspace(0, 1, count, dtype=w.dtype)
    vector = jax.lax.fori_loop(0, 30, step, start / jnp.linalg.norm(start))
    return 1.02 * jnp.linalg.norm(vector @ w)


def _iterate(
    step: Callable[[State], tuple[State, jax.Array]],
    state: State,
    tolerance: jax.Array,
    limit: int,
    every: int,
) -> tuple[State, jax.Array, jax.Array]:
    """Repeat `step`, state -> (state, error (B,)), until all errors are below their tolerance.

    There are `every` steps between checks.
    """

    def is_unfinished(carry: tuple[State, jax.Array, jax.Array, jax.Array]) -> jax.Array:
        _, error, _, count = carry
        return jnp.any(~(error <= tolerance)) & (count < limit)

    def some(
        carry: tuple[State, jax.Array, jax.Array, jax.Array],
    ) -> tuple[State, jax.Array, jax.Array, jax.Array]:
        state, before, spent, count = carry
        state, error = jax.lax.fori_loop(0, every, lambda _, both: step(both[0]), (state, before))
        return state, error, spent + every * (before > tolerance), count + every

    missing = jnp.where(jnp.isinf(tolerance), 0.0, jnp.inf).astype(tolerance.dtype)
    begin = (state, missing, jnp.zeros(tolerance.shape, jnp.int32), jnp.zeros((), jnp.int32))
    state, missing, spent, _ = jax.lax.while_loop(is_unfinished, some, begin)
    return state, missing, spent


class _Accelerated(NamedTuple):
    force: jax.Array
    ahead: jax.Array  # where the next gradient is taken
    momentum: jax.Array  # (B,)


def _make_gradient_solver(accelerate: bool) -> Method:
    def solve(
        increment: Increment,
        start: SolverStart,
        tolerance: jax.Array,
        limit: int,
    ) -> SolverResult:
        _check_untilted(increment.frame)
        w, offset, friction = increment.w, increment.offset, increment.friction
        largest = _compute_largest_eigenvalue(w)

        def step(state: _Accelerated) -> tuple[_Accelerated, jax.Array]:
            z, ahead, momentum = state
            after = project(ahead - (_multiply(w, ahead) + offset) / largest, friction)
            error = _compute_length(w, after - ahead, after, largest)
            if not accelerate:
                return _Accelerated(after, after, momentum), error
            against = jnp.sum((ahead - after) * (after - z), axis=(1, 2)) > 0
            momentum = jnp.where(against, 1.0, momentum).astype(z.dtype)
            following = (1 + jnp.sqrt(1 + 4 * momentum**2)) / 2
            share = jnp.where(against, 0, (momentum - 1) / following)
            ahead = after + share[:, None, None] * (after - z)
            return _Accelerated(after, ahead, following), error

        force = start.force
        state = _Accelerated(force, force, jnp.ones(len(force), force.dtype))
        state, error, spent = _iterate(step, state, tolerance, limit, BETWEEN_CHECKS)
        return SolverResult(state.force, start.dual, error, spent)

    return solve


projected_gradient, accelerated = _make_gradient_solver(False), _make_gradient_solver(True)


def solve_anderson(
    increment: Increment,
    start: SolverStart,
    tolerance: jax.Array,
    limit: int,
) -> SolverResult:
    """Solve an increment by ADMM with Anderson's extrapolation, undone where it does harm.

    ADMM moves v = z + y by 1.8 (x - z), with z = P(v).
    """
    _check_untilted(increment.frame)
    w, offset, friction = increment.w, increment.offset, increment.friction
    count, size = len(offset), offset[0].size

    def move(v: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        z = project(v, friction)
        x = _multiply(increment.inverse, RHO * (2 * z - v) - offset)
        return OVER_RELAXATION * (x - z), z, x

    def step(state: _Walk) -> tuple[_Walk, jax.Array]:
        v, plain, ways, pulls, last, before, z_before, number = state
        pull, z, x = move(v)
        norm = jnp.linalg.norm(pull.reshape(count, -1), axis=-1)
        worse = (norm > GROWTH * before)[:, None, None]
        # a step that did harm is undone: on from the plain one, with nothing remembered
        way, gain = (v - last[0]).reshape(count, -1), (pull - last[1]).reshape(count, -1)
        slot = number % ANDERSON_DEPTH
        ways, pulls = ways.at[:, slot].set(way), pulls.at[:, slot].set(gain)
        ways, pulls = jnp.where(worse, 0, ways), jnp.where(worse, 0, pulls)
        gram = jnp.einsum("bmi,bni->bmn", pulls, pulls)
        ridge = 1e-7 * jnp.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-30
        right = jnp.einsum("bmi,bi->bm", pulls, pull.reshape(count, -1))
        share = jnp.linalg.solve(
            gram + ridge * jnp.eye(ANDERSON_DEPTH, dtype=v.dtype), right[..., None]
        )[..., 0]
        back = jnp.einsum("bm,bmi->bi", share, ways + pulls).reshape(v.shape)
        after = jnp.where(worse, plain, v + pull - back)
        touching = jnp.maximum(jnp.sum(z[..., -1] > 0, axis=-1), 1)
        squared = _multiply(w, x - z) ** 2 + (RHO * (z - z_before)) ** 2
        error = jnp.sqrt(jnp.sum(squared, axis=(1, 2)) / touching)
        held = jnp.where(worse[:, 0, 0], before, norm)
        return (after, v + pull, ways, pulls, (v, pull), held, z, number + 1), error

    v = start.force + start.dual
    pull, z, _ = move(v)
    none = jnp.zeros((count, ANDERSON_DEPTH, size), v.dtype)
    state = (
        v + pull,
        v + pull,
        none,
        none,
        (v, pull),
        jnp.full(count, jnp.inf, v.dtype),
        z,
        jnp.zeros((), jnp.int32),
    )
    state, error, spent = _iterate(step, state, tolerance, limit, BETWEEN_CHECKS)
    v = state[0]
    force = project(v, friction)
    return SolverResult(force, v - force, error, spent)


def solve_newton(
    increment: Increment,
    start: SolverStart,
    tolerance: jax.Array,
    limit: int,
) -> SolverResult:
    """Full steps on f - P(f - (W f + b)) = 0, from zero."""
    _check_untilted(increment.frame)
    w, offset, friction = increment.w, increment.offset, increment.friction
    count, nodes, unknowns = offset.shape
    of_node = jax.jacfwd(lambda force, mu: project(force[None, None], mu[None])[0, 0])
    slopes_of = jax.vmap(jax.vmap(of_node, (0, None)))
    identity = jnp.eye(nodes * unknowns, dtype=offset.dtype)

    def step(force: jax.Array) -> tuple[jax.Array, jax.Array]:
        inner = force - _multiply(w, force) - offset
        miss = force - project(inner, friction)

        def one(item: tuple[jax.Array, jax.Array]) -> jax.Array:
            slopes, miss = item
            rows = (identity - w).reshape(nodes, unknowns, -1)
            through = jnp.einsum("nij,njk->nik", slopes, rows).reshape(identity.shape)
            return jnp.linalg.solve(identity - through, miss.ravel()).reshape(miss.shape)

        change = jax.lax.map(one, (slopes_of(inner, friction), miss))
        after = force - change
        miss = after - project(after - _multiply(w, after) - offset, friction)
        return after, _compute_length(w, miss, after, 1.0)

    force, error, spent = _iterate(
        step, jnp.zeros_like(offset), tolerance, min(limit, NEWTON_LIMIT), 1
    )
    return SolverResult(force, start.dual, error, spent)


def _check_untilted(frame: jax.Array | None) -> None:
    if frame is not None:
        raise NotImplementedError("these solvers are for contacts without tilt")


OTHER_SOLVERS: dict[str, Method | None] = {
    "admm": None,
    "admm with anderson": solve_anderson,
    "accelerated projected gradient": accelerated,
    "projected gradient": projected_gradient,
    "newton, cold": solve_newton,
}
