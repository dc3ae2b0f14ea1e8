"""Contacts as arrays: B scenes that share one compliance, and the state of their skins."""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxunshear.simulator.frame import Frame, compute_level_frame, matmul, rotate
from jaxunshear.simulator.obstacle import Obstacles

ROTATION_ROUNDING = 1e-6  # of a force, what turning it to and fro in float32 may add to its pull
MIN_PULL = 1e-33  # smaller ones lose digits, or components, to the end of float32's range


class System(NamedTuple):
    """The compliance of N nodes with d unknowns each.

    d is 3, or 1 (pressure only) where no scene has friction. `w` is scaled to a unit mean diagonal.
    """

    w: Array  # (dN, dN)
    inverse: Array  # (dN, dN) of w + RHO times the identity
    spread: Array  # (dN, 3N) moves the nodes in all directions; w itself where d = 3
    nodes: Array  # (N, 3) mm
    centre_mm: Array  # () height of the dome's centre above its apex

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
