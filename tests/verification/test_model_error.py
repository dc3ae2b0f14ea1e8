"""The table's figures; the full comparison takes a minute and is a long test."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxunshear.config.sensor import TACTIP_331, Camera
from jaxunshear.simulator.pin_layout import compute_pin_tips
from verification.hyperelastic import neo_hookean
from verification.model_error import compute_hencky_energy, measure_model_error
from verification.pin_distance import compute_pin_distance, compute_pin_error

REST = compute_pin_tips(TACTIP_331)


def test_a_shift_is_measured_as_one():
    camera = Camera()
    px, _, largest, *_ = compute_pin_error(TACTIP_331, REST + np.array([0.3, -0.4, 0.1]), REST)
    apex = compute_pin_distance(TACTIP_331, REST[:1] + np.array([0.5, 0, 0]), REST[:1])[0]
    assert apex == pytest.approx(0.5 * camera.frame_px / camera.mm_across, rel=1e-4)
    assert 0.9 * apex < px <= largest < 1.2 * apex
    assert np.isnan(compute_pin_error(TACTIP_331, REST * np.nan, REST).rms_px)


def test_one_pin_in_ten_shows_in_the_percentile_and_not_in_the_mean():
    moved = REST.copy()
    moved[::10, 0] += 1.0
    error = compute_pin_error(TACTIP_331, moved, REST)
    px = compute_pin_distance(TACTIP_331, moved, REST)
    assert (error.rms_mm, error.p95_mm) == pytest.approx((np.sqrt(34 / 331), 1))
    assert (error.rms_px, error.max_px) == pytest.approx((np.sqrt(np.mean(px**2)), px.max()))
    assert error.p95_px > 0.8 * error.max_px


def test_the_logarithmic_law_is_the_neo_hookean_one_at_small_strain_and_turns_with_the_body():
    generator = np.random.default_rng(0)
    plane = np.zeros((3, 3))
    plane[::2, ::2], plane[1, 1] = generator.normal(size=(2, 2)), generator.normal()
    turn = Rotation.from_euler("y", -0.7).as_matrix()
    small, large = np.eye(3) + 1e-4 * plane, np.eye(3) + 0.2 * plane
    stretched = np.diag(np.exp([0.5, -0.25, -0.25]))
    with jax.enable_x64(True):
        energies = [
            float(compute_hencky_energy(each, 1.0, 20.0))
            for each in (small, turn @ large, large, stretched)
        ]
        expected = float(neo_hookean(small, 1.0, 20.0))
    assert energies[0] == pytest.approx(expected, rel=2e-3)
    assert energies[1] == pytest.approx(energies[2], rel=1e-9)
    assert energies[3] == pytest.approx(0.5**2 + 2 * 0.25**2, rel=1e-6)


@pytest.mark.long
def test_the_linear_dome_is_good_at_small_depth_and_worse_deeper():
    shallow, deep = measure_model_error(TACTIP_331, (0.5, 4.0))
    assert shallow.converged and deep.converged
    assert shallow.rms_px < 0.2 < deep.rms_px < deep.motion_px
    # rotations, not the law, are what a linear dome misses
    assert deep.material_px < deep.rms_px / 4
    assert shallow.strained == 0 < deep.strained
    assert shallow.force_ratio == pytest.approx(1, abs=0.2)
