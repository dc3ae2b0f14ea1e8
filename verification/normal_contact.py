"""Normal contact on a half-space: Hertz's sphere and Sneddon's flat punch.

See Johnson 1985, Contact Mechanics, ch. 3 and 4.
"""

from typing import TypeVar

import numpy as np

from verification.half_space import SPACING_MM, HalfSpace, make_press_poses, trace_forces
from verification.verification_rows import Row, Rows, fit_order

SPHERE_MM = 50.0
Length = TypeVar("Length", float, np.ndarray)
# contact radii in spacings; a rim midway between two rings is the discrete contact's own
SIZES = np.array([3.5, 4.5, 6.5, 8.5, 10.5])


def compute_hertz_load(body: HalfSpace, radius_mm: Length) -> Length:
    """Compute Hertz's force (N) at contact radius (B,)."""
    return 4 / 3 * body.normal_modulus * radius_mm**3 / SPHERE_MM


def compute_hertz_depth(radius_mm: Length) -> Length:
    return radius_mm**2 / SPHERE_MM


def compute_hemisphere_radius(body: HalfSpace, weights: np.ndarray) -> np.ndarray:
    """Compute the radius a of a distribution sqrt(a^2 - r^2) from its second moment.

    Nodal weights (..., N) -> (...) mm.
    """
    return np.sqrt(2.5 * np.sum(weights * body.square_radius, -1) / np.sum(weights, -1))


def check_hertz(body: HalfSpace) -> list[Row]:
    """Check force, radius and peak pressure of a pressed sphere."""
    a = SIZES * SPACING_MM
    poses = make_press_poses(compute_hertz_depth(a), 0)
    trace = trace_forces(body, body.sphere(SPHERE_MM), poses, 0.0, tolerance=1e-6)
    force = trace.force[-1, :, :, 2]
    load, radius = compute_hertz_load(body, a), compute_hemisphere_radius(body, force)
    peak = 2 * body.normal_modulus * a / (np.pi * SPHERE_MM)
    shape = np.sqrt(np.maximum(1 - (body.radius / a[:, None]) ** 2, 0))
    shape = shape * (body.radius < 0.7 * a[:, None])
    fitted = np.sum(force * shape, -1) / np.sum(shape**2, -1) / body.node_area
    rows = Rows("Hertz", trace.settled)
    for problem, exact, measured, bar, least in (
        ("force P = 4/3 E* sqrt(R) d^1.5, N", load, force.sum(-1), 0.01, 1.5),
        ("contact radius sqrt(R d), by second moment, mm", a, radius, 0.02, 1.5),
        ("peak pressure 2 E* a / (pi R), fitted within 0.7 a, MPa", peak, fitted, 0.02, None),
    ):
        order = None if least is None else fit_order(1 / SIZES, measured / exact - 1)
        note = f"a = {SIZES[-1]:g} spacings of the nodes"
        convergence = {"order": order, "least_order": least, "note": note}
        rows.compare(problem, exact[-1], measured[-1], bar, **convergence)
    return rows


def check_flat_punch(body: HalfSpace) -> list[Row]:
    """Check a punch pressed without friction, and slid or turned with its face stuck."""
    push, angle = 0.01, 0.005
    poses = make_press_poses(np.full(3, push), 1)
    poses[2, 1, 0] = push / 2
    poses[2, 2, 2] = angle
    sizes = SIZES[1:]
    results, settled = [], True
    for size in sizes:
        face = np.where(body.radius < size * SPACING_MM, 0.0, 1e3)
        trace = trace_forces(body, face, poses, np.array([0.0, np.inf, np.inf]))
        settled &= trace.settled
        moment = compute_moment(body, trace.force[-1, 2])
        results.append([trace.total[-1, 0, 2], -trace.total[-1, 1, 0], moment])
    measured = np.array(results)
    a = sizes * SPACING_MM
    closed_forms = {
        "force 2 a E* d, N": 2 * a * body.normal_modulus * push,
        "stuck pull 8 a G* x, N": 8 * a * body.pull_modulus * push / 2,
        "stuck moment 16/3 G a^3 theta, N mm": 16 / 3 * body.shear_modulus * a**3 * angle,
    }
    rows = Rows("flat punch", settled)
    for (problem, exact), values in zip(closed_forms.items(), measured.T, strict=True):
        convergence = {"order": fit_order(1 / sizes, values / exact - 1), "least_order": 0.7}
        note = f"a = {sizes[-1]:g} spacings"
        rows.compare(problem, exact[-1], values[-1], 0.03, note=note, **convergence)
    return rows


def compute_moment(body: HalfSpace, force: np.ndarray) -> np.ndarray:
    """Compute moments (...) N mm about the axis, against the sensor's turn, of forces in N."""
    x, y = body.nodes[:, :2].T
    return np.sum(y * force[..., 0] - x * force[..., 1], -1)
