"""The frame of an object is recovered from pins, and changes contacts as it says."""

import numpy as np
import pytest

from jaxunshear.calibration.alignment import AlignmentProblem, estimate_rotation, find_frame
from jaxunshear.calibration.labels import LabelFrame, apply_frame, make_paths, read_motions
from jaxunshear.calibration.pin_statistics import PinObservation, compute_camera_rotation
from jaxunshear.calibration.prediction import SensorValues, compute_modulus_ratio, make_probe_sensor
from jaxunshear.calibration.validation import project_positions
from jaxunshear.config.sensor import TACTIP_331_FITTED
from jaxunshear.perception.lattice import make_lattice
from jaxunshear.simulator.paths import DEPTH, TILT_X, X
from jaxunshear.simulator.pin_layout import compute_pin_lattice, compute_pin_tips

SENSOR = TACTIP_331_FITTED
VALUES = SensorValues(50.0, 66.0, SENSOR.pin_spacing_mm, 0.4, compute_modulus_ratio(SENSOR))
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


def _displace_smoothly(sensor, contacts, side, friction, surface_mm, ratio):
    """Replace the simulator: pins follow depth, distance and tilt smoothly.

    One contact is never solved.
    """
    end = make_paths(contacts, sensor, surface_mm, side, friction).points[:, -1]
    tips = compute_pin_tips(make_probe_sensor(sensor, ratio)) / 20
    yaw = np.radians(end[:, 2])
    turn = np.stack([np.cos(yaw), np.sin(yaw)], -1)
    along = tips[:, :2] @ turn.T  # (Q, N)
    moved = np.zeros((len(end), len(tips), 3))
    moved[..., :2] = (0.3 * end[:, DEPTH] * tips[:, :1] ** 2 + np.tanh(end[:, X] / 3) * along).T[
        ..., None
    ] * turn[:, None]
    moved[..., :2] += 0.05 * end[:, None, TILT_X:] * (1 - tips[:, None, 2].T[..., None])
    fine = np.ones(len(end), bool)
    fine[3] = False
    return moved, fine


def _recorded(contacts):
    moved, _ = _displace_smoothly(
        SENSOR, apply_frame(contacts, TRUE), 1, 0.4, 0.0, VALUES.skin_to_gel
    )
    positions = project_positions(VALUES, SENSOR, 128, compute_pin_lattice(SENSOR), moved)
    ring = np.repeat(np.arange(11), [1] + [6 * k for k in range(1, 11)])
    count = np.zeros(len(positions))
    lattice = make_lattice(positions.mean(axis=0), ring)
    return PinObservation(
        128, lattice, positions, positions[..., 0], count, count == 0, count, count, count
    )


def test_a_frame_is_found_again():
    contacts = _contacts()
    problem = AlignmentProblem(_recorded(contacts), contacts, 1, VALUES, SENSOR, _displace_smoothly)
    frame = find_frame(problem, LabelFrame(2.2))
    assert np.allclose(frame, TRUE, atol=0.1)
    surface_only = find_frame(problem, LabelFrame(2.2), ("surface_mm",))
    assert surface_only[1:] == (0, 0, 0) and surface_only.surface_mm != 2.2
    assert abs(problem.measure_rotation(frame)) < 0.01


def test_a_surface_without_an_edge_has_no_place_across():
    contacts = _contacts()

    def displace_at_edge(sensor, contacts, side, *values):
        return _displace_smoothly(sensor, contacts, 1, *values)

    problem = AlignmentProblem(_recorded(contacts), contacts, 0, VALUES, SENSOR, displace_at_edge)
    assert find_frame(problem, LabelFrame(2.0)).across_mm == 0


def test_a_shifted_frame_shifts_depth_and_edge():
    contacts = _contacts()
    plain = make_paths(contacts, SENSOR, 1.4, 1, 0.4).points
    assert np.allclose(
        make_paths(apply_frame(contacts, LabelFrame(1.4)), SENSOR, 0.0, 1, 0.4).points, plain
    )
    shifted = make_paths(apply_frame(contacts, LabelFrame(1.4, -1.3)), SENSOR, 0.0, 1, 0.4).points
    assert np.allclose(shifted - plain, [-1.3, 0, 0, 0, 0, 0])


def test_a_tilted_top_is_deeper_on_one_side():
    """Rotate the top about y by a small angle.

    Tips at +x become lower by x times the angle, and all sensors tilt by it.
    """
    contacts = _contacts()
    tilted = apply_frame(contacts, LabelFrame(0.0, 0.0, 0.0, 2.0))
    lower = contacts.tip[..., 2] - tilted.tip[..., 2]
    assert np.allclose(lower, np.radians(2.0) * contacts.tip[..., 0], atol=0.01)
    assert np.allclose(tilted.tilt_deg, 2.0)


def test_motions_are_turned_back():
    motion = np.random.default_rng(0).normal(size=(5, 7, 2))
    assert estimate_rotation(motion @ compute_camera_rotation(0.3), motion) == pytest.approx(0.3)
    motion[0, 0] = np.nan
    assert estimate_rotation(motion @ compute_camera_rotation(-0.2), motion) == pytest.approx(-0.2)
