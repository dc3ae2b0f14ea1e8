"""A half-space, which has closed forms, on the simulator's mesh and solver.

    body = make_half_space(0.499)
    trace = trace_forces(body, body.sphere(50.0), poses, friction)
    trace.force, trace.slip, trace.gap  # of every increment

The half-space is a half ball that is clamped far away: at 2,000 mm, where the first mm about its
axis is resolved. Everything here scales, so that a contact of k + 1/2 spacings of the contact nodes
is also a mesh of that fineness.
"""

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.simulator.contact_problem import (
    RHO,
    ContactProblem,
    Skin,
    System,
    make_undeformed_skins,
)
from jaxunshear.simulator.elasticity import (
    Compliance,
    Pins,
    compute_isotropic_stiffness,
    compute_response,
    sum_harmonics,
)
from jaxunshear.simulator.friction import Solver, advance_increment, make_increment
from jaxunshear.simulator.mesh import Mesh, QuarterDisk, find_edges
from jaxunshear.simulator.stimuli import Obstacles
from jaxunshear.simulator.systems import ScaledSystem

SPACING_MM = 0.1  # of the rings of contact nodes, and of the mesh below them
RINGS = 12
REACH = 2000.0
GROWTH = 1.5  # of the elements' size, layer by layer, outside the contact
LIMIT = 20000  # iterations of the solver, an increment


@dataclass(frozen=True)
class HalfSpace:
    """A half-space of modulus 1 MPa."""

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
        """Hertz' modulus E*."""
        return 1 / (1 - self.poisson**2)

    @property
    def shear_modulus(self) -> float:
        return 1 / (2 * (1 + self.poisson))

    @property
    def pull_modulus(self) -> float:
        """Mindlin's modulus G* = G / (2 - nu)."""
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
    tip = np.array([[0.0, 0.0, SPACING_MM]])  # condensing needs a pin; it is not used
    arcs = np.arange(rings + 1) * SPACING_MM
    response = compute_response(mesh, materials, arcs, Pins(tip, 0 * tip), 6 * (rings - 1))
    return HalfSpace(poisson, sum_harmonics(response))


def make_half_space_mesh(
    contact: float, h: float, growth: float = 1.25, reach: float = 60.0
) -> Mesh:
    """Make a half ball of radius `reach` x `contact`, clamped far away.

    Its flat face lies at z = 0, its body in z >= 0. It is fine within `contact` mm of the origin.
    """
    core = max(round(contact / h), 2)
    radii, step = [contact * 1.0], h
    while radii[-1] < reach * contact:
        step *= growth
        radii.append(radii[-1] + step)
    disk = QuarterDisk(contact, core, np.array(radii[1:]), np.zeros(0))
    points, elements, _ = disk.make_elements()
    on_face = points[:, 1] < 1e-9
    clamped = np.flatnonzero(np.abs(np.hypot(*points.T) - radii[-1]) < 1e-6 * radii[-1])
    no_skin = np.zeros(len(elements), bool)
    return Mesh(points, elements, no_skin, clamped, find_edges(points, elements, on_face))


class Trace(NamedTuple):
    """B motions over T increments (numpy), in the sensor frame."""

    force: np.ndarray  # (T + 1, B, N, 3) N, beginning at rest
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
    """Follow poses (T + 1, B, 6), as `follow_path` does, and trace every increment.

    The surface stands back from the face by `height` (N,). Only nodes `within_mm` of the axis are
    solved for. The forces of the others are zero, their gaps infinite.
    """
    near = np.flatnonzero(body.radius < within_mm)
    with jax.enable_x64(True):
        system, newtons = _build_system(body, height, near)
        mu = jnp.broadcast_to(jnp.asarray(friction, jnp.float64), (poses.shape[1],))
        increments = jax.device_get(
            _follow_increments(system, mu, jnp.asarray(poses, jnp.float64), tolerance)
        )
    count = len(body.nodes)

    def spread(values: np.ndarray, filler: float) -> np.ndarray:
        full = np.full((*values.shape[:2], count, *values.shape[3:]), filler)
        full[:, :, near] = values
        return full

    at_rest = np.zeros_like(increments.force[:1])
    force = np.concatenate([at_rest, increments.force]) * newtons
    return Trace(
        spread(force, 0.0),
        spread(increments.slip, 0.0),
        spread(increments.gap, np.inf),
        bool(increments.settled.all()),
        increments.iterations.sum(0),
    )


def make_press_poses(depth_mm: np.ndarray, steps: int) -> np.ndarray:
    """Make poses (steps + 2, B, 6) that go down to depth (B,) at once, and then stay.

    Add a motion to them for `trace_forces`.
    """
    poses = np.zeros((steps + 2, len(depth_mm), 6))
    poses[1:, :, 3] = depth_mm
    return poses


def _build_system(body: HalfSpace, height: np.ndarray, near: np.ndarray) -> ScaledSystem:
    """Build the float64 system of the nodes `near`."""
    unknowns = (3 * near[:, None] + np.arange(3)).ravel()
    w = body.w[np.ix_(unknowns, unknowns)]
    scale = np.trace(w) / len(w)
    w = w / scale
    nodes = np.column_stack([body.nodes[near, :2], height[near]])
    inverse = np.linalg.inv(w + RHO * np.eye(len(w)))
    shared = jnp.asarray(w)
    one = jnp.asarray(1.0)
    system = System(shared, jnp.asarray(inverse), shared, jnp.asarray(nodes), one, one)
    return ScaledSystem(system, 1 / scale)


class _Increments(NamedTuple):
    """What each of T increments of B scenes leaves behind."""

    force: jax.Array  # (T, B, N, 3) scaled
    slip: jax.Array  # (T, B, N, 2) mm
    gap: jax.Array  # (T, B, N) mm
    settled: jax.Array  # (T, B)
    iterations: jax.Array  # (T, B)


@partial(jax.jit, static_argnames="tolerance")
def _follow_increments(
    system: System, friction: jax.Array, poses: jax.Array, tolerance: float
) -> _Increments:
    flat = Obstacles(jnp.full((1, 5, 5), -10.0, poses.dtype))
    problem = ContactProblem(system, flat, jnp.zeros(poses.shape[1], jnp.int32), friction)
    solver = Solver(tolerance, LIMIT)

    def step(skin: Skin, pose: jax.Array) -> tuple[Skin, _Increments]:
        offset = make_increment(problem, skin, pose, skin.displacement).offset
        after, quality = advance_increment(problem, skin, pose, solver)
        slip_and_gap = offset + after.displacement
        # where nothing moves the skin is left as it is
        moved = jnp.any(pose != skin.pose, axis=-1)[:, None, None]
        slip = jnp.where(moved, slip_and_gap[..., :2], 0.0)
        settled = quality.residual_mm <= quality.tolerance_mm
        gap = slip_and_gap[..., 2]
        return after, _Increments(after.force, slip, gap, settled, quality.iterations)

    _, increments = jax.lax.scan(step, make_undeformed_skins(system, poses[0]), poses[1:])
    return increments
