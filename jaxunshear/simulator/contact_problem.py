"""Contacts as arrays: B scenes on one compliance, their skins, and the equation of an increment.

The nodal forces f of an increment solve the fixed point f = P(f - (W f + b)): W f + b is the gap
and the slip of each node, and P cuts the pressure at zero and then the pull to the friction's disk.
Linearised at a solution, D is the slope of P by the force.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_batching import custom_vmap
from jaxtyping import Float

from jaxunshear.simulator.paths import (
    Frame,
    compute_level_frame,
    matmul,
    rotate,
    rotate_back,
    transpose,
)
from jaxunshear.simulator.stimuli import Obstacles

ROTATION_ROUNDING = 1e-6  # of a force, what turning it to and fro in float32 may add to its pull
MIN_PULL = 1e-33  # smaller ones lose digits, or components, to the end of float32's range
RHO = 12.0  # of ADMM


class System(NamedTuple):
    """The compliance of N nodes with d unknowns each.

    d is 3, or 1 (pressure only) where no scene has friction. `w` is scaled to a unit mean diagonal.
    """

    w: Array  # (dN, dN)
    inverse: Array  # (dN, dN) of w + RHO times the identity
    spread: Array  # (dN, 3N) moves the nodes in all directions; w itself where d = 3
    nodes: Array  # (N, 3) mm
    centre_mm: Array  # () height above the apex of the point about which a dome or pad tilts
    radius_mm: Array  # () from the axis to the rim

    def displace(self, force: Array) -> Array:
        """Compute how forces (B, N, d) in the sensor frame displace the nodes, (B, N, 3) mm."""
        moved = matmul(force.reshape(force.shape[0], -1), self.spread)
        return moved.reshape(force.shape[0], -1, 3)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ContactProblem:
    """B scenes on one compliance, each with its obstacle and its friction.

    Without `tilted` no pose of a path may tilt the sensor, and no rotations are computed. Where no
    scene touches with more than `max_touching` nodes, derivatives are cheaper; None promises
    nothing.
    """

    system: System
    obstacles: Obstacles
    obstacle_index: Array  # (B,)
    friction: Array  # (B,) Coulomb coefficient
    tilted: bool = field(default=False, metadata={"static": True})
    max_touching: int | None = field(default=None, metadata={"static": True})

    def compute_frame(self, pose: Float[Array, "B 6"]) -> Frame:
        return compute_level_frame(pose) if self.tilted else None


class Skin(NamedTuple):
    """State of B skins in the sensor frame, from which a later motion continues."""

    force: Array  # (B, N, d) scaled, mm
    dual: Array  # (B, N, d) of the solver, a warm start only
    displacement: Array  # (B, N, 3) mm
    pose: Array  # (B, 6) x, y (mm), yaw (rad), depth (mm), tilt_x, tilt_y (rad)


class Quality(NamedTuple):
    """How well the worst increment of each path was solved."""

    residual_mm: Array  # (B,)
    tolerance_mm: Array  # (B,)
    iterations: Array  # (B,) summed over the path


class NodeCounts(NamedTuple):
    """Numbers of nodes of B skins, each (B,)."""

    stuck: Array
    slipping: Array
    free: Array


def make_undeformed_skins(system: System, pose: Float[Array, "B 6"]) -> Skin:
    """Make B undeformed skins."""
    count, nodes = pose.shape[0], system.nodes.shape[0]
    force = jnp.zeros((count, nodes, len(system.w) // nodes), pose.dtype)
    return Skin(force, force, jnp.zeros((count, nodes, 3), pose.dtype), pose)


def count_node_states(problem: ContactProblem, skin: Skin) -> NodeCounts:
    """Count the stuck, slipping and free nodes of B skins."""
    force = rotate(problem.compute_frame(skin.pose), skin.force)
    friction = problem.friction
    touching = force[..., -1] > 0
    if force.shape[-1] == 1:
        slipping = touching
    else:
        pull = jnp.hypot(force[..., 0], force[..., 1])  # squares of a tiny one would be zero
        limit = jnp.where(jnp.isinf(friction), 0, friction)[:, None] * force[..., 2]
        rounding = 1e-4 * limit + (ROTATION_ROUNDING * force[..., 2] if problem.tilted else 0)
        slips = (pull >= limit - rounding) | (limit < MIN_PULL)
        slipping = touching & ~jnp.isinf(friction)[:, None] & slips
    return NodeCounts(
        jnp.sum(touching & ~slipping, -1), jnp.sum(slipping, -1), jnp.sum(~touching, -1)
    )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Increment:
    """The equation of one increment of B scenes in the level frame; forces are (B, N, d)."""

    w: Array  # (dN, dN) W, symmetric, in the sensor frame
    inverse: Array  # (dN, dN) of w + RHO times the identity
    frame: Frame
    offset: Array  # (B, N, d) b, mm
    friction: Array  # (B,)
    max_touching: int | None = field(default=None, metadata={"static": True})

    def multiply(self, matrix: Array, force: Array) -> Array:
        """Multiply a symmetric sensor-frame matrix with level-frame forces."""
        return rotate(self.frame, _multiply(matrix, rotate_back(self.frame, force)))

    def displace(self, force: Array) -> Array:
        """Compute W f."""
        return self.multiply(self.w, force)

    def compute_trial_force(self, force: Array) -> Array:
        """Compute f - (W f + b), which P would project."""
        return force - self.displace(force) - self.offset

    def compute_miss(self, force: Array) -> Array:
        """Compute f - P(f - (W f + b)), which is zero at the solution."""
        return force - project(self.compute_trial_force(force), self.friction)


def _multiply(matrix: Array, force: Array) -> Array:
    return matmul(force.reshape(force.shape[0], -1), matrix).reshape(force.shape)


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


class ProjectionSlopes(NamedTuple):
    """Derivatives of P."""

    by_force: Array  # (B, N, 3, 3)
    by_friction: Array  # (B, N, 3)


def compute_projection_slopes(
    trial: Float[Array, "B N 3"], friction: Float[Array, "B"]
) -> ProjectionSlopes:
    """Differentiate P at trial forces, by the force and by friction.

    Without friction the disk is a point and P is smooth: there is no tangential force, and none
    that answers to a tangential move.
    """
    tangential, normal = trial[..., :2], trial[..., 2]
    sticks, mu = jnp.isinf(friction)[:, None], jnp.where(jnp.isinf(friction), 0, friction)[:, None]
    pull = jnp.sqrt(jnp.sum(tangential**2, axis=-1))
    limit = mu * jnp.maximum(normal, 0)
    slips = ~sticks & ((pull > limit) | (mu == 0))
    along = tangential / jnp.where(pull > 0, pull, 1)[..., None]
    share = jnp.where(slips, limit / jnp.where(pull > 0, pull, 1), 1)
    outer = jnp.where(slips[..., None, None], along[..., :, None] * along[..., None, :], 0)
    disk = share[..., None, None] * (jnp.eye(2, dtype=trial.dtype)[None, None] - outer)
    zero, one = jnp.zeros_like(normal), jnp.ones_like(normal)
    by_normal = jnp.where(slips, mu, 0)[..., None] * along
    bottom = jnp.stack([zero, zero, one], -1)[..., None, :]
    matrix = jnp.concatenate([jnp.concatenate([disk, by_normal[..., None]], -1), bottom], -2)
    by_friction = jnp.concatenate(
        [jnp.where(slips, jnp.maximum(normal, 0), 0)[..., None] * along, zero[..., None]], -1
    )
    touches = (normal > 0)[..., None]
    return ProjectionSlopes(
        jnp.where(touches[..., None], matrix, 0), jnp.where(touches, by_friction, 0)
    )


def solve_linear_system(increment: Increment, slope: Array, right: Array) -> Array:
    """Solve (I - D (I - W)) df = right for df (B, N, 3) in the level frame.

    Free nodes, D = 0, drop out: as long as no scene touches with more than `max_touching` nodes,
    the systems have that size.
    """
    w, frame, most = increment.w, increment.frame, increment.max_touching
    inside = (
        jnp.einsum("bji,bnjk,bkl->bnil", frame, slope, frame),
        rotate(transpose(frame), right),
    )
    touches = jnp.any(slope != 0, axis=(2, 3))
    if most is None or most >= touches.shape[1]:
        return rotate(frame, _solve_all_nodes(w, *inside))
    few = _count_most_touching(jax.lax.stop_gradient(touches)) <= most
    solve_few = partial(_solve_touching_nodes, most)
    return rotate(frame, jax.lax.cond(few, solve_few, _solve_all_nodes, w, *inside))


@custom_vmap
def _count_most_touching(touches: Array) -> Array:
    """Count the touching nodes of the scene with most of them.

    Under vmap that is the scene of all. The branch that depends on it then stays one branch, or
    both of its sides would be worked out. XLA's CPU client was seen to wait for ever for two such
    factorisations of one loop.
    """
    return jnp.max(jnp.sum(touches, axis=-1))


@_count_most_touching.def_vmap
def _count_most_touching_rule(size: int, batched: list[bool], touches: Array) -> tuple[Array, bool]:
    return _count_most_touching(touches), False


def _solve_touching_nodes(most: int, w: Array, slope: Array, right: Array) -> Array:
    touches = jnp.any(slope != 0, axis=(2, 3))
    index = jnp.argsort(~touches, axis=1, stable=True)[:, :most]
    free = jnp.where(touches[..., None], 0, right)
    side = right - jnp.einsum("bnij,bnj->bni", slope, _multiply(w, free))
    take_nodes = jax.vmap(lambda row, i: row[i])
    nodes = right.shape[1]
    blocks = (
        w.T.reshape(nodes, 3, nodes, 3)
        .transpose(0, 2, 1, 3)[index[:, :, None], index[:, None]]
        .transpose(0, 1, 3, 2, 4)
    )
    solution = _solve_blocks(blocks, take_nodes(slope, index), take_nodes(side, index))
    values = jnp.where(take_nodes(touches, index)[..., None], solution, take_nodes(free, index))
    put_nodes = jax.vmap(lambda row, i, values: row.at[i].set(values, unique_indices=True))
    return put_nodes(free, index, values)


def _solve_all_nodes(w: Array, slope: Array, right: Array) -> Array:
    nodes = right.shape[1]
    return _solve_blocks(w.T.reshape(1, nodes, 3, nodes, 3), slope, right)


def _solve_blocks(blocks: Array, slope: Array, right: Array) -> Array:
    """Solve (I - D (I - W)) x = right for W as blocks (B or 1, M, 3, M, 3)."""
    count, nodes = right.shape[:2]
    one = jnp.eye(3 * nodes, dtype=right.dtype).reshape(1, nodes, 3, nodes, 3)
    matrix = one + jnp.einsum("bnij,bnjmk->bnimk", slope, blocks - one)
    factors = jax.scipy.linalg.lu_factor(matrix.reshape(count, 3 * nodes, 3 * nodes))
    return jax.vmap(jax.scipy.linalg.lu_solve)(factors, right.reshape(count, -1)).reshape(
        right.shape
    )
