"""Normal contact on a half-space: Hertz's sphere and Sneddon's flat punch (Johnson 1985, Contact Mechanics, ch. 3 and 4)."""

from typing import TypeVar

import numpy as np

from verification.half_space import SPACING_MM, HalfSpace, make_press_poses, trace_forces
from verification.verification_rows import Row, fit_order, make_comparison_row

SPHERE_MM = 50.0
Length = TypeVar("Length", float, np.ndarray)
SIZES = np.array(
    [3.5, 4.5, 6.5, 8.5, 10.5]
)  # contact radii in spacings; a rim midway between two rings is the discrete contact's own


def compute_hertz_load(body: HalfSpace, radius_mm: Length) -> Length:
    """Hertz's force (N) at contact radius (B,)."""
    return 4 / 3 * body.normal_modulus * radius_mm**3 / SPHERE_MM


def compute_hertz_depth(radius_mm: Length) -> Length:
    return radius_mm**2 / SPHERE_MM


def compute_hemisphere_radius(body: HalfSpace, weights: np.ndarray) -> np.ndarray:
    """Radius a of a distribution sqrt(a^2 - r^2) from its second moment; nodal weights (..., N) -> (...) mm."""
    return np.sqrt(2.5 * np.sum(weights * body.square_radius, -1) / np.sum(weights, -1))


def check_hertz(body: HalfSpace) -> list[Row]:
    a = SIZES * SPACING_MM
    made = trace_forces(
        body,
        body.sphere(SPHERE_MM),
        make_press_poses(compute_hertz_depth(a), 0),
        0.0,
        tolerance=1e-6,
    )
    force = made.force[-1, :, :, 2]
    peak = 2 * body.normal_modulus * a / (np.pi * SPHERE_MM)
    shape = np.sqrt(np.maximum(1 - (body.radius / a[:, None]) ** 2, 0)) * (
        body.radius < 0.7 * a[:, None]
    )
    fitted = np.sum(force * shape, -1) / np.sum(shape**2, -1) / body.node_area
    found = {
        "force P = 4/3 E* sqrt(R) d^1.5, N": (
            compute_hertz_load(body, a),
            force.sum(-1),
            0.01,
            1.5,
        ),
        "contact radius sqrt(R d), by second moment, mm": (
            a,
            compute_hemisphere_radius(body, force),
            0.02,
            1.5,
        ),
        "peak pressure 2 E* a / (pi R), fitted within 0.7 a, MPa": (peak, fitted, 0.02, None),
    }
    rows = []
    for problem, (exact, measured, bar, least) in found.items():
        order = None if least is None else fit_order(1 / SIZES, measured / exact - 1)
        note = f"a = {SIZES[-1]:g} spacings of the nodes"
        rows.append(
            make_comparison_row(
                "Hertz",
                problem,
                exact[-1],
                measured[-1],
                bar,
                order=order,
                least_order=least,
                settled=made.settled,
                note=note,
            )
        )
    return rows


def check_flat_punch(body: HalfSpace) -> list[Row]:
    """Pressed without friction; pressed, then slid or turned with its face stuck."""
    push, angle = 0.01, 0.005
    poses = make_press_poses(np.full(3, push), 1)
    poses[2, 1, 0] = push / 2
    poses[2, 2, 2] = angle
    sizes = SIZES[1:]
    found, settled = [], True
    for size in sizes:
        face = np.where(body.radius < size * SPACING_MM, 0.0, 1e3)
        made = trace_forces(body, face, poses, np.array([0.0, np.inf, np.inf]))
        settled &= made.settled
        found.append(
            [made.total[-1, 0, 2], -made.total[-1, 1, 0], compute_moment(body, made.force[-1, 2])]
        )
    a = sizes * SPACING_MM
    exact = np.stack(
        [
            2 * a * body.normal_modulus * push,
            8 * a * body.pull_modulus * push / 2,
            16 / 3 * body.shear_modulus * a**3 * angle,
        ],
        -1,
    )
    problems = (
        "force 2 a E* d, N",
        "stuck pull 8 a G* x, N",
        "stuck moment 16/3 G a^3 theta, N mm",
    )
    return [
        make_comparison_row(
            "flat punch",
            problem,
            exact[-1, i],
            np.array(found)[-1, i],
            0.03,
            order=fit_order(1 / sizes, np.array(found)[:, i] / exact[:, i] - 1),
            least_order=0.7,
            settled=settled,
            note=f"a = {sizes[-1]:g} spacings",
        )
        for i, problem in enumerate(problems)
    ]


def compute_moment(body: HalfSpace, force: np.ndarray) -> np.ndarray:
    """About the axis, against the turn of the sensor: force (..., N, 3) in N -> (...) N mm."""
    x, y = body.nodes[:, :2].T
    return np.sum(y * force[..., 0] - x * force[..., 1], -1)
