"""The controller of appendix C: its law, its limits, and its motion to an edge."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.downstream.contour import ControllerGains, ControllerState, control

WIDE = ControllerGains(limit_mm=100.0, limit_deg=1000.0)


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
