"""Finding and matching pins on images made by hand."""

import numpy as np
import pytest

from jaxunshear.metrics.pin_error import match_pins, measure_pin_error
from jaxunshear.perception.pin_detection import find_pins


def lattice(step, size=128):
    across = np.arange(size * 0.25, size * 0.75, step)
    return np.stack(np.meshgrid(across, across), -1).reshape(-1, 2)


def dots(centres, radius, size=128):
    """Binary image (size, size) uint8 of round dots at (N, 2) px as (column, row)."""
    rows, columns = np.indices((size, size))
    away = np.hypot(columns - centres[:, 0, None, None], rows - centres[:, 1, None, None])
    return ((away <= radius).any(0) * 255).astype(np.uint8)


def test_centroids_are_columns_and_rows():
    centres = lattice(8) + np.array([3.0, -2.0])
    found = find_pins(dots(centres, 2.2))
    match = match_pins(found, centres, 1.0)
    assert (match.missed, match.extra) == (0, 0)
    assert match.error_px.max() < 0.3


def test_touching_pins_are_parted():
    centres = lattice(9, 256)
    # three more, each touching one at the edge
    centres = np.concatenate([centres, centres[:3] - [0.0, 5.0]])
    match = match_pins(find_pins(dots(centres, 3.0, 256)), centres, 2.0)
    assert (match.missed, match.extra) == (0, 0)


def test_ring_specks_and_lone_dots_are_left_out():
    centres = lattice(9, 256)
    image = dots(centres, 3.0, 256)
    rows, columns = np.indices(image.shape) - 127.5
    image[np.abs(np.hypot(rows, columns) - 0.47 * 256) < 2] = 255
    image[70, 70:72] = 255  # a speck between pins
    image |= dots(np.array([[30.0, 128.0]]), 3.0, 256)  # a glint far from them
    match = match_pins(find_pins(image), centres, 1.0)
    assert (match.missed, match.extra) == (0, 0)


def test_images_without_pins_have_none_and_come_one_at_a_time():
    for value in (0, 255):
        assert find_pins(np.full((64, 64), value, np.uint8)).shape == (0, 2)
    with pytest.raises(ValueError, match="one image"):
        find_pins(np.zeros((2, 64, 64)))


def test_matching_is_one_to_one_and_counts_what_is_left():
    true = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]])
    found = np.array([[0.5, 0.0], [0.2, 0.0], [10.0, 1.0], [100.0, 0.0]])
    match = match_pins(found, true, limit_px=3.0)
    np.testing.assert_allclose(sorted(match.error_px), [0.2, 1.0])
    assert (match.missed, match.extra) == (1, 2)


def test_a_far_outlier_does_not_bend_the_other_pairs():
    true = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0]])
    found = np.array([[4.1, 0.0], [8.1, 0.0], [500.0, 0.0]])
    np.testing.assert_allclose(match_pins(found, true, 2.0).error_px, [0.1, 0.1], atol=1e-9)


@pytest.mark.parametrize(("found", "true"), [(0, 5), (4, 0)])
def test_nothing_found_or_nothing_there(found, true):
    assert match_pins(np.zeros((found, 2)), np.zeros((true, 2)), 1.0)[1:] == (true, found)


def test_pin_error_of_a_known_shift():
    centres = np.tile(lattice(9, 256)[None], (2, 1, 1))
    images = np.stack([dots(c, 3.0, 256) for c in centres])
    error = measure_pin_error(images, centres + np.array([1.0, 0.0]), limit_px=9.0)
    assert error["rms_px"] == pytest.approx(1.0, abs=0.1)
    assert error["missed_per_image"] == error["extra_per_image"] == 0
    lost = measure_pin_error(images * 0, centres, limit_px=9.0)
    assert np.isnan(lost["rms_px"])
    assert lost["missed_per_image"] == centres.shape[1]
