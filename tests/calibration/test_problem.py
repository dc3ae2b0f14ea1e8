"""Contacts that do not converge have no slope; parameters stay within the bounds of sensors."""

from dataclasses import replace

import numpy as np
import pytest

from jaxunshear.calibration import problem
from jaxunshear.calibration.fit import render_images
from jaxunshear.calibration.labels import read_motions
from jaxunshear.calibration.pin_statistics import observe_pins
from jaxunshear.calibration.prediction import PROBE_RINGS, make_values
from jaxunshear.calibration.problem import UNSOLVED_RESIDUAL_PX, FitProblem, RecordedGroup
from jaxunshear.config.sensor import TACTIP_331, TACTIP_331_FITTED, check_sensor
from jaxunshear.simulator.pin_layout import compute_pin_tips
from tests.calibration.conftest import GUESS, SMALL

FRICTION, LOST, COUNT = 0.3, 2, 4
RINGS = SMALL.rings


@pytest.fixture(scope="module")
def group():
    observation = observe_pins(
        render_images(GUESS, SMALL, np.repeat(compute_pin_tips(SMALL)[None], COUNT, axis=0)), SMALL
    )
    poses = np.zeros((COUNT, 6))
    poses[:, 2] = 1.0 + 0.1 * np.arange(COUNT)
    return RecordedGroup(
        "one", observation, read_motions(poses, np.tile([1.0, 0, 0, 0, 0, 0], (COUNT, 1)))
    )


def _make_start(sensor):
    return replace(make_values(sensor, GUESS, FRICTION), surface_mm=(0.0,))


def _problem(group, monkeypatch, lost):
    """Make a problem in which all pins of contact i move by friction (i + 1) mm.

    `lost` says of a friction whether contact LOST has no solution.
    """

    def displace(values, contacts, side, surface_mm):
        pins = 1 + 3 * PROBE_RINGS * (PROBE_RINGS + 1)
        moved = np.zeros((COUNT, pins, 3), np.float32)
        moved[..., 0] = values.friction * (1 + np.arange(COUNT)[:, None])
        if lost(values.friction):
            moved[LOST] = np.nan
        return moved

    monkeypatch.setattr(problem, "simulate_displacements", displace)
    fixed = ("mm_across", "distance_mm", "pin_spacing_mm")
    return FitProblem([group], _make_start(SMALL), fixed, lambda contacts: None)


@pytest.mark.parametrize("at_start", [False, True])
def test_a_lost_contact_has_no_slope_and_moves_no_other(group, monkeypatch, at_start):
    """Lose a contact at a higher friction only, or at the start only."""
    usual = _problem(group, monkeypatch, lambda friction: False)
    x, friction = np.zeros(len(usual.names)), usual.names.index("friction")
    plain = usual.compute_jacobian(x)[..., friction]
    losing = _problem(group, monkeypatch, lambda friction: (friction > FRICTION + 1e-6) != at_start)
    slopes = losing.compute_jacobian(x)[..., friction]
    assert np.abs(plain).max() > 0.1 and not slopes[LOST].any()
    others = np.delete(np.arange(COUNT), LOST)
    assert slopes[others, :RINGS] == pytest.approx(plain[others, :RINGS], abs=1e-5)
    places = plain[others, RINGS:] - plain[others, RINGS:].mean(axis=0)
    assert slopes[others, RINGS:] == pytest.approx(places, abs=1e-5)
    residual = losing.compute_residuals(x)
    assert (residual[LOST, 0] == UNSOLVED_RESIDUAL_PX and not residual[LOST, 1:].any()) == at_start


@pytest.mark.parametrize("sensor", [TACTIP_331, TACTIP_331_FITTED, SMALL])
def test_every_place_within_the_bounds_is_a_sensor(group, sensor):
    bounded = FitProblem([group], _make_start(sensor), (), lambda contacts: None)
    for bound in bounded.compute_bounds():
        values = bounded.to_values(bound)
        check_sensor(values.sensor)
        np.testing.assert_allclose(bounded.to_parameters(values), bound, atol=1e-12)
