"""Neo-Hookean elements against closed forms, and the pressed dome against the linear one."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.integrate import quad
from scipy.optimize import brentq, nnls
from scipy.sparse.linalg import splu

from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.simulator.elasticity import (
    assemble_stiffness,
    compute_isotropic_stiffness,
    compute_lame_constants,
)
from jaxunshear.simulator.mesh import Mesh
from jaxunshear.simulator.pin_layout import compute_pin_tips
from verification.hyperelastic import (
    compute_deformation,
    compute_energy,
    compute_forces,
    compute_tangent,
    make_body,
    neo_hookean,
)
from verification.large_strain import (
    State,
    compute_deformed_tips,
    fit_contact_radius,
    follow_depths,
    make_dome_body,
    make_face,
    press_dome,
    solve_equilibrium,
)

MESH_MM = 2.0


def tube(inner, outer, height, columns, rows):
    """Wall of a tube (a cylinder where `inner` is 0); its surface is the lower face."""
    r, z = np.linspace(inner, outer, 2 * columns + 1), np.linspace(0, height, 2 * rows + 1)
    grid = np.stack(np.meshgrid(r, z, indexing="ij"), -1).reshape(-1, 2)
    at = np.arange(len(grid)).reshape(len(r), len(z))
    offsets = np.array([(0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1)])
    i, j = (2 * index.reshape(-1, 1) for index in np.mgrid[:columns, :rows])
    elements = at[i + offsets[:, 0], j + offsets[:, 1]]
    # a grid has a middle that an 8-node element has not
    used, numbered = np.unique(elements, return_inverse=True)
    surface = np.searchsorted(used, at[2 * np.arange(columns)[:, None] + np.arange(3), 0])
    nothing = np.zeros(len(elements), bool)
    return Mesh(grid[used], numbered.reshape(elements.shape), nothing, np.zeros(0, int), surface)


def uniform(mesh, modulus, poisson):
    constants = compute_lame_constants(modulus, poisson)
    return make_body(mesh, *(np.full(len(mesh.elements), value) for value in constants))


def unloaded(mesh):
    return make_face(replace(mesh, surface=np.zeros((0, 3), int)))


def on(mesh, axis, value):
    return np.flatnonzero(np.abs(mesh.nodes[:, axis] - value) < 1e-9)


def started(moved, face=None):
    return State(moved, np.zeros(0 if face is None else len(face.place)), 0, False)


@pytest.fixture(scope="module")
def pressed():
    """The dome at 2 mm and just beside, on a coarse mesh."""
    body = make_dome_body(TACTIP_331, MESH_MM)
    face = make_face(body.mesh)
    return body, face, follow_depths(body, face, np.array([1.999, 2.0, 2.001]))


def test_forces_and_tangent_are_derivatives_of_the_energy():
    generator = np.random.default_rng(0)
    body = uniform(tube(0.0, 1.0, 1.0, 3, 2), 1.0, 0.49)
    moved = 0.03 * generator.normal(size=body.mesh.nodes.shape)
    way, h = generator.normal(size=moved.shape), 1e-6

    def differentiate(function):
        return (function(body, moved + h * way) - function(body, moved - h * way)) / (2 * h)

    slope, change = differentiate(compute_energy), differentiate(compute_forces)
    assert compute_forces(body, moved) @ way.ravel() == pytest.approx(slope, rel=1e-7)
    along = compute_tangent(body, moved) @ way.ravel()
    np.testing.assert_allclose(along, change, atol=1e-6 * np.abs(change).max())


def test_rigid_motions_cost_nothing():
    body = make_dome_body(TACTIP_331, 4.0)
    up = np.zeros_like(body.mesh.nodes)
    up[:, 1] = 3.0
    assert np.abs(compute_forces(body, up)).max() < 1e-10
    assert abs(compute_energy(body, up)) < 1e-10
    with jax.enable_x64(True):
        gradient = np.eye(3) + 0.3 * np.random.default_rng(1).normal(size=(3, 3))
        rotation, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
        rotation *= np.linalg.det(rotation)
        before, after = (neo_hookean(f, 1.0, 30.0) for f in (gradient, rotation @ gradient))
    assert float(after) == pytest.approx(float(before), rel=1e-12)


def test_matter_turned_inside_out_has_no_forces():
    body = uniform(tube(0.0, 1.0, 1.0, 3, 2), 1.0, 0.49)
    assert np.isnan(compute_forces(body, -2 * body.mesh.nodes)).all()


def test_patch_a_boundary_stretched_evenly_stretches_everything_evenly():
    mesh = tube(0.0, 3.0, 2.0, 3, 2)
    r, z = mesh.nodes.T
    inside = (r < 3) & (z > 0) & (z < 2)
    r, z = np.interp(r, range(4), [0.0, 0.5, 1.3, 2.0]), np.interp(z, range(3), [0.0, 0.4, 1.0])
    # uneven and skewed; curved sides need more points
    mesh = replace(mesh, nodes=np.stack([r, z + 0.2 * r], -1))
    body = uniform(mesh, 1.0, 0.45)
    even = mesh.nodes * [0.25, -0.35]  # stretches 1.25 and 0.65
    held = np.union1d(2 * np.flatnonzero(~inside)[:, None] + np.arange(2), 2 * mesh.axis)
    start = np.where(inside[:, None], 0.9 * even, even)
    start[mesh.axis, 0] = 0
    made = solve_equilibrium(body, unloaded(mesh), 0.0, started(start), held)
    assert made.converged and made.iterations > 0
    np.testing.assert_allclose(made.displacement, even, atol=1e-9)
    shear, first = compute_lame_constants(1.0, 0.45)
    stress = shear * (0.65 - 1 / 0.65) + first * np.log(1.25**2 * 0.65) / 0.65  # nominal, MPa
    top = compute_forces(body, made.displacement)[2 * np.flatnonzero(z == 1) + 1].sum()
    assert top == pytest.approx(stress * np.pi * 2**2, rel=1e-9)


@pytest.mark.parametrize("stretch", [0.9, 0.6])
def test_a_cylinder_squeezed_without_friction(stretch):
    mesh = tube(0.0, 2.0, 1.0, 3, 2)
    body, face = uniform(mesh, 0.1, 0.49), make_face(mesh)
    held = np.union1d(2 * mesh.axis, 2 * on(mesh, 1, 1.0) + 1)
    made = started(np.zeros_like(mesh.nodes), face)
    for depth in np.arange(1, 5) / 4 * (1 - stretch):
        made = solve_equilibrium(body, face, depth, made, held)
        assert made.converged
    shear, first = compute_lame_constants(0.1, 0.49)
    # no stress at the side
    side = brentq(lambda t: shear * (t * t - 1) + first * np.log(t * t * stretch), 1.0, 2.0)
    nominal = shear * (stretch - 1 / stretch) + first * np.log(side**2 * stretch) / stretch
    moved = mesh.nodes * [side - 1, stretch - 1] + [0, 1 - stretch]
    np.testing.assert_allclose(made.displacement, moved, atol=1e-7)
    assert made.push.sum() == pytest.approx(-nominal * np.pi * 2**2, rel=1e-7)
    _, volume_ratios = compute_deformation(body, made.displacement)
    np.testing.assert_allclose(volume_ratios, side**2 * stretch, rtol=1e-7)


def test_a_thick_tube_blown_up():
    """Plane strain, incompressible: sigma_theta - sigma_r = mu (l^2 - l^-2), over dr / r.

    A tube's bore is widened from 1 to 1.6 of 2 mm. See Ogden 1984, sec. 5.3.
    """
    mesh = tube(1.0, 2.0, 0.5, 6, 1)
    body = uniform(mesh, 1.0, 0.4999)
    bore = on(mesh, 0, 1.0)
    held = np.union1d(2 * np.arange(len(mesh.nodes)) + 1, 2 * bore)
    made, r = started(np.zeros_like(mesh.nodes)), mesh.nodes[:, 0]
    for wide in np.linspace(1.1, 1.6, 6):
        change = wide**2 - 1  # r^2 = R^2 + change if no volume is lost
        moved = np.zeros_like(mesh.nodes)
        moved[:, 0] = np.sqrt(r**2 + change) - r
        moved[r > 1, 0] += 0.2 * (made.displacement - moved)[r > 1, 0]
        made = solve_equilibrium(body, unloaded(mesh), 0.0, started(moved), held)
        assert made.converged
    pressure = compute_forces(body, made.displacement)[2 * bore].sum() / (2 * np.pi * 1.6 * 0.5)
    shear, _ = compute_lame_constants(1.0, 0.4999)

    def integrand(r):
        return shear * (r**2 / (r**2 - change) - (r**2 - change) / r**2) / r

    exact, _ = quad(integrand, 1.6, np.sqrt(4 + change))
    # a Poisson ratio of 0.4999 instead of 0.5 is worth about 1e-4
    assert pressure == pytest.approx(exact, rel=2e-4)


def test_a_small_press_is_the_linear_one():
    depth = 0.02
    body = make_dome_body(TACTIP_331, MESH_MM)
    mesh, face = body.mesh, make_face(body.mesh)
    skin = compute_isotropic_stiffness(TACTIP_331.skin_modulus_mpa, TACTIP_331.skin_poisson)
    gel = compute_isotropic_stiffness(TACTIP_331.gel_modulus_mpa, TACTIP_331.gel_poisson)
    full = 2 * np.pi * assemble_stiffness(mesh, np.where(mesh.skin[:, None, None], skin, gel))[0]
    in_plane = (3 * np.arange(len(mesh.nodes))[:, None] + [0, 2]).ravel()
    free = np.setdiff1d(np.arange(2 * len(mesh.nodes)), body.fixed_unknowns)
    matrix = full.tocsr()[in_plane][:, in_plane][free][:, free].tocsc()
    normal = sp.kron(face.rows, sp.csr_matrix([[0.0, 1.0]])).tocsr()[:, free]
    response = splu(matrix).solve(normal.T.toarray())
    root = np.linalg.cholesky(normal @ response).T
    push, _ = nnls(root, np.linalg.solve(root.T, depth - face.place[:, 1]))
    moved = np.zeros(2 * len(mesh.nodes))
    moved[free] = response @ push

    made = press_dome(TACTIP_331, [depth], MESH_MM)
    assert made.converged.all()
    assert made.force_n[0] == pytest.approx(push.sum(), rel=0.01)
    tiny = 1e-3  # a linear lever: the limit of a turned one
    rest = compute_pin_tips(TACTIP_331)
    linear = (compute_deformed_tips(TACTIP_331, mesh, tiny * moved.reshape(-1, 2)) - rest) / tiny
    far = np.linalg.norm(made.pins[0] - rest - linear, axis=-1).max()
    assert far < 0.02 * np.linalg.norm(linear, axis=-1).max()


def test_pins_are_levers_on_the_inner_face():
    mesh = make_dome_body(TACTIP_331, MESH_MM).mesh
    squeeze, lift = np.diag([1.1, 1.1, 0.8]), np.array([0, 0, 0.3])
    moved = mesh.nodes @ np.diag([1.1, 0.8]) + [0, 0.3] - mesh.nodes
    rest, centre = compute_pin_tips(TACTIP_331), np.array([0, 0, TACTIP_331.dome_radius_mm])
    inward = (centre - rest) / np.linalg.norm(centre - rest, axis=-1, keepdims=True)
    base = rest - TACTIP_331.pin_length_mm * inward
    normal = inward @ np.linalg.inv(squeeze)  # of a face that deforms: F^-T n
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    expected = base @ squeeze + lift + TACTIP_331.pin_length_mm * normal
    np.testing.assert_allclose(compute_deformed_tips(TACTIP_331, mesh, moved), expected, atol=2e-3)


def test_the_plate_pushes_only_where_it_touches(pressed):
    body, face, states = pressed
    state = states[1]
    gap = face.place[:, 1] + face.rows @ state.displacement[:, 1] - 2.0
    assert state.converged and state.push.min() >= -1e-9 and gap.min() > -1e-8
    assert np.abs(state.push * gap).max() < 1e-8
    at_base = compute_forces(body, state.displacement)[2 * body.mesh.clamped + 1].sum()
    assert at_base == pytest.approx(-state.push.sum(), rel=1e-8)


def test_the_force_is_the_slope_of_the_energy_over_depth(pressed):
    body, _, states = pressed
    below, _, above = (compute_energy(body, state.displacement) for state in states)
    assert states[1].push.sum() == pytest.approx((above - below) / 0.002, rel=1e-5)


def test_the_force_converges_with_the_mesh():
    coarse, middle, fine = (press_dome(TACTIP_331, [2.0], h) for h in (4.0, 2.0, 1.5))
    assert all(made.converged.all() for made in (coarse, middle, fine))
    assert middle.force_n[0] == pytest.approx(fine.force_n[0], rel=0.02)
    assert abs(middle.force_n[0] - fine.force_n[0]) < abs(coarse.force_n[0] - fine.force_n[0])
    np.testing.assert_allclose(middle.pins, fine.pins, atol=0.06)


def test_no_contact_moves_nothing():
    made = press_dome(TACTIP_331, [-1.0, 0.0, 0.2, 0.5], 4.0)
    assert made.converged.all() and made.force_n[3] > made.force_n[2] > 0
    for row in (0, 1):
        assert made.force_n[row] == made.contact_radius_mm[row] == made.strained[row] == 0
        np.testing.assert_array_equal(made.pins[row], compute_pin_tips(TACTIP_331))


def test_what_does_not_converge_is_said_and_not_shown():
    def hesitant(gradient, shear, first):
        """Double the slopes of neo-Hookean forces: Newton's steps go half as far as they should."""
        energy, pull = jax.value_and_grad(neo_hookean)(gradient, shear, first)
        return 2 * energy - jnp.sum(jax.lax.stop_gradient(pull) * gradient)

    made = press_dome(TACTIP_331, [-1.0, 2.0, 3.0], 4.0, hesitant)
    np.testing.assert_array_equal(made.converged, [True, False, False])
    assert np.isnan(made.pins[1:]).all() and np.isnan(made.force_n[1:]).all()


def test_the_rim_lies_between_the_points():
    radius = np.arange(8) * 1.0
    gap = np.maximum(radius - 3.4, 0) ** 1.5
    assert fit_contact_radius(radius, gap, radius < 3.4) == pytest.approx(3.4)
    assert fit_contact_radius(radius, gap + 1, np.zeros(8, bool)) == 0
