"""A half-space, the body for which closed forms exist, put through the simulator's own mesh, condensation and solver.

    body = make_half_space(0.499)
    made = trace_forces(body, body.sphere(50.0), poses, friction)   # every increment's forces, slips and gaps

The half-space is a half ball that is clamped far away: at 2,000 mm, where what is resolved is the first mm about its axis.
Everything here scales, so that a contact of k + 1/2 spacings of the contact nodes is also a mesh of that fineness.
"""

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.simulator.admm import RHO, SolverOptions
from jaxunshear.simulator.contact_problem import ContactProblem, Skin, System
from jaxunshear.simulator.elasticity import Compliance, compute_isotropic_stiffness, condense
from jaxunshear.simulator.friction import (
    advance_increment,
    compute_increment_offset,
    make_undeformed_skins,
)
from jaxunshear.simulator.mesh import make_half_space_mesh
from jaxunshear.simulator.obstacle import Obstacles

SPACING_MM = 0.1  # of the rings of contact nodes, and of the mesh below them
RINGS = 12
REACH = 2000.0
GROWTH = 1.5  # of the elements' size, layer by layer, outside the contact
LIMIT = 20000  # iterations of the solver, an increment


@dataclass(frozen=True)
class HalfSpace:
    """Of modulus 1 MPa."""

    poisson: float
    compliance: Compliance

    @property
    def nodes(self) -> np.ndarray:
        """(N, 3) mm, on the face."""
        return self.compliance.nodes

    @property
    def w(self) -> np.ndarray:
        """(3N, 3N) mm/N."""
        return self.compliance.w

    @property
    def normal_modulus(self) -> float:
        """E* of Hertz."""
        return 1 / (1 - self.poisson**2)

    @property
    def shear_modulus(self) -> float:
        return 1 / (2 * (1 + self.poisson))

    @property
    def pull_modulus(self) -> float:
        """G* of Mindlin: G / (2 - nu)."""
        return self.shear_modulus / (2 - self.poisson)

    @property
    def radius(self) -> np.ndarray:
        """(N,) mm from the axis."""
        return np.hypot(self.nodes[:, 0], self.nodes[:, 1])

    @property
    def node_area(self) -> float:
        """mm^2 below a node's hat: the same for all, the apex included."""
        return np.pi * SPACING_MM**2 / 3

    @property
    def square_radius(self) -> np.ndarray:
        """(N,) mean of r^2 under a node's hat: what a force there adds to a second moment."""
        return self.radius**2 + np.where(self.radius > 0, 0.5, 0.3) * SPACING_MM**2

    def sphere(self, radius_mm: float) -> np.ndarray:
        """(N,) mm by which a sphere's parabola stands back from the face."""
        return self.radius**2 / (2 * radius_mm)


@lru_cache(maxsize=4)
def make_half_space(poisson: float, rings: int = RINGS) -> HalfSpace:
    mesh = make_half_space_mesh(
        rings * SPACING_MM, SPACING_MM, growth=GROWTH, reach=REACH / (rings * SPACING_MM)
    )
    materials = np.broadcast_to(
        compute_isotropic_stiffness(1.0, poisson), (len(mesh.elements), 6, 6)
    )
    inside = np.array([[0.0, 0.0, SPACING_MM]])  # a pin that nobody asks for
    made = condense(mesh, materials, np.arange(rings + 1) * SPACING_MM, inside, 6 * (rings - 1))
    return HalfSpace(poisson, made)


class Trace(NamedTuple):
    """B motions over T increments (numpy), in the sensor frame. `force` (T + 1, B, N, 3) in N begins at rest."""

    force: np.ndarray
    slip: np.ndarray  # (T, B, N, 2) mm of each increment
    gap: np.ndarray  # (T, B, N) mm
    settled: bool  # every increment below its tolerance
    iterations: np.ndarray  # (B,)

    @property
    def total(self) -> np.ndarray:
        """(T + 1, B, 3) N."""
        return self.force.sum(axis=2)


def trace_forces(
    body: HalfSpace,
    height: np.ndarray,
    poses: np.ndarray,
    friction: np.ndarray | float,
    within_mm: float = np.inf,
    tolerance: float = 1e-5,
) -> Trace:
    """Follow poses (T + 1, B, 6), as of `follow_path`, over a surface that stands back by `height` (N,).

    Only nodes `within_mm` of the axis are solved for. The forces of the others are zero, their gaps infinite.
    """
    chosen = np.flatnonzero(body.radius < within_mm)
    with jax.enable_x64(True):
        system, newtons = _system(body, height, chosen)
        mu = jnp.broadcast_to(jnp.asarray(friction, jnp.float64), (poses.shape[1],))
        force, slip, gap, settled, iterations = jax.device_get(
            _scan(system, mu, jnp.asarray(poses, jnp.float64), tolerance)
        )
    count = len(body.nodes)

    def spread(values: np.ndarray, filler: float) -> np.ndarray:
        full = np.full((*values.shape[:2], count, *values.shape[3:]), filler)
        full[:, :, chosen] = values
        return full

    force = np.concatenate([np.zeros_like(force[:1]), force]) * newtons
    return Trace(
        spread(force, 0.0),
        spread(slip, 0.0),
        spread(gap, np.inf),
        bool(settled.all()),
        iterations.sum(0),
    )


def make_press_poses(depth_mm: np.ndarray, steps: int) -> np.ndarray:
    """Poses (steps + 2, B, 6) that go down to depth (B,) at once, and then stay: what `trace_forces` may be given a motion by."""
    poses = np.zeros((steps + 2, len(depth_mm), 6))
    poses[1:, :, 3] = depth_mm
    return poses


def _system(body: HalfSpace, height: np.ndarray, chosen: np.ndarray) -> tuple[System, float]:
    """Float64, and newtons per scaled force."""
    unknowns = (3 * chosen[:, None] + np.arange(3)).ravel()
    w = body.w[np.ix_(unknowns, unknowns)]
    scale = np.trace(w) / len(w)
    w = w / scale
    nodes = np.column_stack([body.nodes[chosen, :2], height[chosen]])
    inverse = np.linalg.inv(w + RHO * np.eye(len(w)))
    shared = jnp.asarray(w)
    return System(
        shared, jnp.asarray(inverse), shared, jnp.asarray(nodes), jnp.asarray(1.0)
    ), 1 / scale


class _Increments(NamedTuple):
    """What each of T increments of B scenes leaves behind."""

    force: jax.Array  # (T, B, N, 3) scaled
    slip: jax.Array  # (T, B, N, 2) mm
    gap: jax.Array  # (T, B, N) mm
    settled: jax.Array  # (T, B)
    iterations: jax.Array  # (T, B)


@partial(jax.jit, static_argnames="tolerance")
def _scan(system: System, friction: jax.Array, poses: jax.Array, tolerance: float) -> _Increments:
    flat = Obstacles(jnp.full((1, 5, 5), -10.0, poses.dtype))
    problem = ContactProblem(system, flat, jnp.zeros(poses.shape[1], jnp.int32), friction)
    options = SolverOptions(tolerance, LIMIT)

    def step(skin: Skin, pose: jax.Array) -> tuple[Skin, _Increments]:
        offset = compute_increment_offset(problem, skin, pose, skin.displacement)
        after, quality = advance_increment(problem, skin, pose, options)
        apart = offset + after.displacement
        # where nothing moves the skin is left as it is
        moved = jnp.any(pose != skin.pose, axis=-1)[:, None, None]
        slip = jnp.where(moved, apart[..., :2], 0.0)
        settled = quality.residual_mm <= quality.tolerance_mm
        return after, _Increments(after.force, slip, apart[..., 2], settled, quality.iterations)

    _, increments = jax.lax.scan(step, make_undeformed_skins(system, poses[0]), poses[1:])
    return increments
