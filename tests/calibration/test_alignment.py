"""The frame of an object is recovered from pins, and changes contacts as it says."""

import numpy as np
import pytest

from jaxunshear.angles import rotation_2d
from jaxunshear.calibration import alignment
from jaxunshear.calibration.alignment import AlignmentProblem, estimate_rotation, find_frame
from jaxunshear.calibration.labels import LabelFrame, apply_frame, make_paths, read_motions
from jaxunshear.calibration.pin_statistics import make_observation
from jaxunshear.calibration.prediction import make_probe_sensor, make_values, project_positions
from jaxunshear.config.sensor import FITTED_CAMERA, TACTIP_331_FITTED
from jaxunshear.perception.lattice import compute_rings, make_lattice
from jaxunshear.simulator.paths import DEPTH, TILT_X, X
from jaxunshear.simulator.pin_layout import compute_pin_lattice, compute_pin_tips

SENSOR = TACTIP_331_FITTED
VALUES = make_values(SENSOR, FITTED_CAMERA, 0.4)
TRUE = LabelFrame(1.4, -1.3, 0.8, 1.9)


def _contacts(count=24):
    rng = np.random.default_rng(0)
    poses, moves = np.zeros((count, 6)), np.zeros((count, 6))
    poses[:, 1], poses[:, 2], poses[:, 5] = (
        rng.uniform(-5, 5, count),
        rng.uniform(3, 4, count),
        rng.uniform(-180, 180, count),
    )
    moves[:, :2] = rng.uniform(-2, 2, (count, 2))
    return read_motions(poses, moves)


def _displace_smoothly(values, contacts, side):
    """Replace the simulator: pins follow depth, distance and tilt smoothly.

    One contact is never solved.
    """
    end = make_paths(contacts, values.base, 0.0, side, values.friction).points[:, -1]
    tips = compute_pin_tips(make_probe_sensor(values.sensor)) / 20
    yaw = np.radians(end[:, 2])
    turn = np.stack([np.cos(yaw), np.sin(yaw)], -1)
    along = tips[:, :2] @ turn.T  # (Q, N)
    moved = np.zeros((len(end), len(tips), 3))
    moved[..., :2] = (0.3 * end[:, DEPTH] * tips[:, :1] ** 2 + np.tanh(end[:, X] / 3) * along).T[
        ..., None
    ] * turn[:, None]
    moved[..., :2] += 0.05 * end[:, None, TILT_X:] * (1 - tips[:, None, 2].T[..., None])
    moved[3] = np.nan
    return moved


@pytest.fixture
def problem(monkeypatch):
    contacts = _contacts()
    monkeypatch.setattr(alignment, "simulate_displacements", _displace_smoothly)
    moved = np.nan_to_num(_displace_smoothly(VALUES, apply_frame(contacts, TRUE), 1))
    positions = project_positions(VALUES, 128, compute_pin_lattice(SENSOR), moved)
    lattice = make_lattice(positions.mean(axis=0), compute_rings(SENSOR))
    return AlignmentProblem(make_observation(128, lattice, positions), contacts, 1, VALUES)


def test_a_frame_is_found_again(problem):
    found = find_frame(problem, LabelFrame(2.2))
    assert np.allclose(found.frame, TRUE, atol=0.1)
    assert abs(found.angle) < 0.01 and found.r2 > 0.95


def test_a_surface_without_an_edge_has_no_place_across(problem, monkeypatch):
    monkeypatch.setattr(
        alignment,
        "simulate_displacements",
        lambda values, contacts, side: _displace_smoothly(values, contacts, 1),
    )
    assert find_frame(problem._replace(side=0), LabelFrame(2.0)).frame.across_mm == 0


def test_a_shifted_frame_shifts_depth_and_edge():
    contacts = _contacts()
    plain = make_paths(contacts, SENSOR, 1.4, 1, 0.4).points
    assert np.allclose(
        make_paths(apply_frame(contacts, LabelFrame(1.4)), SENSOR, 0.0, 1, 0.4).points, plain
    )
    shifted = make_paths(apply_frame(contacts, LabelFrame(1.4, -1.3)), SENSOR, 0.0, 1, 0.4).points
    assert np.allclose(shifted - plain, [-1.3, 0, 0, 0, 0, 0])


def test_a_tilted_top_is_deeper_on_one_side():
    """Rotate the top about y: tips at +x become lower by x times the angle, and sensors tilt."""
    contacts = _contacts()
    tilted = apply_frame(contacts, LabelFrame(0.0, 0.0, 0.0, 2.0))
    lower = contacts.tip[..., 2] - tilted.tip[..., 2]
    assert np.allclose(lower, np.radians(2.0) * contacts.tip[..., 0], atol=0.01)
    assert np.allclose(tilted.turn.as_matrix()[:, 2, 2], np.cos(np.radians(2.0)))


@pytest.mark.parametrize("angle", [0.3, -0.2])
def test_motions_are_turned_back(angle):
    motion = np.random.default_rng(0).normal(size=(5, 7, 2))
    assert estimate_rotation(motion @ rotation_2d(-angle), motion) == pytest.approx(angle)
