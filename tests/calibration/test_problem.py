"""Contacts that do not converge bend nobody's slope; unlabelled images say as much as their scatter lets them."""

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
    seen = observe_pins(
        render_images(GUESS, SMALL, np.repeat(compute_pin_tips(SMALL)[None], COUNT, axis=0)), SMALL
    )
    poses = np.zeros((COUNT, 6))
    poses[:, 2] = 1.0 + 0.1 * np.arange(COUNT)
    return RecordedGroup(
        "one", seen, read_motions(poses, np.tile([1.0, 0, 0, 0, 0, 0], (COUNT, 1)))
    )


def _problem(group, lost):
    """All pins of contact i move by friction (i + 1) mm; `lost` says of a friction whether LOST finds no solution."""

    def displacements(sensor, contacts, side, friction, surface_mm, ratio):
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
    held = ("mm_across", "distance_mm", "pin_spacing_mm")
    made = Problem([group], SMALL, start, held, lambda contacts: None, displacements)
    return made, made.to_parameters(start)


@pytest.mark.parametrize("at_start", [False, True])
def test_a_lost_contact_has_no_slope_and_moves_no_other(group, at_start):
    """Lost at a higher friction only, or at the start only."""
    made, x = _problem(group, lambda friction: False)
    friction = made.names.index("friction")
    plain = made.compute_jacobian(x)[..., friction]
    made, x = _problem(group, lambda friction: (friction > FRICTION + 1e-6) != at_start)
    slopes = made.compute_jacobian(x)[..., friction]
    assert np.abs(plain).max() > 0.1 and not slopes[LOST].any()
    others = np.delete(np.arange(COUNT), LOST)
    assert slopes[others, :RINGS] == pytest.approx(plain[others, :RINGS], abs=1e-5)
    places = plain[others, RINGS:] - plain[others, RINGS:].mean(axis=0)
    assert slopes[others, RINGS:] == pytest.approx(places, abs=1e-5)
    residual = made.compute_all_residuals(made.to_values(x))
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
    found, half = [], []
    for _ in range(12):
        widened = group.observation.rest * (1 + generator.uniform(0, 0.08, (20, 1, 1)))
        seen = group.observation.take(np.zeros(20, int))._replace(positions=widened)
        fitted = fit([RecordedGroup("one", seen)], SMALL, start, fixed=("distance_mm",))
        found.append(fitted.values.mm_across)
        half.append((fitted.high["mm_across"] - fitted.low["mm_across"]) / 2)
    assert 0.6 < np.mean(half) / (1.96 * np.std(found, ddof=1)) < 1.7


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
    made = Problem([replace(group, side=0)], sensor, start, (), lambda contacts: None)
    for bound in made.compute_bounds():
        check_sensor(made.to_values(bound).sensor(sensor))
