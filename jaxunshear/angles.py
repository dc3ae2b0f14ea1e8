"""Wraps angles and rotates vectors of the plane.

>>> wrap_degrees(np.array([190.0, -180.0]))                  # [-170, 180]
>>> rotate_2d(np.array([[1.0, 0.0]]), np.pi / 2)             # [[0, 1]]
>>> xy @ rotation_2d(angle).T                                # all points, by one matrix

Arrays of NumPy give arrays of NumPy, arrays of JAX give arrays of JAX.
"""

from typing import TypeVar

import jax
import numpy as np

Values = TypeVar("Values", np.ndarray, jax.Array)


def wrap_degrees(degrees: Values) -> Values:
    """Bring angles into (-180, 180]."""
    return 180 - (180 - degrees) % 360


def rotate_2d(xy: Values, radians: Values) -> Values:
    """Rotate vectors (..., 2) from x towards y, by angles that broadcast against (...)."""
    xp = xy.__array_namespace__()
    cosine, sine = xp.cos(radians), xp.sin(radians)
    x, y = xy[..., 0], xy[..., 1]
    return xp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def rotation_2d(radians: np.ndarray | float) -> np.ndarray:
    """Make matrices (..., 2, 2) that rotate column vectors from x towards y."""
    cosine, sine = np.cos(radians), np.sin(radians)
    return np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], -2)
