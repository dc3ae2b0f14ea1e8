"""The condensed compliance by loads and orders, pins as levers, the block solver."""

import numpy as np
import pytest
import scipy.sparse as sp

from jaxunshear.errors import UserError
from jaxunshear.simulator.elasticity import (
    Pins,
    compute_isotropic_stiffness,
    compute_response,
    compute_ring_loads,
    factorise,
    sum_harmonics,
)
from jaxunshear.simulator.mesh import (
    PinLevers,
    compute_interpolation,
    compute_shape_functions,
    make_dome_mesh,
)
from verification.half_space import make_half_space_mesh


@pytest.fixture(scope="module")
def dome():
    return make_dome_mesh(20.0, 1.0, 3.0)


def compute_volume(mesh):
    gauss = np.array([[x, y] for y in (-1, 1) for x in (-1, 1)]) / np.sqrt(3)
    values, slopes = compute_shape_functions(gauss)
    corners = mesh.nodes[mesh.elements]
    determinant = np.linalg.det(np.einsum("qnl,enx->eqlx", slopes, corners))
    assert np.all(determinant > 0) or np.all(determinant < 0), "an element is folded"
    return np.sum(np.abs(determinant) * 2 * np.pi * np.einsum("qn,en->eq", values, corners[..., 0]))


def test_the_dome_is_a_hemisphere(dome):
    assert compute_volume(dome) == pytest.approx(2 / 3 * np.pi * 20**3, rel=1e-4)
    on_surface = dome.nodes[dome.surface.ravel()]
    np.testing.assert_allclose(np.hypot(on_surface[:, 0], 20 - on_surface[:, 1]), 20, atol=1e-9)
    assert np.all(np.diff(dome.nodes[dome.surface[:, 1], 0]) > 0)


def test_the_half_space_is_a_half_ball():
    mesh = make_half_space_mesh(1.0, 0.25)
    radius = np.hypot(*mesh.nodes.T).max()
    assert compute_volume(mesh) == pytest.approx(2 / 3 * np.pi * radius**3, rel=1e-3)


def test_rings_carry_one_newton_and_stand_on_the_sphere():
    fine = make_dome_mesh(20.0, 1.0, 1.0)
    loads, places = compute_ring_loads(fine, np.arange(9) * 2.5)
    np.testing.assert_allclose(loads.sum(0), 1, rtol=1e-12)
    angle = np.arange(8) * 2.5 / 20
    expected = 20 * np.stack([np.sin(angle), 1 - np.cos(angle)], -1)
    np.testing.assert_allclose(places, expected, atol=3e-4)
    middle = loads.T @ fine.nodes  # of a hat, by area: ring k's lies a little outside of it
    assert np.all(np.abs(middle[1:] - places[1:]) < 0.5) and np.all(middle[1:, 0] > places[1:, 0])


def load_dome(h, force):
    """Move a dome of 6 mm by forces on its inner nodes; return displacements of nodes and pins."""
    angle = np.arange(4) / 6
    outwards = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], -1)
    mesh = make_dome_mesh(6.0, 0.5, h)
    skin, gel = (compute_isotropic_stiffness(modulus, 0.49) for modulus in (1.0, 0.1))
    materials = np.where(mesh.skin[:, None, None], skin, gel)
    pins = Pins(np.array([0, 0, 6.0]) + 5 * outwards, -0.5 * outwards)
    made = sum_harmonics(compute_response(mesh, materials, np.arange(4) * 0.8, pins, 12))
    loads = np.tile(force, len(made.nodes)) / len(made.nodes)
    return made.w @ loads, made.g @ loads


def test_finer_meshes_agree_ever_better():
    force, sizes = [0.5, 0.0, 1.0], (1.5, 0.75, 0.4)
    nodes, pins = load_dome(0.25, force)
    for moved in (nodes, pins):
        assert np.all(moved[[0, 2]] > 0)
    errors = [
        (np.linalg.norm(w - nodes) / np.linalg.norm(nodes), np.linalg.norm(g - pins))
        for w, g in (load_dome(h, force) for h in sizes)
    ]
    assert np.all(np.diff(errors, axis=0) < 0)
    order = np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert order[0] > 1.7 and order[1] > 1.3  # pins' rotations are slopes: they lag


def test_flat_punch_stiffness(half_space):
    """Displacing a disk as one needs P = 2 a E* d (Sneddon): solve W f = d on its nodes."""
    inside = np.flatnonzero(half_space.radius < 0.92)
    unknowns = 3 * inside + 2
    w = half_space.w[np.ix_(unknowns, unknowns)]
    force = np.linalg.solve(w, np.full(len(inside), 1e-3))
    radius = 0.9 + 0.09 / 2  # the last ring's hat reaches half a spacing beyond it
    assert force.sum() == pytest.approx(2 * radius * half_space.normal_modulus * 1e-3, rel=0.05)


def band(count: int, seed: int = 0) -> sp.csr_matrix:
    """Positive definite, with couplings up to 40 apart, shuffled."""
    generator = np.random.default_rng(seed)
    half = sp.random(count, count, density=0.1, rng=generator).tocoo()
    near = np.abs(half.row - half.col) < 40
    entries = half.data[near] - 0.5, (half.row[near], half.col[near])
    half = sp.csr_matrix(entries, shape=half.shape)
    order = generator.permutation(count)
    return (half @ half.T + 0.1 * sp.eye(count)).tocsr()[order][:, order]


@pytest.mark.parametrize("count", [1, 7, 64, 500])
def test_a_factorised_matrix_solves(count):
    matrix = band(count)
    right = np.random.default_rng(1).normal(size=(count, 3))
    expected = np.linalg.solve(matrix.toarray(), right)
    np.testing.assert_allclose(factorise(matrix)(right), expected, rtol=1e-8, atol=1e-9)


def test_parts_that_do_not_couple():
    matrix = sp.block_diag([band(100), band(90, 1)]).tocsr()
    right = np.ones((190, 1))
    np.testing.assert_allclose(matrix @ factorise(matrix)(right), right, atol=1e-9)


def test_a_matrix_that_is_not_definite_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        factorise((band(200) - 10 * sp.eye(200)).tocsr())


def stand_pins(mesh, angle):
    """Stand pins 2 mm long on the skin's inner face, at angles (Q,) from the apex."""
    outwards = np.stack([np.sin(angle), -np.cos(angle)], -1)
    places = 19 * outwards + np.array([0, 20.0])
    return PinLevers(places, -2.0 * outwards, compute_interpolation(mesh, places))


@pytest.fixture(scope="module")
def pins(dome):
    return stand_pins(dome, np.array([0.0, 0.3, 0.6, 0.9]))


def test_interpolation_follows_linear_fields(dome):
    on_face = [19 * np.sin(0.5), 20 - 19 * np.cos(0.5)]
    points = np.array([[0.0, 2.0], [7.3, 5.1], [0.4, 1.5], on_face])
    values, *slopes = compute_interpolation(dome, points)
    np.testing.assert_allclose(values @ dome.nodes, points, atol=1e-8)
    expected = np.eye(2)[:, None].repeat(4, 1)
    np.testing.assert_allclose(np.stack(slopes) @ dome.nodes, expected, atol=1e-8)
    with pytest.raises(UserError, match="outside the gel"):
        compute_interpolation(dome, np.array([[25.0, 1.0]]))


RIGID_MOTIONS = {  # U, V, W of harmonic m
    "translation in x": (1, lambda r, z: (1 + 0 * r, -1 + 0 * r, 0 * r)),
    "translation in z": (0, lambda r, z: (0 * r, 0 * r, 1 + 0 * r)),
    "rotation about y": (1, lambda r, z: (z, -z, -r)),
    "rotation about z": (0, lambda r, z: (0 * r, r, 0 * r)),
}


@pytest.mark.parametrize("name", RIGID_MOTIONS)
def test_pins_move_rigidly_with_a_rigid_body(dome, pins, name):
    m, move = RIGID_MOTIONS[name]
    tips = pins.motion(np.stack(move(*dome.nodes.T), -1).reshape(-1, 1), m).reshape(-1, 3)
    expected = np.stack(move(*(pins.places + pins.levers).T), -1)
    np.testing.assert_allclose(tips, expected, atol=1e-9)


@pytest.mark.parametrize("m", [0, 1, 5])
def test_pins_without_length_move_with_the_face(dome, pins, m):
    short = PinLevers(pins.places, 0 * pins.levers, pins.at)
    field = np.random.default_rng(0).normal(size=(3 * len(dome.nodes), 2))
    moved = short.motion(field, m).reshape(-1, 3, 2)
    np.testing.assert_allclose(moved, np.tensordot(pins.at[0], field.reshape(-1, 3, 2), 1))


def compute_smooth_field(m, r, z):
    """Compute U, V, W of harmonic m that are smooth at the axis: ~ r^|m -+ 1|, r^m."""
    share, height = r / 20, 1 + z / 20
    around = share ** abs(m - 1) * (1 if m else 0.4)
    beyond = share ** (m + 1)
    both = (around + beyond) * height, (beyond - around) * height
    return np.stack([*both, share**m * height**2], -1)


def turn_to_xyz(radial, around, up, theta):
    cos, sin = np.cos(theta), np.sin(theta)
    return np.stack([cos * radial - sin * around, sin * radial + cos * around, up], -1)


@pytest.mark.parametrize("m", [0, 1, 2, 3])
def test_pins_follow_the_normal_of_the_deformed_face(m):
    """Compare with the cross product of two tangents of the moved face, by differences."""
    mesh = make_dome_mesh(20.0, 1.0, 1.0)

    def make_wave(field, theta):
        wave = np.array([np.cos(m * theta), np.sin(m * theta), np.cos(m * theta)])
        return turn_to_xyz(*(field * wave).T, theta)

    def place_face(alpha, theta, amplitude):
        r, z = 19 * np.sin(alpha), 20 - 19 * np.cos(alpha)
        wave = make_wave(compute_smooth_field(m, r, z), theta)
        return turn_to_xyz(r, 0.0, z, theta) + amplitude * wave

    def place_tip(alpha, theta, amplitude, step=1e-4):
        ahead, behind = (place_face(alpha + h, theta, amplitude) for h in (step, -step))
        left, right = (place_face(alpha, theta + h, amplitude) for h in (step, -step))
        normal = np.cross(left - right, ahead - behind)
        normal *= -np.sign(normal[2]) / np.linalg.norm(normal)
        return place_face(alpha, theta, amplitude) - 2.0 * normal

    alpha, theta = np.array([0.3, 0.6, 0.9]), 0.4
    field = compute_smooth_field(m, *mesh.nodes.T).reshape(-1, 1)
    here = make_wave(stand_pins(mesh, alpha).motion(field, m).reshape(-1, 3), theta)
    there = np.stack([place_tip(a, theta, 1e-4) - place_tip(a, theta, -1e-4) for a in alpha]) / 2e-4
    np.testing.assert_allclose(here, there, atol=2e-3 * np.abs(there).max())
