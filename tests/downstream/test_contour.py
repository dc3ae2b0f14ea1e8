"""Outlines by arc length: closed forms of length, orientation and position."""

import numpy as np
import pytest

from jaxunshear.downstream.contour import (
    ControllerGains,
    measure_contour_distances,
    trace_contour,
    update_arc_positions,
)
from jaxunshear.simulator.shapes import make_disk
from jaxunshear.simulator.stimuli import STIMULI, Stimulus, compute_signed_distance

WIDE = ControllerGains(limit_mm=100.0, limit_deg=1000.0)


@pytest.fixture
def small():
    return trace_contour(Stimulus("small", make_disk(20.0), (20.0, 0.0, 0.0), 20.0))


def place(angle, radius=20.0):
    """Return places (N, 2) at angles about the middle of the small disk, in its target frame."""
    return radius * np.stack([np.cos(angle), np.sin(angle)], -1) - [20, 0]


def test_a_disk_s_outline():
    contour = trace_contour(STIMULI["disk"])
    assert contour.length == pytest.approx(2 * np.pi * 50, rel=1e-4)
    np.testing.assert_allclose(contour.points[0], [0, 0], atol=0.06)  # the target
    middle = np.array([-50.0, 0.0])
    np.testing.assert_allclose(np.linalg.norm(contour.points - middle, axis=-1), 50, atol=0.01)
    np.testing.assert_allclose(contour.normal, (contour.points - middle) / 50, atol=2e-3)
    # counter-clockwise
    np.testing.assert_allclose(contour.points[contour.at(np.pi / 2 * 50)], [-50, 50], atol=0.1)


@pytest.mark.parametrize(
    "name", [pytest.param("flower", marks=pytest.mark.long), "leaf", "spiral_1"]
)
def test_outlines_lie_on_the_edge_and_close(name):
    points = trace_contour(STIMULI[name]).points
    distance = compute_signed_distance(STIMULI[name], points.astype(np.float32))
    assert np.abs(distance).max() < 0.02
    assert np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=-1).max() < 0.2
    x, y = points.T
    assert np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0  # twice the area


def test_off_and_advance(small):
    angle = np.radians([10.0, 90.0])
    xy = place(angle, 22.0)
    np.testing.assert_allclose(measure_contour_distances(small, xy), 2, atol=0.01)
    arc = update_arc_positions(small, np.array([3.0, 31.0]), xy, 3.0)
    np.testing.assert_allclose(arc, 20 * angle, atol=0.1)


def test_arcs_go_round_and_round(small):
    arc = np.array([0.0])
    for angle in np.radians(np.arange(0, 721, 5.0)):
        arc = update_arc_positions(small, arc, place(np.array([angle])), 3.0)
    assert arc[0] == pytest.approx(2 * small.length, abs=0.2)
