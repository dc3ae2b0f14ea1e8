"""Contacts as arrays: B scenes that share one compliance, and the state of their skins."""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
from jax import Array

from jaxunshear.simulator.frame import matmul
from jaxunshear.simulator.obstacle import Obstacles


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

    Without `tilted` no pose of a path may tilt the sensor, and no rotations are computed.
    """

    system: System
    obstacles: Obstacles
    obstacle_index: Array  # (B,)
    friction: Array  # (B,) Coulomb coefficient
    tilted: bool = field(default=False, metadata={"static": True})


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
