"""Friction on a half-space: Cattaneo and Mindlin, Mindlin and Deresiewicz, and torsion.

See Johnson 1985, Contact Mechanics, ch. 7. Their theory drops what the normal load does to the
tangential displacement, and all slip that is not along the pull: the first is exact for an
incompressible body, for which these problems are therefore posed.
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
from verification.verification_rows import Row, Rows, fit_order

FRICTION = 0.5
CYCLES = "Mindlin-Deresiewicz"
IN_INCREMENTS = "order in increments"


def compute_slip_distance(body: HalfSpace, radius_mm: Length) -> Length:
    """Compute the slide (mm) after which a stuck contact slips fully: 3 mu P / (16 a G*)."""
    return 3 * FRICTION * compute_hertz_load(body, radius_mm) / (16 * radius_mm * body.pull_modulus)


def _make_slides(
    body: HalfSpace, radius_mm: np.ndarray, shares: np.ndarray, steps: int = 4
) -> np.ndarray:
    poses = make_press_poses(compute_hertz_depth(radius_mm), steps)
    along = np.linspace(0, 1, steps + 1)[1:, None]
    poses[2:, :, 0] = along * shares * compute_slip_distance(body, radius_mm)
    return poses


def check_cattaneo_mindlin(
    body: HalfSpace, sizes: np.ndarray = SIZES, exact: bool = True
) -> list[Row]:
    """Check Q and the stick radius c of slides by shares of the slip distance.

    Without `exact` the rows only inform.
    """
    group = "Cattaneo-Mindlin"
    if not exact:
        group += f" at nu = {body.poisson:g}, where it is an approximation"
    bar = 0.02 if exact else None
    shares = np.array([0.2, 0.4, 0.6, 0.8, 1.5])
    a = np.repeat(sizes * SPACING_MM, len(shares))
    slides = _make_slides(body, a, np.tile(shares, len(sizes)))
    trace = trace_forces(body, body.sphere(SPHERE_MM), slides, FRICTION)
    pull = -trace.total[-1, :, 0] / (FRICTION * compute_hertz_load(body, a))
    pull = pull.reshape(len(sizes), -1)
    stick = compute_hemisphere_radius(body, compute_stuck_part(trace.force[-1])) / a
    stick = stick.reshape(len(sizes), -1)[:, :-1]
    expected, radius = 1 - np.maximum(0, 1 - shares) ** 1.5, np.sqrt(1 - shares[:-1])
    rows = Rows(group, trace.settled)
    for share, right, measured in zip(shares, expected, pull[-1], strict=True):
        rows.compare(f"pull after {share:g} slip distances, Q / (mu P)", right, measured, bar)
    for right, measured in zip(radius, stick[-1], strict=True):
        words = f"stick radius there, c / a = {right:.3f}, by second moment"
        note = f"c = {sizes[-1] * right:.1f} spacings"
        rows.compare(words, right, measured, bar, note=note)
    if exact:
        errors = np.sqrt(np.mean((stick / radius - 1) ** 2, axis=1))
        words = "relative error of these stick radii, rms"
        order = fit_order(1 / sizes, errors)
        rows.expect_zero(words, errors[-1], 1.0, bar, order=order, least_order=1.0)
    return rows


def compute_stuck_part(force: np.ndarray) -> np.ndarray:
    """Compute mu p - |q| (..., N) of forces (..., N, 3).

    In theory it is a hemisphere over the stick area and zero outside it.
    """
    return np.maximum(FRICTION * force[..., 2] - np.hypot(force[..., 0], force[..., 1]), 0.0)


def check_oblique(body: HalfSpace, size: float = 7.5) -> list[Row]:
    """Check a sphere pressed and slid at once: nodes that touch later slide less.

    Without slip Q / P = 2 (1 - nu) / (2 - nu) x / d.
    """
    counts = np.array([4, 8, 16, 32, 64])
    steps = np.minimum(np.arange(counts[-1] + 1)[:, None] / counts, 1.0)
    poses = np.zeros((*steps.shape, 6))
    deep, slope = compute_hertz_depth(size * SPACING_MM), 0.4
    poses[..., 3], poses[..., 0] = steps * deep, steps * slope * deep
    within_mm = 1.15 * size * SPACING_MM
    trace = trace_forces(body, body.sphere(SPHERE_MM), poses, FRICTION, within_mm)
    total = trace.total[-1]
    ratio = -total[:, 0] / total[:, 2]
    exact = slope * 2 * (1 - body.poisson) / (2 - body.poisson)
    rows = Rows(CYCLES, trace.settled)
    words = "oblique press without slip (Mindlin and Deresiewicz), Q / P"
    convergence = {"order": fit_order(1 / counts[:-1], np.diff(ratio)), "least_order": 0.8}
    rows.compare(words, exact, ratio[-1], 0.02, note=IN_INCREMENTS, **convergence)
    return rows


def check_cycle(body: HalfSpace, size: float = 8.5, share: float = 0.8) -> list[Row]:
    """Check the work of the pull over a slide to and fro, and the heat of its slips."""
    counts = np.array([3, 6, 12, 24])  # increments from end to end
    a = size * SPACING_MM
    reach = share * compute_slip_distance(body, a)
    number = np.arange(2 * counts[-1] + 1)[:, None] / counts
    cycle = np.where(number < 1, 1 - 2 * number, np.minimum(2 * number - 3, 1))
    along = np.concatenate([np.zeros((2, len(counts))), cycle])
    poses = make_press_poses(np.full(len(counts), compute_hertz_depth(a)), len(along) - 2)
    poses[2:, :, 0] = reach * along[2:]
    trace = trace_forces(body, body.sphere(SPHERE_MM), poses, FRICTION, within_mm=1.15 * a)
    pull, place = -trace.total[2:, :, 0], poses[2:, :, 0]
    work = np.sum(np.diff(place, axis=0) * (pull[1:] + pull[:-1]) / 2, axis=0)
    limit = FRICTION * trace.force[3:, :, :, 2]
    heat = np.sum(limit * np.linalg.norm(trace.slip[2:], axis=-1), axis=(0, 2))
    x = 1 - (1 - share) ** 1.5
    full = FRICTION * compute_hertz_load(body, a)
    loss = 9 * full**2 / (10 * a * body.pull_modulus)
    loss *= 1 - (1 - x) ** (5 / 3) - 5 * x / 6 * (1 + (1 - x) ** (2 / 3))
    words = "loss of a cycle (Mindlin and Deresiewicz), N mm"
    rows = Rows(CYCLES, trace.settled)
    convergence = {"order": fit_order(1 / counts, work - heat[-1]), "least_order": 1.0}
    pulled = f"{words}: the pull's work"
    rows.compare(pulled, loss, work[-1], 0.03, note=IN_INCREMENTS, **convergence)
    rows.compare(f"{words}: heat", loss, heat[-1], 0.03)
    return rows


def check_torsion(body: HalfSpace) -> list[Row]:
    """Check a sphere, pressed and then twisted about its normal: fully stuck, and slipping."""
    rows = Rows("torsion")
    _twist_stuck(rows, body, np.array([4.5, 6.5, 8.5, 10.5]), midway=True)
    _twist_stuck(rows, body, np.array([5.0, 7.0, 9.0, 11.0]), midway=False)
    _twist_slipping(rows, body)
    return rows


def _twist_stuck(rows: Rows, body: HalfSpace, sizes: np.ndarray, midway: bool) -> None:
    """Check stuck torsion; a rim on a ring, not midway between two, only informs."""
    a, angle = sizes * SPACING_MM, 1e-3
    poses = make_press_poses(compute_hertz_depth(a), 1)
    poses[2:, :, 2] = angle
    trace = trace_forces(body, body.sphere(SPHERE_MM), poses, np.inf)
    exact = 16 / 3 * body.shear_modulus * a**3 * angle
    measured = compute_moment(body, trace.force[-1])
    bar, least = (0.03, 0.7) if midway else (None, None)
    words, note = "stuck, M = 16/3 G a^3 theta, N mm", ""
    if not midway:
        words += ", rim on a ring"
        note = "the rim's place between two rings is worth up to half a spacing of radius"
    order = fit_order(1 / sizes, measured / exact - 1)
    convergence = {"order": order, "least_order": least, "settled": trace.settled, "note": note}
    rows.compare(words, exact[-1], measured[-1], bar, **convergence)


def _twist_slipping(rows: Rows, body: HalfSpace) -> None:
    a, steps = np.array([10.5]) * SPACING_MM, 6
    load = compute_hertz_load(body, a)
    slip_angle = 3 * np.pi / 16 * FRICTION * load / (16 / 3 * body.shear_modulus * a**2)
    poses = make_press_poses(compute_hertz_depth(a), steps)
    poses[2:, :, 2] = np.linspace(0, 1, steps + 1)[1:, None] * 10 * slip_angle
    trace = trace_forces(body, body.sphere(SPHERE_MM), poses, FRICTION)
    exact = (3 * np.pi / 16 * FRICTION * load * a)[0]
    measured = compute_moment(body, trace.force[-1])[0]
    words = "slipping, M = 3 pi / 16 mu P a, N mm"
    rows.compare(words, exact, measured, 0.03, settled=trace.settled)
