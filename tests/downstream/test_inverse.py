"""From the pins' motion to the skin's indentation: closed forms, and what must stay exactly zero."""

import numpy as np
import pytest

from jaxunshear.contact.indentation import per_force
from jaxunshear.contact.systems import dome
from jaxunshear.downstream.geometry_scores import correlation
from jaxunshear.downstream.inverse import FELT_MM, indentation_of, learnt, of_compliance, pins_per_force
from jaxunshear.image.camera import project, to_image_px
from jaxunshear.image.framing import undeformed
from jaxunshear.image.growing import filled
from jaxunshear.settings.image import Camera, Preprocess
from jaxunshear.settings.sensor import TACTIP_331

SEEN = Camera(), Preprocess(size=128)


@pytest.fixture(scope="module")
def lattice():
    return undeformed(TACTIP_331, *SEEN)


@pytest.fixture(scope="module")
def physical():
    return of_compliance(TACTIP_331, *SEEN)


def ring_pressed(ring, newton=0.15):
    """(3N,) N: the same inward force on each node of a ring."""
    nodes = dome(TACTIP_331).nodes
    force, first = np.zeros(nodes.shape), 1 + 3 * ring * (ring - 1)
    mine = slice(first, first + 6 * ring)
    inward = [0, 0, TACTIP_331.dome_radius_mm] - nodes[mine]
    force[mine] = newton * inward / np.linalg.norm(inward, axis=-1, keepdims=True)
    return force.ravel()


@pytest.mark.parametrize("ring", [2, 4, 6])
def test_the_pressure_of_one_ring_is_recovered(physical, ring):
    force = ring_pressed(ring)
    motion = (pins_per_force(TACTIP_331, *SEEN) @ force).reshape(1, -1, 2)
    true = per_force(TACTIP_331) @ force
    found = indentation_of(physical, motion)
    assert true.max() > FELT_MM and correlation(found, true[None])[0] > 0.95


def test_a_few_missing_pins_change_little(lattice, physical):
    motion = (pins_per_force(TACTIP_331, *SEEN) @ ring_pressed(4)).reshape(-1, 2)
    gaps = motion.copy()
    gaps[np.random.default_rng(0).choice(len(motion), 10, replace=False)] = np.nan
    full, some = indentation_of(physical, np.stack([motion, filled(lattice, gaps)]))
    np.testing.assert_allclose(some, full, atol=0.1 * full.max())


def test_pins_move_as_the_camera_sees_the_dome_move():
    full, force = dome(TACTIP_331), 1e-3 * ring_pressed(3)
    tips = np.stack([full.pins, full.pins + (full.g @ force).reshape(-1, 3)])
    place = np.asarray(to_image_px(*SEEN, project(SEEN[0], tips, TACTIP_331)), float)
    reported = (pins_per_force(TACTIP_331, *SEEN) @ force).reshape(-1, 2)
    np.testing.assert_allclose(reported, place[1] - place[0], atol=1e-4)


def test_a_linear_skin_is_learnt(lattice):
    generator = np.random.default_rng(0)
    pins = len(lattice.place)
    shapes = generator.normal(size=(6, 2 * pins))
    rises = generator.normal(size=(6, pins))
    share = generator.normal(size=(200, 6))
    inverse = learnt(lattice, (share[:150] @ shapes).reshape(150, pins, 2), share[:150] @ rises)
    found = (share[150:] @ shapes) @ inverse
    np.testing.assert_allclose(found, share[150:] @ rises, atol=0.01)


def test_pins_at_rest_give_of_no_indentation(lattice, physical):
    still = np.zeros((2, *lattice.place.shape))
    np.testing.assert_array_equal(indentation_of(physical, still), 0)


def test_what_is_not_felt_is_exactly_zero_and_what_is_unknown_stays_so(lattice):
    pins = len(lattice.place)
    first = np.zeros((2 * pins, pins))
    first[0] = 1.0
    motion = np.zeros((3, pins, 2))
    motion[:, 0, 0] = 0.9 * FELT_MM, 1.1 * FELT_MM, np.nan
    found = indentation_of(first, motion)
    assert (found[0] == 0).all() and np.allclose(found[1], 1.1 * FELT_MM) and np.isnan(found[2]).all()


def test_pins_of_another_sensor_are_refused(physical):
    with pytest.raises(ValueError, match="reshape"):
        indentation_of(physical, np.zeros((1, 127, 2)))
