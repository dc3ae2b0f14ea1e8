"""Scores of known motions: of a perfect simulator, with noise, and of located pins."""

import numpy as np
import pytest

from jaxunshear.angles import rotate_2d
from jaxunshear.calibration.labels import read_motions
from jaxunshear.calibration.prediction import (
    compute_mm_per_px,
    fit_positions,
    locate_pins,
    make_probe_sensor,
    make_values,
    project_positions,
    project_rest,
)
from jaxunshear.calibration.validate import predict_from_labels
from jaxunshear.calibration.validation import (
    ComparedFolder,
    build_rows,
    centre_motions,
    compute_r2,
    draw_folders,
)
from jaxunshear.config.sensor import FITTED_CAMERA, TACTIP_331_FITTED
from jaxunshear.perception.lattice import compute_rings
from jaxunshear.simulator.pin_layout import compute_pin_lattice, compute_pin_tips

SENSOR = TACTIP_331_FITTED
VALUES = make_values(SENSOR, FITTED_CAMERA, 0.4)
FLAT = compute_pin_lattice(SENSOR)
REST = project_rest(VALUES, 128, FLAT)
NOISE_PX = 0.3


def _displace(count: int = 30) -> np.ndarray:
    """Make smooth displacements (N, Q, 3) mm of the probe's pins."""
    rng = np.random.default_rng(0)
    tips = compute_pin_tips(make_probe_sensor(SENSOR)) / 20
    basis = np.concatenate(
        [np.ones((len(tips), 1)), tips, tips[:, :1] * tips, tips[:, 1:2] * tips], axis=1
    )
    return np.einsum("qk,nkx->nqx", basis, rng.normal(0, 0.3, (count, basis.shape[1], 3)))


def _compare(noise_px: float = 0.0, count: int = 30) -> ComparedFolder:
    positions = project_positions(VALUES, 128, FLAT, _displace(count))
    noise = noise_px * np.random.default_rng(1).standard_normal(positions.shape)
    recorded, simulated = centre_motions(positions + noise, positions)
    scale, taps = np.ones(len(REST)), np.arange(count) % 2 > 0
    rings = compute_rings(SENSOR)
    return ComparedFolder("a", recorded, simulated, recorded, rings, REST, scale, taps)


def _value(rows, name):
    return next(row["value"] for row in rows if row["name"] == name)


def test_pins_stand_where_the_camera_sees_them():
    assert np.abs(locate_pins(VALUES, 128, REST) - FLAT).max() < 2e-3


def test_rings_with_phases_of_their_own_are_followed():
    """Locate pins between the simulated ones from their mean position, which contacts shift."""
    moved = _displace()
    flat = rotate_2d(FLAT, 0.3 + 0.05 * compute_rings(SENSOR))
    recorded = project_positions(VALUES, 128, flat, moved)
    found = fit_positions(VALUES, 128, recorded, moved)
    assert np.abs(found - flat).max() < 0.05
    simulated = project_positions(VALUES, 128, found, moved)
    assert compute_r2(*centre_motions(recorded, simulated)) > 0.999
    there = project_positions(VALUES, 128, FLAT, moved)
    assert compute_r2(*centre_motions(recorded, there)) < 0.9


def test_the_same_motions_score_one():
    rows = build_rows([_compare()])
    for kind in ("tap", "slide"):
        assert _value(rows, f"r2.{kind}") == pytest.approx(1, abs=1e-9)
        assert _value(rows, f"residual_px.{kind}") < 1e-4
    names = {row["name"] for row in rows}
    assert len(names) == len(rows)
    assert {"residual_mm.tap", "ceiling_r2.tap", "r2.tap.ring.10"} <= names


def test_noise_costs_what_it_should():
    clean, count = _compare(), 400
    noisy = _compare(NOISE_PX, count)
    rows = build_rows([noisy])
    left = NOISE_PX * np.sqrt(2 * (1 - 1 / count))
    assert _value(rows, "residual_px.slide") == pytest.approx(left, rel=0.02)
    motion = _value(rows, "motion_px.slide")
    assert _value(rows, "r2.slide") == pytest.approx(1 - left**2 / motion**2, abs=2e-3)
    assert _value(rows, "r2.slide") < _value(build_rows([clean]), "r2.slide") - 1e-3


def test_an_offset_of_a_pin_costs_nothing_and_a_missing_one_is_left_out():
    place = project_positions(VALUES, 128, FLAT, _displace())
    recorded = place + np.random.default_rng(2).normal(0, 3, place.shape[1:])
    recorded[:5, 7] = np.nan
    assert compute_r2(*centre_motions(recorded, place)) == pytest.approx(1, abs=1e-9)


def test_half_the_motion_explains_three_quarters():
    motion = _compare().recorded
    assert compute_r2(motion, 0.5 * motion) == pytest.approx(0.75)
    assert np.isnan(compute_r2(0 * motion, motion))


def test_scale_at_the_height_of_a_pin():
    """Move the apex pin by 0.01 mm, and compare with its motion in the image."""
    apex = np.zeros((1, 2))
    moved = np.zeros((2, len(compute_pin_tips(make_probe_sensor(SENSOR))), 3))
    moved[1, :, 0] = 0.01
    step_px = np.diff(project_positions(VALUES, 128, apex, moved)[:, 0, 0])
    assert step_px * compute_mm_per_px(VALUES, 128, apex) == pytest.approx(0.01, rel=1e-3)


def test_labels_that_give_all_and_nothing():
    rng = np.random.default_rng(0)
    poses, moves = np.zeros((200, 6)), np.zeros((200, 6))
    poses[:, 1], poses[:, 2], poses[:, 5] = (
        rng.uniform(-3, 3, 200),
        rng.uniform(3, 5, 200),
        rng.uniform(-90, 90, 200),
    )
    moves[:, :2] = rng.uniform(-2, 2, (200, 2))
    reported = np.stack([poses[:, 1] * np.cos(np.radians(poses[:, 5])), poses[:, 2] ** 2], -1)[
        :, None
    ]
    reported = reported - reported.mean(axis=0)
    contacts = read_motions(poses, moves)
    assert compute_r2(reported, predict_from_labels(contacts, reported)) > 0.9
    noise = rng.standard_normal((200, 3, 2))
    assert compute_r2(noise, predict_from_labels(contacts, noise)) < 0.05


def test_the_figure_is_a_png():
    assert draw_folders([_compare(NOISE_PX)]).startswith(b"\x89PNG")
