"""What every answer must obey, whatever the scene: on a half-space, over random paths, turned and scaled."""

import numpy as np

from jaxunshear.simulator.elasticity import Compliance, compute_isotropic_stiffness, condense
from jaxunshear.simulator.mesh import make_dome_mesh
from verification.half_space import SPACING_MM, HalfSpace, Trace, make_press_poses, trace_forces
from verification.normal_contact import SPHERE_MM, compute_hertz_depth
from verification.tangential_contact import FRICTION, compute_slip_distance
from verification.verification_rows import Row, fit_order, make_comparison_row, make_zero_row

GROUP = "laws of every answer"
RADIUS_MM = 5.5 * SPACING_MM  # of the contact


def _trace(body: HalfSpace, poses: np.ndarray, tolerance: float = 1e-5) -> Trace:
    """A sphere, as deep as makes the contact RADIUS_MM wide."""
    return trace_forces(
        body,
        body.sphere(SPHERE_MM),
        poses,
        FRICTION,
        within_mm=1.3 * RADIUS_MM,
        tolerance=tolerance,
    )


def make_random_paths(
    body: HalfSpace, count: int = 8, steps: int = 24, seed: int = 0
) -> np.ndarray:
    """Poses (steps + 1, count, 6): walks in x, y, yaw and depth that slip, stick, lift off and touch again."""
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
    made = _trace(body, make_random_paths(body))
    force, slip, gap = made.force[1:], made.slip, made.gap
    pull, push = np.linalg.norm(force[..., :2], axis=-1), force[..., 2]
    most, deep = push.max(), compute_hertz_depth(RADIUS_MM)
    finite = np.where(np.isfinite(gap), gap, 0.0)
    power = -np.sum(force[..., :2] * slip, axis=-1)
    heat = FRICTION * np.sum(push * np.linalg.norm(slip, axis=-1))
    what = "over 8 random paths of 24 increments with twists and lift-offs"
    settled = made.settled
    return [
        make_zero_row(
            GROUP,
            "adhesion: least pressure, of the largest",
            max(-push.min(), 0.0),
            most,
            1e-12,
            note=what,
        ),
        make_zero_row(
            GROUP,
            "pull beyond mu p, of the largest pressure",
            (pull - FRICTION * push).max(),
            most,
            1e-9,
        ),
        make_zero_row(
            GROUP, "penetration, of the depth", max(-finite.min(), 0.0), deep, 1e-3, settled=settled
        ),
        make_zero_row(
            GROUP,
            "pressure x gap, of the largest x the depth",
            np.abs(push * finite).max(),
            most * deep,
            1e-3,
            settled=settled,
        ),
        make_zero_row(
            GROUP,
            "dissipation below zero, summed, of all heat",
            -np.minimum(power, 0).sum(),
            heat,
            1e-3,
            settled=settled,
        ),
        make_zero_row(
            GROUP,
            "pull that is not against the slip, of all heat",
            heat - power.sum(),
            heat,
            1e-3,
            settled=settled,
        ),
    ]


def check_compliance(body: HalfSpace) -> list[Row]:
    values = np.linalg.eigvalsh(body.w)
    return [
        make_zero_row(
            GROUP,
            "compliance W: asymmetry, of its largest entry",
            np.abs(body.w - body.w.T).max(),
            body.w.max(),
            1e-12,
        ),
        Row(
            GROUP,
            "compliance W: least eigenvalue over the largest",
            None,
            values[0] / values[-1],
            min(values[0], 0.0) / values[-1],
            0.0,
        ),
    ]


def check_no_contact(body: HalfSpace) -> list[Row]:
    poses = np.zeros((4, 1, 6))
    poses[:, 0, 0], poses[:, 0, 3] = np.linspace(0, 1, 4), -0.01
    made = _trace(body, poses)
    return [
        make_zero_row(
            GROUP, "no contact: largest force, exactly zero", np.abs(made.force).max(), 1.0, 0.0
        )
    ]


def _slide(body: HalfSpace, angles: np.ndarray, share: float, steps: int) -> np.ndarray:
    poses = make_press_poses(np.full(len(angles), compute_hertz_depth(RADIUS_MM)), steps)
    along = np.linspace(0, 1, steps + 1)[1:, None] * share * compute_slip_distance(body, RADIUS_MM)
    poses[2:, :, 0], poses[2:, :, 1] = along * np.cos(angles), along * np.sin(angles)
    return poses


def check_rotation(body: HalfSpace) -> list[Row]:
    """The same slide in other directions: by 60 deg the nodes are the same, by other angles they are not."""
    angles = np.radians([0.0, 60.0, 17.0, 30.0, 45.0])
    made = _trace(body, _slide(body, angles, 0.6, 4), tolerance=1e-7)
    cos, sin = np.cos(angles), np.sin(angles)
    total = made.total[-1]
    back = np.stack(
        [
            cos * total[:, 0] + sin * total[:, 1],
            -sin * total[:, 0] + cos * total[:, 1],
            total[:, 2],
        ],
        -1,
    )
    apart = np.linalg.norm(back - back[0], axis=-1) / np.linalg.norm(back[0])
    return [
        make_zero_row(
            GROUP,
            "slide turned by 60 deg: change of the force",
            apart[1],
            1.0,
            1e-5,
            settled=made.settled,
        ),
        make_zero_row(
            GROUP,
            "slide turned by 17, 30, 45 deg: change of the force",
            apart[2:].max(),
            1.0,
            1e-3,
            note="lattice of the nodes",
        ),
    ]


def check_full_slip(body: HalfSpace) -> list[Row]:
    made = _trace(body, _slide(body, np.zeros(1), 2.0, 4))
    total = made.total[-1, 0]
    words = "full slip: Q / P"
    return [
        make_comparison_row(
            GROUP, words, FRICTION, np.hypot(*total[:2]) / total[2], 1e-4, settled=made.settled
        )
    ]


def check_closed_loop(body: HalfSpace) -> list[Row]:
    """Press, circle, lift off: at the end the body stores nothing, and all work of the motion has become heat."""
    counts = np.array([12, 24, 48, 96])
    share = np.minimum(np.arange(counts[-1] + 1)[:, None] / counts, 1.0)
    poses = _arc(
        1.5 * compute_slip_distance(body, RADIUS_MM), 2 * np.pi * np.clip(3 * share - 1, 0, 1)
    )
    poses[..., 3] = compute_hertz_depth(RADIUS_MM) * np.clip(
        np.minimum(3 * share, 3 - 3 * share), 0, 1
    )
    made = _trace(body, poses)
    work, heat, stored = compute_energies(body, made, poses)
    order = fit_order(1 / counts, heat / work - 1)
    note = f"order in increments; {counts[-1]} of them"
    return [
        make_comparison_row(
            GROUP,
            "closed loop: heat of all slips over the motion's work",
            1.0,
            heat[-1] / work[-1],
            0.03,
            order=order,
            least_order=0.8,
            settled=made.settled,
            note=note,
        ),
        make_zero_row(
            GROUP, "closed loop: energy still stored, of the work", stored[-1], work[-1], 1e-9
        ),
    ]


def check_increment_order(body: HalfSpace) -> list[Row]:
    """A slide whose direction turns all along, in more and more increments."""
    counts = np.array([4, 8, 16, 32, 64])
    share = np.minimum(np.arange(counts[-1] + 1)[:, None] / counts, 1.0)
    poses = make_press_poses(np.full(len(counts), compute_hertz_depth(RADIUS_MM)), counts[-1])
    poses[1:] += _arc(compute_slip_distance(body, RADIUS_MM), np.pi / 2 * share)
    made = _trace(body, poses)
    change = np.linalg.norm(np.diff(made.force[-1], axis=0), axis=(1, 2)) / np.linalg.norm(
        made.force[-1, -1]
    )
    words = f"quarter circle in {counts[-1]} increments against {counts[-2]}: nodal forces"
    order = fit_order(1 / counts[1:], change)
    note = "order in increments"
    return [
        make_zero_row(
            GROUP,
            words,
            change[-1],
            1.0,
            0.02,
            order=order,
            least_order=0.8,
            settled=made.settled,
            note=note,
        )
    ]


def _arc(radius_mm: float, angle: np.ndarray) -> np.ndarray:
    """Poses (T, B, 6) on a circle through the origin, at depth 0."""
    zero = np.zeros_like(angle)
    return np.stack(
        [radius_mm * np.sin(angle), radius_mm * (1 - np.cos(angle)), zero, zero, zero, zero], -1
    )


def compute_energies(
    body: HalfSpace, made: Trace, poses: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Work of the motion (trapezia of the force along x, y and depth), heat mu p |slip|, and stored energy at the end, (B,) N mm."""
    mean = (made.total[1:] + made.total[:-1]) / 2
    change = np.diff(poses, axis=0)
    work = np.sum(
        mean[..., 2] * change[..., 3] - np.sum(mean[..., :2] * change[..., :2], -1), axis=0
    )
    heat = FRICTION * np.sum(
        made.force[1:, ..., 2] * np.linalg.norm(made.slip, axis=-1), axis=(0, 2)
    )
    last = made.force[-1].reshape(made.force.shape[1], -1)
    return work, heat, np.einsum("bi,ij,bj->b", last, body.w, last) / 2


def check_tolerance_order(body: HalfSpace) -> list[Row]:
    """A slide at looser and looser tolerance, against one solved far more exactly."""
    tolerances = (1e-3, 1e-4, 1e-5, 1e-6)
    poses = _slide(body, np.zeros(1), 0.6, 4)
    exact, *found = (_trace(body, poses, tolerance).force[-1] for tolerance in (1e-8, *tolerances))
    errors = np.array([np.linalg.norm(force - exact) for force in found]) / np.linalg.norm(exact)
    words = "nodal forces at tolerance 1e-6 against 1e-8"
    order = fit_order(tolerances, errors)
    return [
        make_zero_row(
            GROUP,
            words,
            errors[-1],
            1.0,
            1e-3,
            order=order,
            least_order=0.7,
            note="order in the tolerance",
        )
    ]


def check_scaling() -> list[Row]:
    """A small dome whose moduli, and one whose lengths, are larger: displacements and forces follow."""
    rings, pins = 5, np.array([[3.0, 0.0, 2.5], [0.0, 4.0, 3.0]])

    def compute_scaled_compliance(size: float, modulus: float) -> Compliance:
        mesh = make_dome_mesh(20.0 * size, 1.0 * size, 3.0 * size)
        gel, skin = (
            compute_isotropic_stiffness(0.1 * modulus, 0.49),
            compute_isotropic_stiffness(modulus, 0.49),
        )
        materials = np.where(mesh.skin[:, None, None], skin, gel)
        return condense(
            mesh, materials, np.arange(rings + 1) * 2.0 * size, pins * size, 6 * (rings - 1)
        )

    base, stiff, large = (
        compute_scaled_compliance(1.0, 1.0),
        compute_scaled_compliance(1.0, 1e6),
        compute_scaled_compliance(3.0, 1.0),
    )
    worst = {
        "moduli x 1e6: compliances W, G x 1e-6": ((1e6 * stiff.w, base.w), (1e6 * stiff.g, base.g)),
        "lengths x 3: compliances W, G / 3": ((3 * large.w, base.w), (3 * large.g, base.g)),
    }
    return [
        make_zero_row(
            GROUP,
            f"{words}, largest change",
            max(np.abs(x - y).max() / np.abs(y).max() for x, y in pairs),
            1.0,
            1e-9,
        )
        for words, pairs in worst.items()
    ]
