"""Angles on their circle and rotations of the plane, in NumPy and in JAX."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.angles import rotate_2d, rotation_2d, wrap_degrees


def test_angles_are_brought_onto_one_circle():
    given = np.array([0.0, 180.0, -180.0, 190.0, -190.0, 540.0, 725.0])
    np.testing.assert_array_equal(wrap_degrees(given), [0, 180, 180, -170, 170, 180, 5])
    np.testing.assert_array_equal(jax.jit(wrap_degrees)(jnp.asarray(given)), wrap_degrees(given))


def test_vectors_turn_from_x_towards_y():
    xy, radians = np.array([[1.0, 0.0], [0.0, 2.0]]), np.array([np.pi / 2, np.pi])
    np.testing.assert_allclose(rotate_2d(xy, radians), [[0, 1], [0, -2]], atol=1e-12)
    np.testing.assert_allclose(
        jax.jit(rotate_2d)(jnp.asarray(xy), jnp.asarray(radians)), [[0, 1], [0, -2]], atol=1e-6
    )


def test_the_matrix_turns_alike():
    xy = np.random.default_rng(0).normal(size=(4, 3, 2))
    radians = np.array([0.1, -2.0, 3.0, 9.0])
    turned = xy @ rotation_2d(radians).swapaxes(-1, -2)
    np.testing.assert_allclose(turned, rotate_2d(xy, radians[:, None]), atol=1e-12)
