"""Motions of pins on a grid: a shift is exact there, a smooth field nearly, and nothing stands outside the pins."""

import numpy as np
import pytest

from jaxunshear.models.pin_networks import make_grid


def hexagon(rings, spacing=7.0, middle=(64.0, 60.0)):
    steps = range(-rings, rings + 1)
    axial = np.array([(a, b) for a in steps for b in steps if abs(a + b) <= rings])
    return np.asarray(middle) + spacing * axial @ np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])


def places(rest, side):
    low, high = rest.min(axis=0), rest.max(axis=0)
    return np.stack(np.meshgrid(*np.linspace(low, high, side).T), -1).reshape(-1, 2)


@pytest.mark.parametrize("rings", [6, 10])  # 127 pins, and 331
def test_the_grid_is_as_fine_as_the_pins(rings):
    rest = hexagon(rings)
    grid = make_grid(rest)
    assert grid.shape == (len(rest), (2 * rings) ** 2) and grid.dtype == np.float32
    inside = grid.any(axis=0)
    assert 0.6 < inside.mean() < 0.9  # a hexagon's share of the square about it
    np.testing.assert_allclose(
        grid.sum(axis=0)[inside], 1, atol=1e-5
    )  # a shift of all pins is that shift everywhere


def test_a_smooth_field_comes_out_at_its_places():
    rest = hexagon(10)
    at, grid = places(rest, 20), make_grid(rest)
    inside = grid.any(axis=0)

    def field(xy):
        return np.sin(xy[:, 0] / 30) + 0.02 * xy[:, 1]

    error = np.abs(field(rest) @ grid - field(at))[inside]
    beside = (
        np.linalg.norm(at[inside][:, None] - rest, axis=-1).min(axis=1) < 0.6 * 7.0
    )  # others are beyond the last pins
    assert error[beside].max() < 0.04 and error.max() < 0.2
