"""The filter of a stream's poses, against the closed form of its steady state."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from jaxunshear.apps.robot.pose_filter import DRIFT, MAX_GAP_S, NOISE, find_noise, update_filter

STEP = 1 / 30


def follow(poses, noise, step=STEP):
    """Filter poses that come at an even pace; return the states."""
    states = [None]
    for number, pose in enumerate(poses):
        states.append(update_filter(states[-1], number * step, pose, noise))
    return states[1:]


@pytest.mark.parametrize("unit", ["mm", "deg"])
def test_it_comes_to_the_steady_state_of_the_riccati_equation(unit):
    name = f"edge_{unit}"
    noise = find_noise((name,), {})
    settled = follow([{name: 0.0}] * 300, noise)[-1].covariance[0]
    move = np.array([[1, STEP], [0, 1]])
    spread = np.array([[STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]]) * DRIFT[unit] ** 2
    seen, variance = np.array([[1.0], [0.0]]), np.array([[NOISE[unit] ** 2]])
    before = solve_discrete_are(move.T, seen, spread, variance)
    gain = before @ seen / (before[0, 0] + variance)
    np.testing.assert_allclose(settled, before - gain @ seen.T @ before, rtol=1e-6)


def test_a_constant_rate_is_followed_without_lag_and_noise_is_halved():
    rng, noise = np.random.default_rng(0), {"edge_mm": 0.3}
    true = 7.0 * STEP * np.arange(400)
    states = follow([{"edge_mm": x} for x in true], noise)
    assert states[-1].pose["edge_mm"] == pytest.approx(true[-1], abs=1e-3)
    assert states[-1].rate["edge_mm"] == pytest.approx(7.0, abs=0.01)
    noisy = true + rng.normal(0, 0.3, 400)
    found = np.array([s.pose["edge_mm"] for s in follow([{"edge_mm": x} for x in noisy], noise)])
    assert np.std((found - true)[50:]) < 0.75 * 0.3


def test_angles_go_around():
    angles = (170 + 2.0 * np.arange(100) + 180) % 360 - 180
    states = follow([{"edge_deg": angle} for angle in angles], {"edge_deg": 1.0})
    assert states[-1].rate["edge_deg"] == pytest.approx(60, rel=0.01)
    errors = [
        (s.pose["edge_deg"] - a + 180) % 360 - 180 for s, a in zip(states, angles, strict=True)
    ]
    assert np.abs(errors[20:]).max() < 0.5 and all(abs(s.pose["edge_deg"]) <= 180 for s in states)


@pytest.mark.parametrize("later", [MAX_GAP_S + 0.01, -0.1])
def test_it_starts_anew_after_a_gap_and_where_time_runs_back(later):
    noise = {"edge_mm": 0.3}
    last = follow([{"edge_mm": float(n)} for n in range(20)], noise)[-1]
    anew = update_filter(last, last.time_s + later, {"edge_mm": -5.0}, noise)
    assert (anew.pose, anew.rate) == ({"edge_mm": -5.0}, {"edge_mm": 0.0})


def test_two_poses_at_one_time_are_averaged():
    noise = {"edge_mm": 0.3}
    first = update_filter(None, 1.0, {"edge_mm": 0.0}, noise)
    assert update_filter(first, 1.0, {"edge_mm": 1.0}, noise).pose["edge_mm"] == pytest.approx(0.5)


def test_noise_is_that_of_the_half_widths_where_they_are_known():
    assert find_noise(("y_mm", "Rz_deg"), {"y_mm": 0.98}) == {"y_mm": 0.5, "Rz_deg": NOISE["deg"]}


@pytest.mark.parametrize("pose", [{"y_mm": 1.0, "force_x": 2.0}, {"Fx": 2.0}])
def test_forces_are_not_filtered(pose):
    noise = find_noise(tuple(pose), dict.fromkeys(pose, 0.98))
    lengths = {name for name in pose if name.endswith("_mm")}
    assert noise.keys() == lengths
    for state in follow([pose] * 3, noise):
        assert state.pose.keys() == state.rate.keys() == lengths
