"""Pins against rigid motions, and against the normal of a face that is bent in space."""

import numpy as np
import pytest

from jaxunshear.errors import UserError
from jaxunshear.simulator.mesh import make_dome_mesh
from jaxunshear.simulator.pin_levers import PinLevers, compute_interpolation


@pytest.fixture(scope="module")
def dome():
    return make_dome_mesh(20.0, 1.0, 3.0)


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
