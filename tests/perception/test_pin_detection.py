"""Pins detected in images whose pins are known."""

import numpy as np
import pytest

from jaxunshear.metrics.errors import match_pins
from jaxunshear.perception.pin_detection import detect_pin_centres, find_clusters, find_hull
from tests.helpers.dots import draw_dots, make_lattice


def test_centroids_are_columns_and_rows():
    centres = make_lattice(8) + np.array([3.0, -2.0])
    found = detect_pin_centres(draw_dots(centres, 2.2))
    match = match_pins(found, centres, 1.0)
    assert (match.missed, match.extra) == (0, 0)
    assert match.error_px.max() < 0.3


def test_touching_pins_are_parted():
    centres = make_lattice(9, 256)
    # three more, each touching one at the edge
    centres = np.concatenate([centres, centres[:3] - [0.0, 5.0]])
    match = match_pins(detect_pin_centres(draw_dots(centres, 3.0, 256)), centres, 2.0)
    assert (match.missed, match.extra) == (0, 0)


def test_pins_that_touch_on_a_slant_are_parted_wherever_others_touch():
    rows, columns = np.mgrid[:128, :128]
    place = np.array([(28 + 10 * i, 28 + 10 * j) for i in range(8) for j in range(8)], float)
    place[place[:, 0] == 38] += [-4.5, 3]  # each of one column touches its neighbour
    x, y = place.T[..., None, None]
    white = np.min((columns - x) ** 2 + (rows - y) ** 2, axis=0) <= 3**2
    found = detect_pin_centres(white)
    match = match_pins(found, place, 0.5)
    assert (match.missed, match.extra) == (0, 0)
    white[:64] = False
    alone = detect_pin_centres(white)
    np.testing.assert_allclose(match_pins(alone, found[found[:, 1] > 64], 1e-9).missed, 0)


def test_ring_specks_and_lone_dots_are_left_out():
    centres = make_lattice(9, 256)
    image = draw_dots(centres, 3.0, 256)
    rows, columns = np.indices(image.shape) - 127.5
    image[np.abs(np.hypot(rows, columns) - 0.47 * 256) < 2] = 255
    image[70, 70:72] = 255  # a speck between pins
    image |= draw_dots(np.array([[30.0, 128.0]]), 3.0, 256)  # a glint far from them
    match = match_pins(detect_pin_centres(image), centres, 1.0)
    assert (match.missed, match.extra) == (0, 0)


def test_images_without_pins_have_none_and_come_one_at_a_time():
    for value in (0, 255):
        assert detect_pin_centres(np.full((64, 64), value, np.uint8)).shape == (0, 2)
    with pytest.raises(ValueError, match="one image"):
        detect_pin_centres(np.zeros((2, 64, 64)))


def test_lone_points_belong_to_no_cluster():
    centres = make_lattice(8)
    lone = np.array([[2.0, 2.0], [126.0, 60.0]])
    rows = find_clusters(np.concatenate([lone, centres]))
    np.testing.assert_array_equal(np.sort(rows), np.arange(2, 2 + len(centres)))


def test_points_on_a_line_have_no_hull():
    square = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [2.0, 2.0]])
    assert set(find_hull(square)) == {0, 1, 2, 3}
    assert not len(find_hull(np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])))
