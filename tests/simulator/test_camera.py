"""The camera against hand-made results: places and sizes of dots, and each disturbance."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.sensor import (
    FITTED_CAMERA,
    FLUSH_CAMERA,
    SENSORS,
    TACTIP_331,
    TACTIP_331_FITTED,
    TACTIP_331_FLUSH,
    Camera,
    Nuisance,
    Preprocess,
)
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
CENTRE = (CAMERA.frame_px - 1) / 2
KEY = jax.random.key(0)


def render(tips, camera=CAMERA, age=0.0, **disturbances):
    nuisance = replace(CLEAN, **disturbances)
    return np.asarray(render_frame(camera, TACTIP_331, nuisance, np.array(tips), KEY, age))


def project_tips(tips):
    return np.asarray(project(CAMERA, np.array(tips), TACTIP_331))


def find_centre_of_light(grey, at, reach=8):
    """Find the mean position (column, row), weighted by light above the dark, around `at`."""
    column, row = (round(float(v)) for v in at)
    window = grey[row - reach : row + reach + 1, column - reach : column + reach + 1]
    window = window - grey.min()
    rows, columns = np.indices(window.shape) - reach
    light = np.array([(window * columns).sum(), (window * rows).sum()])
    return light / window.sum() + [column, row]


def find_lit(grey):
    return grey > (grey.max() + grey.min()) / 2


def test_apex_falls_in_the_centre_and_axes_point_along_columns_and_rows():
    scale = CAMERA.frame_px / CAMERA.mm_across
    expected = [[CENTRE, CENTRE], [CENTRE + scale, CENTRE], [CENTRE, CENTRE + scale]]
    px = project_tips([[0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [0.0, 1.0, 2.0]])
    np.testing.assert_allclose(px, expected, rtol=1e-6)


def test_nearer_pins_look_larger():
    far, near = project_tips([[1.0, 0.0, 2.0], [1.0, 0.0, 5.0]])[:, 0] - CENTRE
    expected = (CAMERA.distance_mm - 2) / (CAMERA.distance_mm - 5)
    assert near / far == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("tip", [(0.0, 0.0, 2.0), (3.3, -2.1, 2.4), (-8.0, 7.0, 4.5)])
def test_a_dot_lies_where_its_pin_is_projected(tip):
    (at,) = project_tips([tip])
    np.testing.assert_allclose(find_centre_of_light(render([tip]), at, 6), at, atol=0.04)


def test_a_dot_has_the_area_of_its_pin():
    lit = find_lit(render([[0.0, 0.0, 2.0]], FINE, blur_px=1.2))
    radius = TACTIP_331.pin_radius_mm * FINE.frame_px / FINE.mm_across
    assert lit.sum() == pytest.approx(np.pi * radius**2, rel=0.03)


def test_a_pin_near_the_rim_is_foreshortened_towards_the_centre():
    rim = compute_pin_tips(TACTIP_331)[-60]  # on the x axis: its dot is short along columns
    assert rim[1] == pytest.approx(0.0, abs=1e-9)
    rows, columns = np.argwhere(find_lit(render([rim], FINE, blur_px=1.2))).T
    lean = np.arctan2(rim[0], TACTIP_331.dome_radius_mm - rim[2])
    sight = np.arctan2(rim[0], CAMERA.distance_mm - rim[2])
    assert columns.std() / rows.std() == pytest.approx(np.cos(lean - sight), abs=0.05)


def test_positions_scale_between_pixel_centres():
    corners = np.array([[-0.5, 255.5], [127.5, 127.5], [0.5, 0.5]])
    scaled = to_image_px(CAMERA, Preprocess(size=128), corners)
    np.testing.assert_allclose(scaled, [[-0.5, 127.5], [63.5, 63.5], [0, 0]])


def test_batched_frames_equal_single_ones_and_keys_matter():
    tips = jnp.asarray(compute_pin_tips(TACTIP_331), jnp.float32)
    keys = jax.random.split(KEY, 3)

    def draw(key):
        return render_frame(Camera(frame_px=64), TACTIP_331, Nuisance(), tips, key)

    batch, draw_one = jax.jit(jax.vmap(draw))(keys), jax.jit(draw)
    for frame, key in zip(batch, keys, strict=True):
        np.testing.assert_allclose(frame, draw_one(key), atol=1e-5)
    assert np.abs(batch[0] - batch[1]).max() > 0.01
    assert batch.dtype == jnp.float32 and batch.min() >= 0 and batch.max() <= 1


def test_age_drifts_the_view_and_dims_the_pins():
    worn, tips = {"drift_px": 2.0, "drift_brightness": 0.2}, [[2.0, 1.0, 2.2]]
    new, old = (render(tips, age=age, **worn) for age in (0.0, 1.0))
    (at,) = project_tips(tips)
    moved = find_centre_of_light(old, at) - find_centre_of_light(new, at)
    np.testing.assert_allclose(moved, compute_drift(replace(CLEAN, **worn), 1.0), atol=0.03)
    assert np.hypot(*moved) == pytest.approx(2.0, abs=0.05)
    assert old.max() / new.max() == pytest.approx(0.8, abs=0.02)


def test_noise_has_its_deviation_and_the_housing_is_lit():
    noisy = render([[0.0, 0.0, 0.0]], noise=0.02, housing_ring=True)
    corner = noisy[:20, :20]
    assert corner.std() == pytest.approx(0.02, rel=0.1)
    assert corner.mean() > 0.6 > 0.1 > noisy[100:110, 100:110].mean()


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS.keys())
def test_every_pin_lies_well_within_the_frame(sensor):
    camera = {TACTIP_331_FITTED: FITTED_CAMERA, TACTIP_331_FLUSH: FLUSH_CAMERA}.get(sensor, CAMERA)
    assert 0.3 < compute_outer_fraction(camera, sensor) < 0.4
