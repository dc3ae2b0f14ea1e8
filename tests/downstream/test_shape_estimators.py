"""Estimators from pins to objects: the level, and gaps."""

import numpy as np
import pytest

from jaxunshear.config.sensor import TACTIP_331, Camera, Preprocess
from jaxunshear.data.simulation import SimulatedContacts
from jaxunshear.downstream.geometry import measure_tap_motions
from jaxunshear.downstream.reconstruct import (
    SKIN,
    VORONOI,
    compute_skin_positions,
    find_separating_level,
    make_shape_estimators,
)
from jaxunshear.errors import UserError
from jaxunshear.perception.lattice_fitting import compute_rest_lattice

LATTICE = compute_rest_lattice(TACTIP_331, Camera(), Preprocess(size=128))


def test_a_level_misses_as_much_as_it_adds():
    generator = np.random.default_rng(0)
    over = np.arange(20_000) < 15_000
    values = generator.normal(np.where(over, 3.0, 1.0), 0.5)
    assert abs(find_separating_level(values, over) - 2.0) < 0.05


@pytest.fixture
def estimators():
    """Make estimators of made-up taps: skin over an edge is pressed in, and spreads its pins."""
    generator, place = np.random.default_rng(1), compute_skin_positions(TACTIP_331)
    angle, aside = generator.uniform(0, 2 * np.pi, 60), generator.uniform(-3, 3, 60)
    distance = (place @ np.stack([np.cos(angle), np.sin(angle)]) - aside).T
    pressed = 2.0 / (1 + np.exp(distance))
    spread = 0.1 * pressed[..., None] * (LATTICE.rest - LATTICE.centre)
    motion = spread + generator.normal(0, 0.05, spread.shape)
    return make_shape_estimators(TACTIP_331, LATTICE, motion, pressed, distance), motion


def test_makers_agree_on_what_they_are_given(estimators):
    by_name, motion = estimators
    assert list(by_name) == [VORONOI, SKIN]
    assert not by_name[VORONOI].in_mm and by_name[SKIN].in_mm
    gaps = motion[:3].copy()
    gaps[1] = np.nan
    for estimator in by_name.values():
        value, place = estimator.estimate_values(gaps), estimator.locate_values(gaps)
        assert place.shape == (*value.shape, 2)
        assert np.isnan(value[1]).all() and not np.isnan(value[[0, 2]]).any()


def test_untouched_skin_stands_as_the_dome_does(estimators):
    estimator, still = estimators[0][SKIN], np.zeros((1, *LATTICE.rest.shape))
    distance = np.linalg.norm(estimator.locate_values(still)[0], axis=-1)
    radius = TACTIP_331.dome_radius_mm
    expected = radius - np.sqrt(radius**2 - distance**2)
    np.testing.assert_allclose(estimator.estimate_values(still)[0], expected, atol=1e-9)


def test_small_images_are_refused():
    blank, none = np.zeros((2, 32, 32), np.uint8), np.zeros((2, 0))
    contacts = SimulatedContacts(none, none, blank, blank, none, none, none, 0)
    with pytest.raises(UserError, match="of 32 px: use a model of larger images"):
        measure_tap_motions(LATTICE, contacts)
