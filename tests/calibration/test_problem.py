"""Contacts that do not converge have no slope; intervals follow the scatter of images."""

from dataclasses import replace

import numpy as np
import pytest

from jaxunshear.calibration.fit import fit
from jaxunshear.calibration.labels import read_motions
from jaxunshear.calibration.pin_statistics import observe_pins
from jaxunshear.calibration.prediction import PROBE_RINGS, SensorValues, compute_modulus_ratio
from jaxunshear.calibration.problem import UNSOLVED_RESIDUAL_PX, Problem, RecordedGroup
from jaxunshear.calibration.rendering import render_images
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


def _problem(group, lost):
    """Make a problem in which all pins of contact i move by friction (i + 1) mm.

    `lost` says of a friction whether contact LOST has no solution.
    """

    def displace(sensor, contacts, side, friction, surface_mm, ratio):
        pins = 1 + 3 * PROBE_RINGS * (PROBE_RINGS + 1)
        moved = np.zeros((COUNT, pins, 3), np.float32)
        moved[..., 0] = friction * (1 + np.arange(COUNT)[:, None])
        converged = np.ones(COUNT, bool)
        converged[LOST] = not lost(friction)
        return moved, converged

    start = SensorValues(
        GUESS.mm_across,
        GUESS.distance_mm,
        SMALL.pin_spacing_mm,
        FRICTION,
        compute_modulus_ratio(SMALL),
        (0.0,),
    )
    fixed = ("mm_across", "distance_mm", "pin_spacing_mm")
    problem = Problem([group], SMALL, start, fixed, lambda contacts: None, displace)
    return problem, problem.to_parameters(start)


@pytest.mark.parametrize("at_start", [False, True])
def test_a_lost_contact_has_no_slope_and_moves_no_other(group, at_start):
    """Lose a contact at a higher friction only, or at the start only."""
    problem, x = _problem(group, lambda friction: False)
    friction = problem.names.index("friction")
    plain = problem.compute_jacobian(x)[..., friction]
    problem, x = _problem(group, lambda friction: (friction > FRICTION + 1e-6) != at_start)
    slopes = problem.compute_jacobian(x)[..., friction]
    assert np.abs(plain).max() > 0.1 and not slopes[LOST].any()
    others = np.delete(np.arange(COUNT), LOST)
    assert slopes[others, :RINGS] == pytest.approx(plain[others, :RINGS], abs=1e-5)
    places = plain[others, RINGS:] - plain[others, RINGS:].mean(axis=0)
    assert slopes[others, RINGS:] == pytest.approx(places, abs=1e-5)
    residual = problem.compute_all_residuals(problem.to_values(x))
    assert (residual[LOST, 0] == UNSOLVED_RESIDUAL_PX and not residual[LOST, 1:].any()) == at_start


def test_intervals_of_unlabelled_images_are_as_wide_as_the_scatter_of_samples(group):
    """Touches widen the rings by 0 to 8 per cent; which of them are in a sample is chance."""
    start = SensorValues(
        GUESS.mm_across,
        GUESS.distance_mm,
        SMALL.pin_spacing_mm,
        FRICTION,
        compute_modulus_ratio(SMALL),
        (0.0,),
    )
    generator = np.random.default_rng(0)
    scales, half = [], []
    for _ in range(12):
        widened = group.observation.rest * (1 + generator.uniform(0, 0.08, (20, 1, 1)))
        observation = group.observation.take(np.zeros(20, int))._replace(positions=widened)
        fitted = fit([RecordedGroup("one", observation)], SMALL, start, fixed=("distance_mm",))
        scales.append(fitted.values.mm_across)
        half.append((fitted.high["mm_across"] - fitted.low["mm_across"]) / 2)
    assert 0.6 < np.mean(half) / (1.96 * np.std(scales, ddof=1)) < 1.7


@pytest.mark.parametrize("sensor", [TACTIP_331, TACTIP_331_FITTED, SMALL])
def test_every_place_within_the_bounds_is_a_sensor(group, sensor):
    start = SensorValues(
        GUESS.mm_across,
        GUESS.distance_mm,
        sensor.pin_spacing_mm,
        FRICTION,
        compute_modulus_ratio(sensor),
        (0.0,),
    )
    problem = Problem([replace(group, side=0)], sensor, start, (), lambda contacts: None)
    for bound in problem.compute_bounds():
        check_sensor(problem.to_values(bound).sensor(sensor))
