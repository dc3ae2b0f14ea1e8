"""Friction on a half-space against Cattaneo and Mindlin, Mindlin and Deresiewicz, and torsion (Johnson 1985, ch. 7).

Their theory drops what the normal load does to the tangential displacement, and all slip that is
not along the pull: the first is exact for an incompressible body, for which these problems are
therefore posed.
"""

import numpy as np

from verification.half_space import SPACING_MM, HalfSpace, make_press_poses, trace_forces
from verification.normal_contact import (
    SIZES,
    SPHERE_MM,
    Length,
    compute_hemisphere_radius,
    compute_hertz_depth,
    compute_hertz_load,
    compute_moment,
)
from verification.verification_rows import Row, fit_order, make_comparison_row, make_zero_row

FRICTION = 0.5


def compute_slip_distance(body: HalfSpace, radius_mm: Length) -> Length:
    """The slide (mm) after which a stuck contact slips fully: 3 mu P / (16 a G*)."""
    return 3 * FRICTION * compute_hertz_load(body, radius_mm) / (16 * radius_mm * body.pull_modulus)


def _slides(
    body: HalfSpace, radius_mm: np.ndarray, shares: np.ndarray, steps: int = 4
) -> np.ndarray:
    poses = make_press_poses(compute_hertz_depth(radius_mm), steps)
    poses[2:, :, 0] = (
        np.linspace(0, 1, steps + 1)[1:, None] * shares * compute_slip_distance(body, radius_mm)
    )
    return poses


def check_cattaneo_mindlin(
    body: HalfSpace, sizes: np.ndarray = SIZES, exact: bool = True
) -> list[Row]:
    """Q and the stick radius c of slides by shares of the slip distance; `exact` False: to inform."""
    group = (
        "Cattaneo-Mindlin"
        if exact
        else f"Cattaneo-Mindlin at nu = {body.poisson:g}, where it is an approximation"
    )
    bar = 0.02 if exact else None
    shares = np.array([0.2, 0.4, 0.6, 0.8, 1.5])
    a = np.repeat(sizes * SPACING_MM, len(shares))
    made = trace_forces(
        body, body.sphere(SPHERE_MM), _slides(body, a, np.tile(shares, len(sizes))), FRICTION
    )
    pull = (-made.total[-1, :, 0] / (FRICTION * compute_hertz_load(body, a))).reshape(
        len(sizes), -1
    )
    stick = (compute_hemisphere_radius(body, compute_stuck_part(made.force[-1])) / a).reshape(
        len(sizes), -1
    )[:, :-1]
    expected, radius = 1 - np.maximum(0, 1 - shares) ** 1.5, np.sqrt(1 - shares[:-1])
    rows = []
    for share, right, found in zip(shares, expected, pull[-1], strict=True):
        words = f"pull after {share:g} slip distances, Q / (mu P)"
        rows.append(make_comparison_row(group, words, right, found, bar, settled=made.settled))
    for right, found in zip(radius, stick[-1], strict=True):
        words = f"stick radius there, c / a = {right:.3f}, by second moment"
        note = f"c = {sizes[-1] * right:.1f} spacings"
        rows.append(
            make_comparison_row(group, words, right, found, bar, settled=made.settled, note=note)
        )
    if exact:
        errors = np.sqrt(np.mean((stick / radius - 1) ** 2, axis=1))
        words = "relative error of these stick radii, rms"
        order = fit_order(1 / sizes, errors)
        rows.append(
            make_zero_row(
                group,
                words,
                errors[-1],
                1.0,
                bar,
                order=order,
                least_order=1.0,
                settled=made.settled,
            )
        )
    return rows


def compute_stuck_part(force: np.ndarray) -> np.ndarray:
    """mu p - |q| (..., N): in theory a hemisphere over the stick area and zero outside it; force (..., N, 3)."""
    return np.maximum(FRICTION * force[..., 2] - np.hypot(force[..., 0], force[..., 1]), 0.0)


def check_oblique(body: HalfSpace, size: float = 7.5) -> list[Row]:
    """Pressed and slid at once: what touches later has been dragged less. Without slip Q / P = 2 (1 - nu) / (2 - nu) x / d."""
    counts = np.array([4, 8, 16, 32, 64])
    steps = np.minimum(np.arange(counts[-1] + 1)[:, None] / counts, 1.0)
    poses = np.zeros((*steps.shape, 6))
    deep, slope = compute_hertz_depth(size * SPACING_MM), 0.4
    poses[..., 3], poses[..., 0] = steps * deep, steps * slope * deep
    made = trace_forces(
        body, body.sphere(SPHERE_MM), poses, FRICTION, within_mm=1.15 * size * SPACING_MM
    )
    total = made.total[-1]
    ratio = -total[:, 0] / total[:, 2]
    exact = slope * 2 * (1 - body.poisson) / (2 - body.poisson)
    order = fit_order(1 / counts[:-1], np.diff(ratio))
    words = "oblique press without slip (Mindlin and Deresiewicz), Q / P"
    return [
        make_comparison_row(
            "Mindlin-Deresiewicz",
            words,
            exact,
            ratio[-1],
            0.02,
            order=order,
            least_order=0.8,
            settled=made.settled,
            note="order in increments",
        )
    ]


def check_cycle(body: HalfSpace, size: float = 8.5, share: float = 0.8) -> list[Row]:
    """A slide to and fro: the work of the pull over a closed cycle, and the heat of its slips."""
    counts = np.array([3, 6, 12, 24])  # increments from end to end
    a = size * SPACING_MM
    reach = share * compute_slip_distance(body, a)
    number = np.arange(2 * counts[-1] + 1)[:, None] / counts
    along = np.concatenate(
        [
            np.zeros((2, len(counts))),
            np.where(number < 1, 1 - 2 * number, np.minimum(2 * number - 3, 1)),
        ]
    )
    poses = make_press_poses(np.full(len(counts), compute_hertz_depth(a)), len(along) - 2)
    poses[2:, :, 0] = reach * along[2:]
    made = trace_forces(body, body.sphere(SPHERE_MM), poses, FRICTION, within_mm=1.15 * a)
    pull, place = -made.total[2:, :, 0], poses[2:, :, 0]
    work = np.sum(np.diff(place, axis=0) * (pull[1:] + pull[:-1]) / 2, axis=0)
    limit = FRICTION * made.force[3:, :, :, 2]
    heat = np.sum(limit * np.linalg.norm(made.slip[2:], axis=-1), axis=(0, 2))
    x = 1 - (1 - share) ** 1.5
    full = FRICTION * compute_hertz_load(body, a)
    loss = 9 * full**2 / (10 * a * body.pull_modulus)
    loss *= 1 - (1 - x) ** (5 / 3) - 5 * x / 6 * (1 + (1 - x) ** (2 / 3))
    words = "loss of a cycle (Mindlin and Deresiewicz), N mm"
    return [
        make_comparison_row(
            "Mindlin-Deresiewicz",
            f"{words}: the pull's work",
            loss,
            work[-1],
            0.03,
            order=fit_order(1 / counts, work - heat[-1]),
            least_order=1.0,
            settled=made.settled,
            note="order in increments",
        ),
        make_comparison_row(
            "Mindlin-Deresiewicz", f"{words}: heat", loss, heat[-1], 0.03, settled=made.settled
        ),
    ]


def check_torsion(body: HalfSpace) -> list[Row]:
    """A sphere, pressed and then twisted about its normal: fully stuck, and fully slipping."""
    rows = []
    for sizes, words in (
        (np.array([4.5, 6.5, 8.5, 10.5]), ""),
        (np.array([5.0, 7.0, 9.0, 11.0]), ", rim on a ring"),
    ):
        a = sizes * SPACING_MM
        angle = 1e-3
        poses = make_press_poses(compute_hertz_depth(a), 1)
        poses[2:, :, 2] = angle
        made = trace_forces(body, body.sphere(SPHERE_MM), poses, np.inf)
        exact = 16 / 3 * body.shear_modulus * a**3 * angle
        measured = compute_moment(body, made.force[-1])
        midway = not words
        rows.append(
            make_comparison_row(
                "torsion",
                f"stuck, M = 16/3 G a^3 theta, N mm{words}",
                exact[-1],
                measured[-1],
                0.03 if midway else None,
                order=fit_order(1 / sizes, measured / exact - 1),
                least_order=0.7 if midway else None,
                settled=made.settled,
                note=""
                if midway
                else "the rim's place between two rings is worth up to half a spacing of radius",
            )
        )
    a = np.array([10.5]) * SPACING_MM
    steps = 6
    slip_angle = (
        3
        * np.pi
        / 16
        * FRICTION
        * compute_hertz_load(body, a)
        / (16 / 3 * body.shear_modulus * a**2)
    )
    poses = make_press_poses(compute_hertz_depth(a), steps)
    poses[2:, :, 2] = np.linspace(0, 1, steps + 1)[1:, None] * 10 * slip_angle
    made = trace_forces(body, body.sphere(SPHERE_MM), poses, FRICTION)
    exact = 3 * np.pi / 16 * FRICTION * compute_hertz_load(body, a) * a
    rows.append(
        make_comparison_row(
            "torsion",
            "slipping, M = 3 pi / 16 mu P a, N mm",
            exact[0],
            compute_moment(body, made.force[-1])[0],
            0.03,
            settled=made.settled,
        )
    )
    return rows
