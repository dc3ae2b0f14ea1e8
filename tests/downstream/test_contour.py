"""Outlines by arc length, closed forms of length, orientation and position; and the controller."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.downstream.contour import (
    ControllerGains,
    ControllerState,
    control,
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


def make_zero_state(count):
    return ControllerState(jnp.zeros(count), jnp.zeros(count))


def run(gains, errors, jit):
    call = jax.jit(control, static_argnums=0) if jit else control
    state, moves, turns = make_zero_state(1), [], []
    for edge_mm, edge_deg in errors:
        move, turn, state = call(gains, state, jnp.array([edge_mm]), jnp.array([edge_deg]))
        moves.append(np.asarray(move[0]))
        turns.append(float(turn[0]))
    return np.array(moves), np.array(turns), state


@pytest.mark.parametrize("jit", [False, True])
def test_the_law_is_that_of_the_paper(jit):
    errors = [(1.0, 10.0), (-0.5, 4.0), (0.25, -8.0)]
    moves, turns, _ = run(WIDE, errors, jit)
    mm, deg = np.array(errors).T
    np.testing.assert_allclose(moves[:, 0], -(0.5 * mm + 0.3 * np.cumsum(mm)), rtol=1e-6)
    np.testing.assert_allclose(turns, 0.5 * deg + 0.1 * np.cumsum(deg), rtol=1e-6)
    np.testing.assert_allclose(moves[:, 1], 0.5)


def test_corrections_keep_within_their_limits_and_do_not_wind_up():
    gains = ControllerGains()
    moves, turns, state = run(gains, [(5.0, 90.0)] * 50, True)
    assert np.abs(moves[:, 0]).max() <= gains.limit_mm and np.abs(turns).max() <= gains.limit_deg
    assert abs(float(state.normal_mm[0])) <= 5.0 and abs(float(state.turn_deg[0])) <= 90.0
    back, _, _ = run(gains, [(5.0, 0.0)] * 50 + [(-1.0, 0.0)], True)
    assert back[-1, 0] > 0  # turns round at once: the sum has not run away


@pytest.mark.parametrize("start", [(-2.0, -30.0), (2.0, 30.0), (0.0, 45.0)])
def test_a_straight_edge_is_found_and_kept(start):
    """Follow x = 0 with the object on the left.

    The plant is the sensor's own position and yaw.
    """
    call = jax.jit(control, static_argnums=0)
    (x, yaw), state, errors = start, make_zero_state(1), []
    for _ in range(120):
        move, turn, state = call(ControllerGains(), state, jnp.array([x]), jnp.array([-yaw]))
        angle = np.radians(yaw)
        x += float(np.cos(angle) * move[0, 0] - np.sin(angle) * move[0, 1])
        yaw += float(turn[0])
        errors.append((abs(x), abs(yaw)))
    assert np.all(np.array(errors[-20:]) < [0.02, 0.2])
