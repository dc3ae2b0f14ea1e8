"""Pins measured once more where finding them left doubt: glints, faint pins, the housing."""

import numpy as np
import pytest

from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.perception.lattice import compute_rings, make_lattice
from jaxunshear.perception.pin_detection import detect_pins
from jaxunshear.perception.pin_tracking import track_pins
from jaxunshear.simulator.pin_layout import compute_pin_lattice

SIZE, RADIUS = 256, 2.9
PLACE = compute_pin_lattice(TACTIP_331) / 20.0 * 92 + 127.5
LATTICE = make_lattice(PLACE, compute_rings(TACTIP_331))


def picture(place, radius=None):
    """(S, S) uint8 with a disc at each place (P, 2) px."""
    radius = np.full(len(place), RADIUS) if radius is None else radius
    image = np.zeros((SIZE, SIZE), bool)
    rows, columns = np.mgrid[:SIZE, :SIZE]
    for (x, y), r in zip(place, radius, strict=True):
        image |= (columns - x) ** 2 + (rows - y) ** 2 <= r**2
    return image.astype(np.uint8) * 255


def slid():
    bell = np.exp(-np.sum((PLACE - 127.5) ** 2, axis=-1) / (2 * 45**2))
    return PLACE + 9 * np.stack([bell, 0.4 * bell], axis=-1)


def track(image):
    return track_pins(LATTICE, detect_pins(image))


def error(track, place=None):
    place = slid() if place is None else place
    return np.linalg.norm(LATTICE.rest + track.motion - place, axis=-1)


def test_a_clean_image():
    found = track(picture(slid()))
    assert found.identified and found.visible.all() and found.extra == 0
    assert np.sqrt(np.mean(error(found) ** 2)) < 0.15 and error(found).max() < 0.4


def test_a_glint_that_touches_a_pin_does_not_draw_it_away():
    pin = 331 - 30
    outward = (PLACE[pin] - 127.5) / np.linalg.norm(PLACE[pin] - 127.5)
    places = np.vstack([slid(), slid()[pin] + 4.4 * outward])
    found = track(picture(places, np.append(np.full(331, RADIUS), 1.9)))
    assert found.identified and found.visible[pin] and error(found)[pin] < 0.8
    np.testing.assert_array_less(np.delete(error(found), pin), 0.5)


def test_faint_pins_are_seen_and_those_that_are_not_there_are_not_made_up():
    radius, some = np.full(331, RADIUS), [7, 150, 260]
    radius[some] = 1.5
    found = track(picture(slid(), radius))
    assert found.identified and found.visible[some].all() and error(found)[some].max() < 0.5
    gone = track(picture(np.delete(slid(), some, axis=0)))
    assert not gone.visible[some].any() and gone.missed == 3


def test_a_large_pin_off_its_neighbours_stands_where_it_is_seen():
    place, radius = PLACE.copy(), np.full(331, 2.2)
    # a lever that turns at an edge; a window smaller than the pin finds white wherever it looks
    place[100] += [0.0, 1.3]
    radius[100] *= 1.1
    found = track(picture(place, radius))
    assert found.identified and found.max_offset > 0.1 and error(found, place)[100] < 0.2


@pytest.mark.parametrize("columns", [0, 120, SIZE])
def test_an_image_that_shows_less_is_not_sure(columns):
    """Show no pins, half of them, and white alone."""
    image = np.full((SIZE, SIZE), 255, np.uint8) if columns == SIZE else picture(slid())
    image[:, columns:] = 0
    found = track(image)
    assert not found.identified and (columns == 120 or not found.visible.any())
