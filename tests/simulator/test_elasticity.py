"""Elements by fields whose answer is known, the condensed compliance by its symmetries."""

import numpy as np
import pytest

from jaxunshear.simulator.elasticity import (
    assemble_stiffness,
    compute_isotropic_stiffness,
    compute_ring_loads,
    condense,
)
from jaxunshear.simulator.mesh import compute_shape_functions, make_dome_mesh, make_half_space_mesh


@pytest.fixture(scope="module")
def dome():
    return make_dome_mesh(20.0, 1.0, 3.0)


def volume(mesh):
    gauss = np.array([[x, y] for y in (-1, 1) for x in (-1, 1)]) / np.sqrt(3)
    values, slopes = compute_shape_functions(gauss)
    corners = mesh.nodes[mesh.elements]
    determinant = np.linalg.det(np.einsum("qnl,enx->eqlx", slopes, corners))
    assert np.all(determinant > 0) or np.all(determinant < 0), "an element is folded"
    return np.sum(np.abs(determinant) * 2 * np.pi * np.einsum("qn,en->eq", values, corners[..., 0]))


def test_the_dome_is_a_hemisphere(dome):
    assert volume(dome) == pytest.approx(2 / 3 * np.pi * 20**3, rel=1e-4)
    on_surface = dome.nodes[dome.surface.ravel()]
    np.testing.assert_allclose(np.hypot(on_surface[:, 0], 20 - on_surface[:, 1]), 20, atol=1e-9)
    assert np.all(np.diff(dome.nodes[dome.surface[:, 1], 0]) > 0)


def test_the_half_space_is_a_half_ball():
    mesh = make_half_space_mesh(1.0, 0.25)
    assert volume(mesh) == pytest.approx(
        2 / 3 * np.pi * np.hypot(*mesh.nodes.T).max() ** 3, rel=1e-3
    )


def fields(mesh):
    """Displacements (V, 3) = (U, V, W) of harmonic m that need no force inside a body."""
    r, z = mesh.nodes.T
    one, zero = np.ones_like(r), np.zeros_like(r)
    return {
        "translation in x": (1, [one, -one, zero]),
        "translation in z": (0, [zero, zero, one]),
        "rotation about y": (1, [z, -z, -r]),
        "stretch in z": (0, [zero, zero, z]),
        "radial stretch": (0, [r, zero, zero]),
        "twist": (0, [zero, r * z, zero]),
        "stretch x, shrink y": (2, [r, -r, zero]),
    }


NAMES = (
    "translation in x",
    "translation in z",
    "rotation about y",
    "stretch in z",
    "radial stretch",
    "twist",
    "stretch x, shrink y",
)


@pytest.mark.parametrize("name", NAMES)
def test_patch(dome, name):
    m, field = fields(dome)[name]
    k0, k1, k2 = assemble_stiffness(
        dome, np.broadcast_to(compute_isotropic_stiffness(1.0, 0.3), (len(dome.elements), 6, 6))
    )
    force = ((k0 + m * k1 + m * m * k2) @ np.stack(field, -1).ravel()).reshape(-1, 3)
    r, z = dome.nodes.T
    inside = (np.hypot(r, 20 - z) < 20 - 1e-6) & (z < 20 - 1e-6)
    # curved mid-sides and reduced integration leave a little; a wrong strain term leaves forces of
    # order one
    assert np.abs(force[inside]).max() < (
        1e-9 if name.startswith(("translation", "rotation")) else 2e-2
    ) * max(1, np.abs(force).max())


def test_rings_carry_one_newton_and_stand_on_the_sphere():
    fine = make_dome_mesh(20.0, 1.0, 1.0)
    loads, places = compute_ring_loads(fine, np.arange(9) * 2.5)
    np.testing.assert_allclose(loads.sum(0), 1, rtol=1e-12)
    angle = np.arange(8) * 2.5 / 20
    np.testing.assert_allclose(
        places, 20 * np.stack([np.sin(angle), 1 - np.cos(angle)], -1), atol=3e-4
    )
    middle = loads.T @ fine.nodes  # of a hat, by area: ring k's lies a little outside of it
    assert np.all(np.abs(middle[1:] - places[1:]) < 0.5) and np.all(middle[1:, 0] > places[1:, 0])


@pytest.fixture(scope="module")
def compliance(dome):
    materials = np.where(
        dome.skin[:, None, None],
        compute_isotropic_stiffness(1.0, 0.49),
        compute_isotropic_stiffness(0.1, 0.49),
    )
    angle = np.arange(6) * np.pi / 3
    outwards = np.stack(
        [np.sin(0.2) * np.cos(angle), np.sin(0.2) * np.sin(angle), np.full(6, -np.cos(0.2))], -1
    )
    tips, levers = np.array([0, 0, 20.0]) + 17.5 * outwards, -1.5 * outwards
    return (
        condense(dome, materials, np.arange(5) * 2.5, tips, 40, levers=levers),
        materials,
        tips,
        levers,
    )


def test_compliance_is_symmetric_positive_definite(compliance):
    w = compliance[0].w
    np.testing.assert_allclose(w, w.T, atol=1e-12)
    assert np.linalg.eigvalsh(w).min() > 0


def test_compliance_scales_with_the_moduli(dome, compliance):
    made, materials, tips, levers = compliance
    stiffer = condense(dome, 4 * materials, np.arange(5) * 2.5, tips, 40, levers=levers)
    np.testing.assert_allclose(4 * stiffer.w, made.w, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(4 * stiffer.g, made.g, rtol=1e-9, atol=1e-12)


def test_turning_a_load_by_60_degrees_turns_the_answer(compliance):
    made = compliance[0]
    cos, sin = np.cos(np.pi / 3), np.sin(np.pi / 3)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])

    def image_of(points):
        gap = np.linalg.norm((points @ turn.T)[:, None] - points[None], axis=-1)
        assert gap.min(1).max() < 1e-9
        return gap.argmin(1)

    force = np.random.default_rng(0).normal(size=made.nodes.shape)
    turned = np.empty_like(force)
    turned[image_of(made.nodes)] = force @ turn.T
    for matrix, points in ((made.w, made.nodes), (made.g, made.pins)):
        before = (matrix @ force.ravel()).reshape(-1, 3)
        after = (matrix @ turned.ravel()).reshape(-1, 3)
        np.testing.assert_allclose(
            after[image_of(points)], before @ turn.T, atol=1e-9 * np.abs(before).max()
        )


def test_a_push_moves_the_skin_with_it_and_reaches_the_pins(compliance):
    made = compliance[0]
    for axis in range(3):
        force = np.zeros_like(made.nodes)
        force[0, axis] = 1.0
        assert (made.w @ force.ravel()).reshape(-1, 3)[0, axis] > 0
        assert np.all((made.g @ force.ravel()).reshape(-1, 3)[:, axis] > 0)


def test_finer_meshes_agree_ever_better():
    """A newton over the inner rings of a dome of 6 mm: nodes and pins against a mesh of 0.25 mm."""
    angle = np.arange(4) / 6
    outwards = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], -1)

    def moved(h):
        mesh = make_dome_mesh(6.0, 0.5, h)
        materials = np.where(
            mesh.skin[:, None, None],
            compute_isotropic_stiffness(1.0, 0.49),
            compute_isotropic_stiffness(0.1, 0.49),
        )
        tips = np.array([0, 0, 6.0]) + 5 * outwards
        made = condense(mesh, materials, np.arange(4) * 0.8, tips, 12, levers=-0.5 * outwards)
        force = np.tile([0.5, 0.0, 1.0], len(made.nodes)) / len(made.nodes)
        return made.w @ force, made.g @ force

    truth, sizes = moved(0.25), (1.5, 0.75, 0.4)
    errors = np.array(
        [
            [
                np.linalg.norm(a - b) / np.linalg.norm(b)
                for a, b in zip(moved(h), truth, strict=True)
            ]
            for h in sizes
        ]
    )
    assert np.all(np.diff(errors, axis=0) < 0)
    order = np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert order[0] > 1.7 and order[1] > 1.3, (
        order,
        errors,
    )  # pins' rotations are slopes: they lag


def test_flat_punch_stiffness(half_space):
    """Displacing a disk as one needs P = 2 a E* d (Sneddon): solve W f = d on its nodes."""
    nodes = half_space.compliance.nodes
    inside = np.flatnonzero(np.hypot(nodes[:, 0], nodes[:, 1]) < 0.92)
    unknowns = 3 * inside + 2
    force = np.linalg.solve(
        half_space.compliance.w[np.ix_(unknowns, unknowns)], np.full(len(inside), 1e-3)
    )
    radius = 0.9 + 0.09 / 2  # the last ring's hat reaches half a spacing beyond it
    assert force.sum() == pytest.approx(2 * radius * half_space.normal_modulus * 1e-3, rel=0.05)
