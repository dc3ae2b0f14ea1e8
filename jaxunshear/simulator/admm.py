"""ADMM for one increment of a contact: forces under non-penetration and Coulomb's law.

The forces solve the fixed point f = P(f - (W f + b)) of `Increment`. ADMM needs one precomputed
inverse, (W + RHO I)^-1, and is over-relaxed (under-relaxed at strong friction): each iteration is
one matrix product for the entire batch.

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
from jaxtyping import Float

from jaxunshear.simulator.frame import matmul, rotate, rotate_back
from jaxunshear.simulator.level import STRONG_FRICTION

OVER_RELAXATION = 1.8
RHO = 12.0
BETWEEN_CHECKS = 5
# At STRONG_FRICTION and above, the same tolerance leaves larger errors: for the first PATIENCE
# iterations we aim at this share of it, which some scenes do not reach.
STRICTER, PATIENCE = 0.5, 100


class Increment(NamedTuple):
    """The equation of one increment of B scenes in the level frame: f = P(f - (W f + b)).

    P is `project`, and the forces f are (B, N, d).
    """

    w: Array  # (dN, dN) W, symmetric, in the sensor frame
    frame: Array | None  # (B, 3, 3) from the sensor frame to the level frame; None: no tilt
    offset: Array  # (B, N, d) b, mm
    friction: Array  # (B,)

    def displace(self, force: Array) -> Array:
        """Compute W f."""
        return multiply(self.w, force, self.frame)

    def compute_trial_force(self, force: Array) -> Array:
        """Compute f - (W f + b), which P would project."""
        return force - self.displace(force) - self.offset

    def compute_miss(self, force: Array) -> Array:
        """Compute f - P(f - (W f + b)), which is zero at the solution."""
        return force - project(self.compute_trial_force(force), self.friction)


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


# increment, inverse of w + RHO, start, tolerance (B,) mm, limit -> result
Solver = Callable[[Increment, Array, SolverStart, Array, int], SolverResult]


@dataclass(frozen=True)
class SolverOptions:
    """How exactly each increment is solved; static under jit.

    An increment stops below `tolerance` times its own length, or after `limit` iterations.
    `strong_friction` is the relaxation of scenes whose friction exceeds STRONG_FRICTION, None that
    of all scenes. `solver` replaces ADMM.
    """

    tolerance: float
    limit: int
    strong_friction: float | None = None
    solver: Solver | None = None


def project(force: Float[Array, "B N d"], friction: Float[Array, "B"]) -> Float[Array, "B N d"]:
    """Cut forces to p >= 0 and |t| <= friction * p; friction infinite for pure stick."""
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


def multiply(matrix: Array, force: Array, frame: Array | None) -> Array:
    """Multiply a symmetric sensor-frame matrix with level-frame forces (B, N, d)."""
    inside = force if frame is None else rotate_back(frame, force)
    moved = matmul(inside.reshape(force.shape[0], -1), matrix).reshape(force.shape)
    return moved if frame is None else rotate(frame, moved)


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
    inverse: Array
    tolerance: Array  # (B,) mm
    limit: int
    relaxation: Array | float
    strong: Array | None  # (B,) scenes that take short steps; None: none does

    def iterate(self, _: Array, state: _Iterates) -> _Iterates:
        z, y = state.force, state.dual
        increment = self.increment
        x = multiply(self.inverse, RHO * (z - y) - increment.offset, increment.frame)
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


def solve_increment(
    increment: Increment,
    inverse: Float[Array, "dN dN"],
    start: SolverStart,
    tolerance: Float[Array, "B"],
    limit: int,
    strong_friction: float | None = None,
) -> SolverResult:
    """Solve an increment by ADMM, until every scene is below its tolerance in mm.

    It stops at `limit` iterations. `inverse` is that of w + RHO. Scenes with an infinite tolerance
    are not waited for. `strong_friction` as in `SolverOptions`.
    """
    relaxation: Array | float = OVER_RELAXATION
    strong = None
    if strong_friction is not None:
        strong = increment.friction > STRONG_FRICTION
        relaxation = jnp.where(strong, strong_friction, OVER_RELAXATION)[:, None, None]
    admm = _Admm(increment, inverse, tolerance, limit, relaxation, strong)
    state = jax.lax.while_loop(admm.is_running, admm.advance, admm.start(start))
    return SolverResult(
        state.iterates.force, state.iterates.dual, state.residual_mm, state.iterations
    )
