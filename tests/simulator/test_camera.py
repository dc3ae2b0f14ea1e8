"""The camera against hand-made results: places and sizes of dots, and each disturbance."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.image import FITTED_CAMERA, FLUSH_CAMERA, Camera, Nuisance, Preprocess
from jaxunshear.config.sensor import SENSORS, TACTIP_331, TACTIP_331_FITTED, TACTIP_331_FLUSH
from jaxunshear.simulator.camera import (
    compute_drift,
    compute_outer_fraction,
    project,
    render_frame,
    to_image_px,
)
from jaxunshear.simulator.pin_layout import compute_pin_tips

CLEAN = Nuisance(housing_ring=False, specks=0, blur_px=0.3, noise=0.0, brightness=0.0)
CAMERA = Camera()
FINE = Camera(frame_px=1024)  # shapes are judged here, where pixels are small
KEY = jax.random.key(0)


def centre_of_light(grey, at, reach=6):
    """Mean position (column, row), weighted by light above the dark, around `at`."""
    column, row = (round(float(v)) for v in at)
    grey = np.asarray(grey)
    window = grey[row - reach : row + reach + 1, column - reach : column + reach + 1] - grey.min()
    rows, columns = np.indices(window.shape)
    return np.array([(window * columns).sum(), (window * rows).sum()]) / window.sum() + [
        column - reach,
        row - reach,
    ]


def test_apex_falls_in_the_centre_and_axes_point_along_columns_and_rows():
    tips = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [0.0, 1.0, 2.0]])
    px = np.asarray(project(CAMERA, tips, TACTIP_331))
    scale = CAMERA.frame_px / CAMERA.mm_across
    centre = (CAMERA.frame_px - 1) / 2
    np.testing.assert_allclose(
        px, [[centre, centre], [centre + scale, centre], [centre, centre + scale]], rtol=1e-6
    )


def test_nearer_pins_see_larger():
    tips = np.array([[1.0, 0.0, 2.0], [1.0, 0.0, 5.0]])
    far, near = np.asarray(project(CAMERA, tips, TACTIP_331))[:, 0] - (CAMERA.frame_px - 1) / 2
    assert near / far == pytest.approx(
        (CAMERA.distance_mm - 2) / (CAMERA.distance_mm - 5), rel=1e-5
    )


@pytest.mark.parametrize("tip", [(0.0, 0.0, 2.0), (3.3, -2.1, 2.4), (-8.0, 7.0, 4.5)])
def test_a_dot_lies_where_its_pin_is_projected(tip):
    tips = np.array([tip], np.float32)
    grey = render_frame(CAMERA, TACTIP_331, CLEAN, tips, KEY)
    at = np.asarray(project(CAMERA, tips, TACTIP_331))[0]
    np.testing.assert_allclose(centre_of_light(grey, at), at, atol=0.04)


def test_a_dot_has_the_area_of_its_pin():
    grey = np.asarray(
        render_frame(
            FINE, TACTIP_331, replace(CLEAN, blur_px=1.2), np.array([[0.0, 0.0, 2.0]]), KEY
        )
    )
    radius = TACTIP_331.pin_radius_mm * FINE.frame_px / FINE.mm_across
    assert (grey > (grey.max() + grey.min()) / 2).sum() == pytest.approx(
        np.pi * radius**2, rel=0.03
    )


def test_a_pin_near_the_rim_is_foreshortened_towards_the_centre():
    sensor = TACTIP_331
    rim = compute_pin_tips(sensor)[-60]  # on the x axis: its dot is short along columns
    assert rim[1] == pytest.approx(0.0, abs=1e-9)
    grey = np.asarray(render_frame(FINE, sensor, replace(CLEAN, blur_px=1.2), rim[None], KEY))
    rows, columns = np.argwhere(grey > (grey.max() + grey.min()) / 2).T
    lean = np.arctan2(rim[0], sensor.dome_radius_mm - rim[2]) - np.arctan2(
        rim[0], CAMERA.distance_mm - rim[2]
    )
    assert columns.std() / rows.std() == pytest.approx(np.cos(lean), abs=0.05)


def test_positions_scale_between_pixel_centres():
    preprocess = Preprocess(size=128)
    corners = np.array([[-0.5, 255.5], [127.5, 127.5], [0.5, 0.5]])
    np.testing.assert_allclose(
        to_image_px(CAMERA, preprocess, corners), [[-0.5, 127.5], [63.5, 63.5], [0, 0]]
    )


def test_batched_frames_equal_single_ones_and_keys_matter():
    tips = jnp.asarray(compute_pin_tips(TACTIP_331), jnp.float32)
    keys = jax.random.split(KEY, 3)
    camera = Camera(frame_px=64)
    draw = jax.jit(render_frame, static_argnums=(0, 1, 2))
    batch = jax.jit(jax.vmap(lambda key: render_frame(camera, TACTIP_331, Nuisance(), tips, key)))(
        keys
    )
    for i in range(3):
        np.testing.assert_allclose(
            batch[i], draw(camera, TACTIP_331, Nuisance(), tips, keys[i]), atol=1e-5
        )
    assert np.abs(batch[0] - batch[1]).max() > 0.01
    assert batch.dtype == jnp.float32
    assert batch.min() >= 0
    assert batch.max() <= 1


def test_age_drifts_the_view_and_dims_the_pins():
    worn = replace(CLEAN, drift_px=2.0, drift_brightness=0.2)
    tips = np.array([[2.0, 1.0, 2.2]])
    new, old = (render_frame(CAMERA, TACTIP_331, worn, tips, KEY, age) for age in (0.0, 1.0))
    at = np.asarray(project(CAMERA, tips, TACTIP_331))[0]
    moved = centre_of_light(old, at, 8) - centre_of_light(new, at, 8)
    np.testing.assert_allclose(moved, compute_drift(worn, 1.0), atol=0.03)
    assert np.hypot(*moved) == pytest.approx(2.0, abs=0.05)
    assert old.max() / new.max() == pytest.approx(0.8, abs=0.02)


def test_noise_has_its_deviation_and_the_housing_is_lit():
    tips = np.zeros((1, 3), np.float32)
    noisy = np.asarray(
        render_frame(CAMERA, TACTIP_331, replace(CLEAN, noise=0.02, housing_ring=True), tips, KEY)
    )
    corner = noisy[:20, :20]
    assert corner.std() == pytest.approx(0.02, rel=0.1)
    assert corner.mean() > 0.6 > 0.1 > noisy[100:110, 100:110].mean()


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS.keys())
def test_every_pin_lies_well_within_the_frame(sensor):
    camera = {TACTIP_331_FITTED: FITTED_CAMERA, TACTIP_331_FLUSH: FLUSH_CAMERA}.get(sensor, CAMERA)
    assert 0.3 < compute_outer_fraction(camera, sensor) < 0.4
