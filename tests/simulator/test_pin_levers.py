"""Pins against rigid motions, and against the normal of a face that is bent in space."""

import numpy as np
import pytest

from jaxunshear.errors import UserError
from jaxunshear.simulator.mesh import make_dome_mesh
from jaxunshear.simulator.pin_levers import PinLevers, compute_interpolation


@pytest.fixture(scope="module")
def dome():
    return make_dome_mesh(20.0, 1.0, 3.0)


def test_interpolation_follows_linear_fields(dome):
    points = np.array(
        [[0.0, 2.0], [7.3, 5.1], [0.4, 1.5], [19 * np.sin(0.5), 20 - 19 * np.cos(0.5)]]
    )
    values, *slopes = compute_interpolation(dome, points)
    np.testing.assert_allclose(values @ dome.nodes, points, atol=1e-8)
    np.testing.assert_allclose(
        np.stack(slopes) @ dome.nodes, np.eye(2)[:, None].repeat(4, 1), atol=1e-8
    )
    with pytest.raises(UserError, match="outside the gel"):
        compute_interpolation(dome, np.array([[25.0, 1.0]]))


@pytest.fixture(scope="module")
def pins(dome):
    """Pins 2 mm long on the skin's inner face, one on the axis."""
    angle = np.array([0.0, 0.3, 0.6, 0.9])
    outwards = np.stack([np.sin(angle), -np.cos(angle)], -1)
    stands = 19 * outwards + np.array([0, 20.0])
    return PinLevers(stands, -2.0 * outwards, compute_interpolation(dome, stands))


@pytest.mark.parametrize(
    "name", ["translation in x", "translation in z", "rotation about y", "rotation about z"]
)
def test_pins_move_rigidly_with_a_rigid_body(dome, pins, name):
    def field(r, z):
        one, zero = np.ones_like(r), np.zeros_like(r)
        return {
            "translation in x": (1, [one, -one, zero]),
            "translation in z": (0, [zero, zero, one]),
            "rotation about y": (1, [z, -z, -r]),
            "rotation about z": (0, [zero, r, zero]),
        }[name]

    m, values = field(*dome.nodes.T)
    tips = pins.motion(np.stack(values, -1).reshape(-1, 1), m).reshape(-1, 3)
    np.testing.assert_allclose(
        tips, np.stack(field(*(pins.places + pins.levers).T)[1], -1), atol=1e-9
    )


def test_pins_without_length_move_with_the_face(dome, pins):
    short = PinLevers(pins.places, 0 * pins.levers, pins.at)
    field = np.random.default_rng(0).normal(size=(3 * len(dome.nodes), 2))
    for m in (0, 1, 5):
        np.testing.assert_allclose(
            short.motion(field, m).reshape(-1, 3, 2),
            np.tensordot(pins.at[0], field.reshape(-1, 3, 2), 1),
        )


@pytest.mark.parametrize("m", [0, 1, 2, 3])
def test_pins_follow_the_normal_of_the_deformed_face(m):
    """Compare with the cross product of two tangents of the moved face, by differences."""
    fine = make_dome_mesh(20.0, 1.0, 1.0)

    def field(r, z):
        """Smooth at the axis: (U, V, W) ~ r^|m -+ 1|, r^m."""
        share, height = r / 20, 1 + z / 20
        around = share ** abs(m - 1) * (1 if m else 0.4)
        return np.stack(
            [
                (around + share ** (m + 1)) * height,
                (share ** (m + 1) - around) * height,
                share**m * height**2,
            ],
            -1,
        )

    def moved(alpha, theta, amplitude):
        r, z = 19 * np.sin(alpha), 20 - 19 * np.cos(alpha)
        radial, around, up = field(np.array([r]), np.array([z]))[0] * np.array(
            [np.cos(m * theta), np.sin(m * theta), np.cos(m * theta)]
        )
        cos, sin = np.cos(theta), np.sin(theta)
        place = np.array([r * cos, r * sin, z])
        return place + amplitude * np.array(
            [cos * radial - sin * around, sin * radial + cos * around, up]
        )

    def tip(alpha, theta, amplitude, step=1e-4):
        first = moved(alpha + step, theta, amplitude) - moved(alpha - step, theta, amplitude)
        second = moved(alpha, theta + step, amplitude) - moved(alpha, theta - step, amplitude)
        normal = np.cross(second, first)
        normal *= -np.sign(normal[2]) / np.linalg.norm(normal)
        return moved(alpha, theta, amplitude) - 2.0 * normal

    alpha, theta = np.array([0.3, 0.6, 0.9]), 0.4
    outwards = np.stack([np.sin(alpha), -np.cos(alpha)], -1)
    stands = 19 * outwards + np.array([0, 20.0])
    made = PinLevers(stands, -2.0 * outwards, compute_interpolation(fine, stands))
    radial, around, up = made.motion(field(*fine.nodes.T).reshape(-1, 1), m).reshape(-1, 3).T
    wave = np.stack(
        [np.cos(m * theta) * radial, np.sin(m * theta) * around, np.cos(m * theta) * up]
    )
    cos, sin = np.cos(theta), np.sin(theta)
    here = np.stack([cos * wave[0] - sin * wave[1], sin * wave[0] + cos * wave[1], wave[2]], -1)
    there = np.stack([(tip(a, theta, 1e-4) - tip(a, theta, -1e-4)) / 2e-4 for a in alpha])
    np.testing.assert_allclose(here, there, atol=2e-3 * np.abs(there).max())
