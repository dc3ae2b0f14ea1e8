"""Slides are added to taps that were simulated, so the true slides are known."""

import numpy as np
import pytest

from jaxunshear.calibration.alignment import RecordedTaps, fit_label_view, simulate_shear
from jaxunshear.calibration.labels import read_motions
from jaxunshear.calibration.prediction import (
    Calibration,
    find_solutions,
    project_positions,
    simulate_displacements,
)
from jaxunshear.errors import UserError
from jaxunshear.perception.lattice import compute_rings, make_lattice
from jaxunshear.simulator.pin_layout import compute_pin_lattice
from tests.calibration.conftest import GUESS, SMALL, SURFACE_MM

CALIBRATION = Calibration("small", SMALL, GUESS, 0.35)
TURN = np.array([[0.0, 1.0], [1.0, 0.0]])  # a camera behind the pins: turned, and mirrored
MIDDLE = 63.0
COUNT = 40


def _project(displacement):
    """Project to pins (N, P, 2) px in the images of that camera."""
    pins = project_positions(CALIBRATION.values, 128, compute_pin_lattice(SMALL), displacement)
    return pins @ TURN.T + MIDDLE


def _displace(poses, moves, friction):
    contacts = read_motions(poses, moves)
    displacement = simulate_displacements(CALIBRATION.values, contacts, 1, SURFACE_MM, friction)
    assert find_solutions(displacement).all()
    return displacement


@pytest.fixture(scope="module")
def taps():
    generator = np.random.default_rng(0)
    poses = np.zeros((COUNT, 6))
    poses[:, 1] = generator.uniform(-2, 1, COUNT)  # an edge
    poses[:, 2] = generator.uniform(0.5, 1.4, COUNT) - SURFACE_MM
    poses[:, 5] = generator.uniform(-180, 180, COUNT)
    return RecordedTaps(_project(_displace(poses, None, None)), poses)


@pytest.fixture(scope="module")
def lattice(taps):
    return make_lattice(
        _project(np.zeros((1, *_displace(taps.pose[:1], None, None).shape[1:])))[0],
        compute_rings(SMALL),
    )


@pytest.fixture(scope="module")
def view(taps, lattice):
    return fit_label_view(taps, lattice, 128, CALIBRATION)


@pytest.mark.long
def test_a_slide_to_a_tap_is_the_one_that_the_simulator_knows(taps, view):
    assert view.alignment.frame.surface_mm == pytest.approx(SURFACE_MM, abs=0.1)
    generator = np.random.default_rng(1)
    move, friction = np.zeros((6, 6)), generator.uniform(0.2, 0.6, 6)
    move[:, :2], move[:, 5] = generator.uniform(-1, 1, (6, 2)), generator.uniform(-5, 5, 6)
    poses = taps.pose[:6]
    motion, converged = simulate_shear(view, poses, move, friction)
    true = _project(_displace(poses, move, friction)) - _project(_displace(poses, None, friction))
    assert converged.all() and np.sqrt(np.mean(true**2)) > 0.2
    assert np.sqrt(np.mean((motion - true) ** 2)) < 0.15 * np.sqrt(np.mean(true**2))


@pytest.mark.long
def test_no_slide_drags_nothing(taps, view):
    motion, converged = simulate_shear(view, taps.pose[:3], np.zeros((3, 6)), np.full(3, 0.3))
    assert converged.all() and not motion.any()


@pytest.mark.long
def test_what_gives_too_little_is_refused(taps, lattice):
    with pytest.raises(UserError, match="10 taps have a label and all pins"):
        fit_label_view(RecordedTaps(taps.pins[:10], taps.pose[:10]), lattice, 128, CALIBRATION)
    shuffled = RecordedTaps(taps.pins[np.random.default_rng(2).permutation(COUNT)], taps.pose)
    with pytest.raises(UserError, match="do not go with their images"):
        fit_label_view(shuffled, lattice, 128, CALIBRATION)
