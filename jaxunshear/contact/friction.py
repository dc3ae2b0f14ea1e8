"""Quasi-static contact with Coulomb friction along a path, for a batch of scenes that share one compliance.

At every increment the nodal forces f = (t, p) answer: no penetration, no pull, |t| <= mu p, and t opposes the slip of this
increment. With u = W f and a gap g that is linear in u this is a fixed point f = P(f - (W f + b)), where P cuts p at zero
and then t to the disk of radius mu p (Alart & Curnier 1991). It is found by ADMM with one precomputed inverse,
(W + rho I)^-1, over-relaxed: each iteration is one matrix product for the whole batch. W is scaled to a unit mean diagonal.

We stop on a length: ADMM's two residuals, W (x - z), by which the elastic forces x and the admissible ones z move the skin
differently, and rho (z - z_before), both in mm, against the length of the increment. A residual relative to the forces would
let small warm-started steps stop without moving; one in the forces themselves would pass over a small pull on every node,
which moves the skin as a whole by a hundred times more than the same pull on one.

Forces are in the sensor frame. You can skip `_solve_increment` and read `follow_path`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxunshear.contact.obstacle import Obstacles, drop

OVER_RELAXATION = 1.8
RHO = 8.0
BETWEEN_CHECKS = 5


class System(NamedTuple):
    """What a batch shares: `w` and `inverse` (3N, 3N) scaled to a unit mean diagonal of w, `nodes` (N, 3) mm."""

    w: jax.Array
    inverse: jax.Array
    nodes: jax.Array


class Skin(NamedTuple):
    """State of B skins after a motion: all that a later motion needs to continue."""

    force: jax.Array  # (B, N, 3) scaled, mm
    dual: jax.Array  # (B, N, 3) of the solver, a warm start only
    displacement: jax.Array  # (B, N, 3) mm
    pose: jax.Array  # (B, 4) mm, mm, rad, mm


class Quality(NamedTuple):
    """How good the worst increment was: residual (B,) mm, its tolerance (B,) mm, iterations (B,) summed over the path."""

    residual_mm: jax.Array
    tolerance_mm: jax.Array
    iterations: jax.Array


def project(force: jax.Array, friction: jax.Array) -> jax.Array:
    """Cut (B, N, 3) to p >= 0 and |t| <= friction * p; friction (B,)."""
    normal = jnp.maximum(force[..., 2], 0)
    tangential = force[..., :2]
    squared = jnp.sum(tangential**2, axis=-1)
    limit = friction[:, None] * normal
    shrink = jnp.where(squared > limit**2, limit * jax.lax.rsqrt(jnp.maximum(squared, 1e-30)), 1.0)
    return jnp.concatenate([tangential * shrink[..., None], normal[..., None]], axis=-1)


def _times(matrix: jax.Array, force: jax.Array) -> jax.Array:
    return (force.reshape(force.shape[0], -1) @ matrix).reshape(force.shape)  # the matrix is symmetric


def natural_residual(w: jax.Array, force: jax.Array, offset: jax.Array, friction: jax.Array) -> jax.Array:
    """(B,) largest |f - P(f - (W f + b))| of any node, scaled: zero for an answer and for nothing else."""
    miss = force - project(force - _times(w, force) - offset, friction)
    return jnp.max(jnp.linalg.norm(miss, axis=-1), axis=-1)


def _solve_increment(system: System, force, dual, offset, friction, tolerance, limit: int):
    """ADMM from a warm start until every scene is below its tolerance, or `limit` iterations."""

    def iterate(_, state):
        z, y, _, _ = state
        x = _times(system.inverse, RHO * (z - y) - offset)
        relaxed = OVER_RELAXATION * x + (1 - OVER_RELAXATION) * z
        after = project(relaxed + y, friction)
        return after, y + relaxed - after, x, z

    def error(state):
        z, _, x, before = state
        apart = _times(system.w, x - z)
        change = RHO * (z - before)
        touching = jnp.sum(z[..., 2] > 0, axis=-1)
        return jnp.sqrt(jnp.sum(apart**2 + change**2, axis=(1, 2)) / jnp.maximum(touching, 1))

    def unfinished(state):
        _, error, count = state
        return jnp.any(error > tolerance) & (count < limit)

    def step(state):
        inner, _, count = state
        inner = jax.lax.fori_loop(0, BETWEEN_CHECKS, iterate, inner)
        return inner, error(inner), count + BETWEEN_CHECKS

    # what holds already, as where nothing touches, needs no iteration
    missing = jnp.where(natural_residual(system.w, force, offset, friction) > 0, jnp.inf, 0.0)
    start = ((force, dual, force, force), missing, jnp.zeros((), jnp.int32))
    (z, y, _, _), missing, count = jax.lax.while_loop(unfinished, step, start)
    return z, y, missing, count


def _turn(angle: jax.Array, xy: jax.Array) -> jax.Array:
    """Rotate (B, N, 2) by angle (B,) rad."""
    cos, sin = jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
    return jnp.stack([cos * xy[..., 0] - sin * xy[..., 1], sin * xy[..., 0] + cos * xy[..., 1]], axis=-1)


def rest(system: System, pose: jax.Array) -> Skin:
    """B undeformed skins at pose (B, 4)."""
    zeros = jnp.zeros((pose.shape[0], *system.nodes.shape), pose.dtype)
    return Skin(zeros, zeros, zeros, pose)


def follow_path(
    system: System,
    obstacles: Obstacles,
    which: jax.Array,
    friction: jax.Array,
    path: jax.Array,
    skin: Skin,
    tolerance: float,
    limit: int,
) -> tuple[Skin, Quality]:
    """Move B skins along path (T, B, 4) of poses x, y (mm), yaw (rad), depth (mm) in the target frame.

    which (B,) indexes the obstacles; an increment stops below `tolerance` times its own length (but that of at least
    0.05 mm, and at most 0.5 mm, so that pauses and long presses are judged sensibly).
    """
    ground = system.nodes[:, :2]

    def increment(skin: Skin, pose: jax.Array):
        # where the nodes would be in the target frame if the skin kept its shape, and how far each then slips
        place = ground + skin.displacement[..., :2]
        here = _turn(pose[:, 2], place) + pose[:, None, :2]
        before = _turn(skin.pose[:, 2], place) + skin.pose[:, None, :2]
        slip = _turn(-pose[:, 2], here - before)
        height = system.nodes[:, 2] - pose[:, 3:4] + drop(obstacles, which, here)
        offset = jnp.concatenate([slip - skin.displacement[..., :2], height[..., None]], axis=-1)
        moved = jnp.linalg.norm(pose[:, [0, 1, 3]] - skin.pose[:, [0, 1, 3]], axis=-1)
        goal = tolerance * jnp.clip(moved, 0.05, 0.5)
        force, dual, error, count = _solve_increment(system, skin.force, skin.dual, offset, friction, goal, limit)
        after = Skin(force, dual, _times(system.w, force), pose)
        return after, (error, goal, jnp.broadcast_to(count, error.shape))

    skin, (errors, goals, counts) = jax.lax.scan(increment, skin, path)
    worst = jnp.argmax(errors / goals, axis=0)
    pick = lambda values: jnp.take_along_axis(values, worst[None], axis=0)[0]  # noqa: E731
    return skin, Quality(pick(errors), pick(goals), jnp.sum(counts, axis=0))


def contact_state(skin: Skin, friction: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Numbers of stuck, slipping and free nodes, each (B,)."""
    touching = skin.force[..., 2] > 0
    pull = jnp.linalg.norm(skin.force[..., :2], axis=-1)
    slipping = touching & (pull >= friction[:, None] * skin.force[..., 2] * (1 - 1e-4))
    return jnp.sum(touching & ~slipping, -1), jnp.sum(slipping, -1), jnp.sum(~touching, -1)
