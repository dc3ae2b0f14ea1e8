"""The converged contact as a differentiable function, from the implicit function theorem.

It maps path, friction and compliance to the pins. Every increment's force solves f = P(f - c) with
c = W f + b. Differentiated there, with D = P' (3 x 3 for each node: the identity where it sticks,
the disk's projection where it slips, nothing where it is free),

    (I - D (I - W)) df = -D (dW f + db) + (dP/dmu) dmu,

one dense system a scene and increment, however the solver came to f. It is written as a forward
rule (`jax.custom_jvp`), whose transpose JAX derives, so that few inputs (`jax.jacfwd`) and few
outputs (`jax.grad`) are both cheap. What an increment inherits from those before it flows through
the skin's displacement. Going back, only the forces are kept and the systems are built again. The
same matrix polishes the force by semismooth Newton steps (Qi & Sun 1993, Math. Program. 58), so
that the solution that is differentiated holds to rounding.

At a switch, where a node is about to touch, part, stick or slip, P has a kink and the pins have
one-sided derivatives only. The result then belongs to the side on which the node was found.
`compute_switch_distance` says how far the nearest switch was.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Float

from jaxunshear.simulator.contact_problem import (
    RHO,
    ContactProblem,
    Increment,
    Skin,
    compute_projection_slopes,
    project,
    solve_linear_system,
)
from jaxunshear.simulator.friction import (
    LEAST_MM,
    MOST_MM,
    PASSES,
    Solver,
    SolverStart,
    make_increment,
    move_skins,
)
from jaxunshear.simulator.paths import compute_increment_length, rotate, transpose

TOLERANCE = 1e-3  # of the solver's first round, before the Newton steps
SOLVER = Solver(TOLERANCE, limit=2000)
ROUNDS, NEWTON = 4, 12
GOAL_MM = {"float64": 1e-10, "float32": 2e-6}  # natural residual at which an increment is done


class PinState(NamedTuple):
    """Pins and skins after a path. Only `motion` and `skin` carry derivatives."""

    motion: Array  # (B, P, 3) mm that the pin tips moved, sensor frame
    skin: Skin
    margin_mm: Array  # (B,) to the nearest switch of any node in any increment
    residual_mm: Array  # (B,) natural residual of the worst increment


class _PathState(NamedTuple):
    skin: Skin
    margin: Array  # (B,) mm
    worst: Array  # (B,) residual, mm


def compute_pin_state(
    problem: ContactProblem, to_pins: Float[Array, "N3 P3"], path: Float[Array, "T B 6"], skin: Skin
) -> PinState:
    """Compute where the pins are after B skins followed `path`.

    Each increment is solved to rounding. Differentiable by `system.w`, `to_pins` (both scaled as in
    `System`), `friction`, `path`, and the displacement of `skin`, which is at path[0]. The problem
    must be `tilted` and have three unknowns a node; float64 is advised. Runs under jit; the batch
    is its own.
    """

    def step(state: _PathState, pose: Array) -> tuple[_PathState, None]:
        return _advance_increment(problem, state, pose), None

    count = len(problem.friction)
    none = jnp.zeros(count, path.dtype)
    state, _ = jax.lax.scan(step, _PathState(skin, none + jnp.inf, none), path[1:])
    motion = (state.skin.force.reshape(count, -1) @ to_pins).reshape(count, -1, 3)
    return PinState(
        motion, state.skin, jax.lax.stop_gradient(state.margin), jax.lax.stop_gradient(state.worst)
    )


class _PassState(NamedTuple):
    force: Array  # in the level frame, as the dual
    dual: Array
    displacement: Array
    margin: Array
    worst: Array


def _advance_increment(problem: ContactProblem, state: _PathState, pose: Array) -> _PathState:
    """Move skins to a pose in PASSES passes, as `friction.advance_increment` does."""
    skin, frame = state.skin, problem.compute_frame(pose)
    start = _PassState(
        rotate(frame, skin.force),
        rotate(frame, skin.dual),
        skin.displacement,
        state.margin,
        state.worst,
    )
    end, _ = jax.lax.scan(_make_pass(problem, skin, pose), start, length=PASSES)
    back = transpose(frame)
    after = Skin(rotate(back, end.force), rotate(back, end.dual), end.displacement, pose)
    moving = jnp.any(pose != skin.pose, axis=-1)
    return _PathState(move_skins(skin, moving, after), end.margin, end.worst)


def _make_pass(
    problem: ContactProblem, skin: Skin, pose: Array
) -> Callable[[_PassState, None], tuple[_PassState, None]]:
    """Make one pass over an increment, which keeps nothing but the force for going back."""
    system, friction = problem.system, problem.friction
    moves = jnp.any(pose != skin.pose, axis=-1)
    length = jnp.where(moves, compute_increment_length(skin.pose, pose, system.radius_mm / 4), 0)

    @partial(
        jax.checkpoint,
        prevent_cse=False,
        policy=jax.checkpoint_policies.save_only_these_names("force"),
    )
    def solve_pass(state: _PassState, _: None) -> tuple[_PassState, None]:
        increment = make_increment(problem, skin, pose, state.displacement)
        guess = jax.lax.stop_gradient(Guess(state.force, state.dual, length))
        force = solve_contact_force(increment, guess)
        total = increment.displace(force) + increment.offset
        inside = rotate(transpose(increment.frame), force)
        displacement = inside.reshape(len(friction), -1) @ system.w
        trial = force - total
        margin = jnp.where(moves, compute_switch_distance(trial, friction), jnp.inf)
        residual = jnp.where(moves, _compute_size(force - project(trial, friction)), 0)
        after = _PassState(
            force,
            -total / RHO,
            displacement.reshape(force.shape),
            jnp.minimum(state.margin, margin),
            jnp.maximum(state.worst, residual),
        )
        return after, None

    return solve_pass


def compute_switch_distance(
    trial: Float[Array, "B N 3"], friction: Float[Array, "B"]
) -> Float[Array, "B"]:
    """Compute how far in mm f - (W f + b) may change before any node passes a switch.

    For a free node that is its gap, for a slipping one its slip beyond the last that would stick.
    Forces count in mm of the displacement that each would give to its own node.
    """
    tangential, normal = trial[..., :2], trial[..., 2]
    mu = friction[:, None]
    either = (mu > 0) & ~jnp.isinf(mu) & (normal > 0)
    limit = jnp.where(either, mu, 0) * normal
    beyond = jnp.abs(jnp.sqrt(jnp.sum(tangential**2, axis=-1)) - limit)
    return jnp.min(jnp.minimum(jnp.abs(normal), jnp.where(either, beyond, jnp.inf)), axis=-1)


class Guess(NamedTuple):
    """What helps to find a force and does not change it; carries no derivative."""

    force: Array  # (B, N, 3), in the level frame
    dual: Array
    length_mm: Array  # (B,) of the increment, 0 for skins that stay


@jax.custom_jvp
def solve_contact_force(increment: Increment, guess: Guess) -> Float[Array, "B N 3"]:
    """Solve an increment's equation for the force, in the level frame.

    `increment` must have a frame and three unknowns a node.
    """
    return _find_force(increment, guess)


@solve_contact_force.defjvp
def _differentiate_contact_force(
    primals: tuple[Increment, Guess], tangents: tuple[Increment, Guess]
) -> tuple[Array, Array]:
    increment, tangent = primals[0], tangents[0]
    force = checkpoint_name(solve_contact_force(*primals), "force")
    total, change = jax.jvp(lambda at: at.displace(force) + at.offset, (increment,), (tangent,))
    slopes = compute_projection_slopes(force - total, increment.friction)
    finite = jnp.where(jnp.isinf(increment.friction), 0, tangent.friction)
    through_total = jnp.einsum("bnij,bnj->bni", slopes.by_force, change)
    right = slopes.by_friction * finite[:, None, None] - through_total
    return force, solve_linear_system(increment, slopes.by_force, right)


class _RoundState(NamedTuple):
    force: Array
    dual: Array
    error: Array  # (B,)
    number: Array  # () of rounds


def _find_force(increment: Increment, guess: Guess) -> Array:
    """Find the force by rounds of ADMM, each ten times tighter, and Newton steps."""
    dtype = increment.offset.dtype
    goal = jnp.where(guess.length_mm > 0, GOAL_MM[dtype.name], jnp.inf).astype(dtype)

    def compute_free_dual(force: Array) -> Array:
        return -(increment.displace(force) + increment.offset) / RHO

    def solve_round(state: _RoundState) -> _RoundState:
        length = jnp.clip(guess.length_mm, LEAST_MM, MOST_MM)
        tolerance = TOLERANCE * length * 10.0 ** -state.number.astype(length.dtype)
        tolerance = jnp.where(state.error > goal, tolerance, jnp.inf).astype(dtype)
        start = SolverStart(state.force, state.dual, increment.displace(state.force))
        force = SOLVER.solve(increment, start, tolerance).force
        error = _compute_size(increment.compute_miss(force))
        polished = _polish_force(increment, force, error, goal)
        dual = compute_free_dual(polished.force)
        return _RoundState(polished.force, dual, polished.error, state.number + 1)

    def goes_on(state: _RoundState) -> Array:
        return jnp.any(state.error > goal) & (state.number < ROUNDS)

    dual = jnp.where(guess.force[..., -1:] > 0, guess.dual, compute_free_dual(guess.force))
    miss = _compute_size(increment.compute_miss(guess.force))
    error = jnp.where(guess.length_mm > 0, miss, 0)
    start = _RoundState(guess.force, dual, error, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(goes_on, solve_round, start).force


class _NewtonState(NamedTuple):
    force: Array
    error: Array  # (B,)
    improved: Array  # () whether the last step improved any scene
    number: Array  # () of steps


def _polish_force(increment: Increment, force: Array, error: Array, goal: Array) -> _NewtonState:
    """Take semismooth Newton steps for as long as they help a scene that is not at its goal."""

    def step(state: _NewtonState) -> _NewtonState:
        force, error = state.force, state.error
        trial = increment.compute_trial_force(force)
        slope = compute_projection_slopes(trial, increment.friction).by_force
        after = force - solve_linear_system(increment, slope, increment.compute_miss(force))
        error_after = _compute_size(increment.compute_miss(after))
        better = (error_after < error) & (error > goal)
        return _NewtonState(
            jnp.where(better[:, None, None], after, force),
            jnp.where(better, error_after, error),
            jnp.any(better),
            state.number + 1,
        )

    def goes_on(state: _NewtonState) -> Array:
        return jnp.any(state.error > goal) & state.improved & (state.number < NEWTON)

    start = _NewtonState(force, error, jnp.ones((), bool), jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(goes_on, step, start)


def _compute_size(miss: Array) -> Array:
    """Compute the largest miss (B,) of any node from vectors (B, N, 3)."""
    return jnp.max(jnp.linalg.norm(miss, axis=-1), axis=-1)
