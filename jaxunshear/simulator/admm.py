"""ADMM for one increment of a contact: forces under non-penetration and Coulomb's law.

ADMM needs one precomputed inverse, (W + RHO I)^-1, and is over-relaxed (under-relaxed at strong
friction): each iteration is one matrix product for the entire batch.

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

from jaxunshear.simulator.contact_problem import RHO, Increment, project
from jaxunshear.simulator.level import STRONG_FRICTION

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
