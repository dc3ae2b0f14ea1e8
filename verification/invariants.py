"""Laws that every solution must obey: on random paths, turned, refined and scaled."""

from typing import NamedTuple

import numpy as np

from jaxunshear.simulator.elasticity import (
    Compliance,
    Pins,
    compute_isotropic_stiffness,
    compute_response,
    sum_harmonics,
)
from jaxunshear.simulator.mesh import make_dome_mesh
from verification.half_space import SPACING_MM, HalfSpace, Trace, make_press_poses, trace_forces
from verification.normal_contact import SPHERE_MM, compute_hertz_depth
from verification.tangential_contact import FRICTION, compute_slip_distance
from verification.verification_rows import Row, Rows, fit_order

GROUP = "laws of every answer"
RADIUS_MM = 5.5 * SPACING_MM  # of the contact


def _trace(body: HalfSpace, poses: np.ndarray, tolerance: float = 1e-5) -> Trace:
    """Trace a sphere that is as deep as makes the contact RADIUS_MM wide."""
    height, within_mm = body.sphere(SPHERE_MM), 1.3 * RADIUS_MM
    return trace_forces(body, height, poses, FRICTION, within_mm, tolerance)


def make_random_paths(
    body: HalfSpace, count: int = 8, steps: int = 24, seed: int = 0
) -> np.ndarray:
    """Make poses (steps + 1, count, 6) of random walks in x, y, yaw and depth.

    They slip, stick, lift off and touch again.
    """
    generator = np.random.default_rng(seed)
    stride, deep = 0.5 * compute_slip_distance(body, RADIUS_MM), compute_hertz_depth(RADIUS_MM)
    walk = generator.normal(size=(steps, count, 4)) * np.array(
        [stride, stride, stride / RADIUS_MM, 0.3 * deep]
    )
    poses = np.zeros((steps + 1, count, 6))
    poses[1:, :, :4] = np.cumsum(walk, axis=0)
    poses[1:, :, 3] = np.minimum(deep - np.abs(poses[1:, :, 3]), deep)
    return poses


def check_random_paths(body: HalfSpace) -> list[Row]:
    """Check over random paths that nothing pulls, penetrates, or does work by friction."""
    trace = _trace(body, make_random_paths(body))
    force, slip = trace.force[1:], trace.slip
    pull, push = np.linalg.norm(force[..., :2], axis=-1), force[..., 2]
    most, deep = push.max(), compute_hertz_depth(RADIUS_MM)
    gap = np.where(np.isfinite(trace.gap), trace.gap, 0.0)
    power = -np.sum(force[..., :2] * slip, axis=-1)
    heat = FRICTION * np.sum(push * np.linalg.norm(slip, axis=-1))
    adhesion, excess = max(-push.min(), 0.0), (pull - FRICTION * push).max()
    note = "over 8 random paths of 24 increments with twists and lift-offs"
    rows = Rows(GROUP)
    words = "adhesion: least pressure, of the largest"
    rows.expect_zero(words, adhesion, most, 1e-12, note=note)
    rows.expect_zero("pull beyond mu p, of the largest pressure", excess, most, 1e-9)
    gained = -np.minimum(power, 0).sum()
    product = np.abs(push * gap).max()
    for words, value, scale in (
        ("penetration, of the depth", max(-gap.min(), 0.0), deep),
        ("pressure x gap, of the largest x the depth", product, most * deep),
        ("dissipation below zero, summed, of all heat", gained, heat),
        ("pull that is not against the slip, of all heat", heat - power.sum(), heat),
    ):
        rows.expect_zero(words, value, scale, 1e-3, settled=trace.settled)
    return rows


def check_compliance(body: HalfSpace) -> list[Row]:
    """Check that W is symmetric and positive definite."""
    values = np.linalg.eigvalsh(body.w)
    ratio, error = values[0] / values[-1], min(values[0], 0.0) / values[-1]
    asymmetry = np.abs(body.w - body.w.T).max()
    rows = Rows(GROUP)
    words = "compliance W: asymmetry, of its largest entry"
    rows.expect_zero(words, asymmetry, body.w.max(), 1e-12)
    words = "compliance W: least eigenvalue over the largest"
    return [*rows, Row(GROUP, words, None, ratio, error, 0.0)]


def check_no_contact(body: HalfSpace) -> list[Row]:
    poses = np.zeros((4, 1, 6))
    poses[:, 0, 0], poses[:, 0, 3] = np.linspace(0, 1, 4), -0.01
    force = np.abs(_trace(body, poses).force).max()
    rows = Rows(GROUP)
    rows.expect_zero("no contact: largest force, exactly zero", force, 1.0, 0.0)
    return rows


def _make_slides(body: HalfSpace, angles: np.ndarray, share: float, steps: int) -> np.ndarray:
    poses = make_press_poses(np.full(len(angles), compute_hertz_depth(RADIUS_MM)), steps)
    along = np.linspace(0, 1, steps + 1)[1:, None] * share * compute_slip_distance(body, RADIUS_MM)
    poses[2:, :, 0], poses[2:, :, 1] = along * np.cos(angles), along * np.sin(angles)
    return poses


def check_rotation(body: HalfSpace) -> list[Row]:
    """Check that a slide in another direction has the same force, turned.

    Turned by 60 deg the lattice of the nodes is the same, by other angles it is not.
    """
    angles = np.radians([0.0, 60.0, 17.0, 30.0, 45.0])
    trace = _trace(body, _make_slides(body, angles, 0.6, 4), tolerance=1e-7)
    cos, sin = np.cos(angles), np.sin(angles)
    x, y, z = trace.total[-1].T
    back = np.stack([cos * x + sin * y, -sin * x + cos * y, z], -1)
    change = np.linalg.norm(back - back[0], axis=-1) / np.linalg.norm(back[0])
    rows = Rows(GROUP)
    words = "slide turned by 60 deg: change of the force"
    rows.expect_zero(words, change[1], 1.0, 1e-5, settled=trace.settled)
    words = "slide turned by 17, 30, 45 deg: change of the force"
    rows.expect_zero(words, change[2:].max(), 1.0, 1e-3, note="lattice of the nodes")
    return rows


def check_full_slip(body: HalfSpace) -> list[Row]:
    trace = _trace(body, _make_slides(body, np.zeros(1), 2.0, 4))
    x, y, z = trace.total[-1, 0]
    rows = Rows(GROUP, trace.settled)
    rows.compare("full slip: Q / P", FRICTION, np.hypot(x, y) / z, 1e-4)
    return rows


def check_closed_loop(body: HalfSpace) -> list[Row]:
    """Press, circle, lift off, and check that all work of the motion has become heat.

    The body must store nothing at the end.
    """
    counts = np.array([12, 24, 48, 96])
    share = np.minimum(np.arange(counts[-1] + 1)[:, None] / counts, 1.0)
    radius, angle = 1.5 * compute_slip_distance(body, RADIUS_MM), np.clip(3 * share - 1, 0, 1)
    poses = _make_arc(radius, 2 * np.pi * angle)
    depth = np.clip(np.minimum(3 * share, 3 - 3 * share), 0, 1)
    poses[..., 3] = compute_hertz_depth(RADIUS_MM) * depth
    trace = _trace(body, poses)
    work, heat, stored = compute_energies(body, trace, poses)
    rows = Rows(GROUP)
    words = "closed loop: heat of all slips over the motion's work"
    convergence = {"order": fit_order(1 / counts, heat / work - 1), "least_order": 0.8}
    details = {"settled": trace.settled, "note": f"order in increments; {counts[-1]} of them"}
    rows.compare(words, 1.0, heat[-1] / work[-1], 0.03, **convergence, **details)
    words = "closed loop: energy still stored, of the work"
    rows.expect_zero(words, stored[-1], work[-1], 1e-9)
    return rows


def check_increment_order(body: HalfSpace) -> list[Row]:
    """Check the order in increments of a slide whose direction turns all along."""
    counts = np.array([4, 8, 16, 32, 64])
    share = np.minimum(np.arange(counts[-1] + 1)[:, None] / counts, 1.0)
    poses = make_press_poses(np.full(len(counts), compute_hertz_depth(RADIUS_MM)), counts[-1])
    poses[1:] += _make_arc(compute_slip_distance(body, RADIUS_MM), np.pi / 2 * share)
    trace = _trace(body, poses)
    force = trace.force[-1]
    change = np.linalg.norm(np.diff(force, axis=0), axis=(1, 2)) / np.linalg.norm(force[-1])
    rows = Rows(GROUP, trace.settled)
    words = f"quarter circle in {counts[-1]} increments against {counts[-2]}: nodal forces"
    convergence = {"order": fit_order(1 / counts[1:], change), "least_order": 0.8}
    rows.expect_zero(words, change[-1], 1.0, 0.02, note="order in increments", **convergence)
    return rows


def _make_arc(radius_mm: float, angle: np.ndarray) -> np.ndarray:
    """Make poses (T, B, 6) on a circle through the origin, at depth 0."""
    poses = np.zeros((*angle.shape, 6))
    poses[..., 0], poses[..., 1] = radius_mm * np.sin(angle), radius_mm * (1 - np.cos(angle))
    return poses


class Energies(NamedTuple):
    """Energies of B motions, each (B,) N mm."""

    work: np.ndarray  # of the motion
    heat: np.ndarray  # mu p |slip|
    stored: np.ndarray  # at the end


def compute_energies(body: HalfSpace, trace: Trace, poses: np.ndarray) -> Energies:
    """Compute the energies; work is the trapezia of the force along x, y and depth."""
    mean = (trace.total[1:] + trace.total[:-1]) / 2
    change = np.diff(poses, axis=0)
    along = np.sum(mean[..., :2] * change[..., :2], -1)
    work = np.sum(mean[..., 2] * change[..., 3] - along, axis=0)
    slip = np.linalg.norm(trace.slip, axis=-1)
    heat = FRICTION * np.sum(trace.force[1:, ..., 2] * slip, axis=(0, 2))
    last = trace.force[-1].reshape(trace.force.shape[1], -1)
    return Energies(work, heat, np.einsum("bi,ij,bj->b", last, body.w, last) / 2)


def check_tolerance_order(body: HalfSpace) -> list[Row]:
    """Check the order in the tolerance of a slide, against one solved far more exactly."""
    tolerances = (1e-3, 1e-4, 1e-5, 1e-6)
    poses = _make_slides(body, np.zeros(1), 0.6, 4)
    exact = _trace(body, poses, 1e-8).force[-1]
    misses = [_trace(body, poses, tolerance).force[-1] - exact for tolerance in tolerances]
    errors = np.array([np.linalg.norm(miss) for miss in misses]) / np.linalg.norm(exact)
    rows = Rows(GROUP)
    words = "nodal forces at tolerance 1e-6 against 1e-8"
    convergence = {"order": fit_order(tolerances, errors), "least_order": 0.7}
    rows.expect_zero(words, errors[-1], 1.0, 1e-3, note="order in the tolerance", **convergence)
    return rows


def check_scaling() -> list[Row]:
    """Check that a small dome's compliance scales with its moduli and its lengths."""
    rings, pins = 5, np.array([[3.0, 0.0, 2.5], [0.0, 4.0, 3.0]])

    def compute_scaled_compliance(size: float, modulus: float) -> Compliance:
        mesh = make_dome_mesh(20.0 * size, 1.0 * size, 3.0 * size)
        gel = compute_isotropic_stiffness(0.1 * modulus, 0.49)
        skin = compute_isotropic_stiffness(modulus, 0.49)
        materials = np.where(mesh.skin[:, None, None], skin, gel)
        arcs = np.arange(rings + 1) * 2.0 * size
        tips = pins * size
        return sum_harmonics(
            compute_response(mesh, materials, arcs, Pins(tips, 0 * tips), 6 * (rings - 1))
        )

    base = compute_scaled_compliance(1.0, 1.0)

    def compute_change(other: Compliance, factor: float) -> float:
        change_w = np.abs(factor * other.w - base.w).max() / np.abs(base.w).max()
        change_g = np.abs(factor * other.g - base.g).max() / np.abs(base.g).max()
        return float(max(change_w, change_g))

    rows = Rows(GROUP)
    for words, size, modulus in (
        ("moduli x 1e6: compliances W, G x 1e-6", 1.0, 1e6),
        ("lengths x 3: compliances W, G / 3", 3.0, 1.0),
    ):
        change = compute_change(compute_scaled_compliance(size, modulus), size * modulus)
        rows.expect_zero(f"{words}, largest change", change, 1.0, 1e-9)
    return rows
