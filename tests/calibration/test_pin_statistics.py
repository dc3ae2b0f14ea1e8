"""Statistics of images with known pins, and what must not change them."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxunshear.calibration.calibrate import summarise_group
from jaxunshear.calibration.fit import render_images
from jaxunshear.calibration.labels import read_motions
from jaxunshear.calibration.pin_statistics import (
    average_central_pins,
    compute_lag,
    compute_ring_motion,
    compute_ring_radii,
    find_slide_bin,
    measure_pin_diameters,
    observe_pins,
    summarise_pins,
)
from jaxunshear.calibration.problem import RecordedGroup
from jaxunshear.config.sensor import TACTIP_331, Camera
from jaxunshear.errors import UserError
from jaxunshear.simulator.camera import compute_outer_fraction
from jaxunshear.simulator.pin_layout import compute_pin_tips


@pytest.fixture(scope="module")
def images():
    """Render two images of undisturbed pins, 128 px."""
    return render_images(
        Camera(frame_px=128), TACTIP_331, np.repeat(compute_pin_tips(TACTIP_331)[None], 2, axis=0)
    )


def _means(images):
    rows = summarise_pins(observe_pins(images, TACTIP_331))
    return {row.name: np.nanmean(row.values) for row in rows if np.isfinite(row.values).any()}


def test_known_lattice(images):
    means = _means(images)
    assert means["pins found"] == 331
    assert means["outermost ring, share of width"] == pytest.approx(
        compute_outer_fraction(Camera(), TACTIP_331), rel=0.005
    )
    tips = compute_pin_tips(TACTIP_331)
    radius = np.linalg.norm(tips[:, :2], axis=-1) / (Camera().distance_mm - tips[:, 2])
    radii = [radius[1 + 3 * k * (k - 1)] for k in range(1, 11)]
    for k in range(1, 10):
        assert means[f"ring {k} over outermost"] == pytest.approx(
            radii[k - 1] / radii[-1], abs=0.005
        )


def test_shift_and_size_change_nothing(images):
    here, shifted = _means(images), _means(np.roll(images, (2, -1), axis=(1, 2)))
    large = _means(np.kron(images, np.ones((1, 2, 2), np.uint8)))
    for name in here:
        assert shifted[name] == pytest.approx(here[name], rel=1e-6), name
        assert large[name] == pytest.approx(here[name], rel=0.02, abs=0.004), name


def test_a_turned_camera_changes_no_ring(images):
    observation = observe_pins(images, TACTIP_331)
    for turned in (observation.rotate(False, 0.7), observation.rotate(True, -1.2)):
        for a, b in zip(summarise_pins(observation), summarise_pins(turned), strict=True):
            np.testing.assert_allclose(a.values, b.values, atol=1e-9)


def test_turned_is_a_turn_of_the_image(images):
    """Compare with images that are rotated by a quarter, and transposed."""
    observation = observe_pins(images[:1], TACTIP_331)
    for mirrored, image in (
        (False, np.rot90(images[:1], -1, axes=(1, 2))),
        (True, np.swapaxes(images[:1], 1, 2)),
    ):
        seen = observe_pins(image, TACTIP_331).positions[0]
        turned = observation.rotate(mirrored, np.pi / 2).positions[0]
        assert cKDTree(seen).query(turned)[0].max() < 0.1


def test_diameters():
    rows, columns = np.indices((64, 64))
    image = np.zeros((64, 64), np.uint8)
    discs = ((16, 16, 4.0), (16, 44, 6.0), (44, 20, 5.0), (44, 30, 5.0))  # the last two touch
    for row, column, radius in discs:
        image[np.hypot(rows - row, columns - column) <= radius] = 255
    pins = np.array([[16, 16], [44, 16], [20, 44], [30, 44]], float)
    np.testing.assert_allclose(measure_pin_diameters(image, pins), [8, 12, 10, 10], rtol=0.04)
    assert np.isnan(measure_pin_diameters(image, np.array([[1.0, 1.0]])))[0]


def test_left_behind():
    """A skin that stays in place lags behind the slide, at every yaw of the sensor."""
    slide = np.array([[2.0, 0.0], [0.0, 1.5], [-1.0, 1.0]])
    yaw = np.radians([0, 90, 200])
    stays = -(slide @ [1, 1j]) * np.exp(-1j * yaw)  # in the sensor's frame
    np.testing.assert_allclose(compute_lag(stays, slide, yaw), np.linalg.norm(slide, axis=-1))
    across = stays * 1j
    np.testing.assert_allclose(compute_lag(across, slide, yaw), 0, atol=1e-12)
    assert np.isnan(compute_lag(np.zeros(1, complex), np.zeros((1, 2)), np.zeros(1)))[0]
    np.testing.assert_array_equal(
        find_slide_bin(np.array([[0, 0], [0.5, 0], [0, -1.5], [6, 3]])), [-1, 0, 1, 5]
    )


def test_central_pins_weigh_alike():
    motion = np.zeros((1, 4), complex)
    motion[0, 0], motion[0, 1] = 7, 0
    assert average_central_pins(motion)[0] == pytest.approx(1)
    ring = np.repeat([0, 1], [1, 6])
    place = np.zeros((2, 7, 2))
    place[1] = [3, -1]
    np.testing.assert_allclose(np.diff(compute_ring_motion(ring, place), axis=0), 3 - 1j)


def test_missing_pins_move_no_ring(images):
    """Hide pins on one side, as the housing does after a slide."""
    observation = observe_pins(images, TACTIP_331)
    ring, place = observation.lattice.ring, observation.positions.copy()
    place[0, -8:] = np.nan
    full = compute_ring_motion(ring, observation.positions - observation.rest)
    np.testing.assert_allclose(compute_ring_motion(ring, place - observation.rest), full, atol=0.05)
    np.testing.assert_allclose(
        compute_ring_radii(ring, place, observation.rest),
        compute_ring_radii(ring, observation.positions, observation.rest),
        atol=0.05,
    )


def test_what_is_not_followed_is_left_out_of_all(images, recwarn):
    observation = observe_pins(images, TACTIP_331)
    contacts = read_motions(np.tile(np.arange(6.0), (2, 1)) + np.eye(6)[:2], np.ones((2, 6)))
    reported = {
        row.name: row.values
        for row in summarise_group(
            RecordedGroup("one", observation, contacts), observation, np.array([True, False])
        )
    }
    assert all(np.isnan(values[1]) for values in reported.values())
    assert reported["white share of pins"][0] > 0.05 and reported["pins found"][0] == 331
    assert not recwarn.list


def test_black_images_are_refused():
    with pytest.raises(UserError, match="at most 0 pins"):
        observe_pins(np.zeros((2, 128, 128), np.uint8), TACTIP_331)


def test_real_pins_can_be_followed(real_recordings):
    from jaxunshear.calibration.recorded_groups import sample_folders

    parts, _ = sample_folders(real_recordings / "surface_3d_sample", 24, 0)
    observation = observe_pins(parts[0].images, TACTIP_331)
    assert observation.identified.mean() > 0.9
    assert np.abs(observation.pin_counts - 331).max() <= 5
