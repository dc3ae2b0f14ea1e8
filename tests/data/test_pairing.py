"""Partners of recorded slides: gaps, weights, and taps whose pins are moved elsewhere."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.sensor import TACTIP_127
from jaxunshear.config.targets import make_label_targets
from jaxunshear.data import pairing
from jaxunshear.data.chunks import pack_bits
from jaxunshear.perception.drawing import draw_dots
from jaxunshear.perception.pin_detection import detect_pin_centres
from jaxunshear.simulator.pin_layout import compute_pin_lattice

SIZE = 128
FLAT = compute_pin_lattice(TACTIP_127)
PINS = (SIZE - 1) / 2 + 0.375 * SIZE * FLAT / np.linalg.norm(FLAT, axis=-1).max()
WARP = pairing.make_image_warper(PINS, 0.375 * SIZE / 6, SIZE)


def image(pins):
    dots = np.asarray(draw_dots(jnp.asarray(pins[None], jnp.float32), 2.1, SIZE))
    return (dots * 255).astype(np.uint8)[..., 0]


def centroids(grey, near):
    """(P, 2) px of the light within 3.5 px of places (P, 2)."""
    rows, columns = np.mgrid[:SIZE, :SIZE]
    found = []
    for column, row in near:
        light = grey * (np.hypot(columns - column, rows - row) < 3.5)
        found.append((np.array([columns, rows]) * light).sum(axis=(1, 2)) / light.sum())
    return np.array(found)


def test_pins_of_a_warped_image_stand_where_they_were_moved():
    motion = np.stack([1.2 * np.sin(PINS[:, 1] / 20), 0.8 * np.cos(PINS[:, 0] / 25)], axis=-1)
    moved = WARP(pack_bits(image(PINS)), motion[None])[0]
    assert len(detect_pin_centres(moved)) == 127
    apart = np.linalg.norm(centroids(moved, PINS + motion) - (PINS + motion), axis=-1)
    # what drawing at full pixels costs
    asis = np.linalg.norm(centroids(image(PINS)[0], PINS) - PINS, axis=-1)
    assert np.median(apart) < np.median(asis) + 0.1 and apart.max() < 0.6
    assert np.median(np.linalg.norm(centroids(moved, PINS + motion) - PINS, axis=-1)) > 0.6


def test_no_motion_changes_nothing_and_far_from_the_pins_nothing_moves():
    ring = image(PINS)
    ring[:, :6] = 255
    np.testing.assert_array_equal(WARP(pack_bits(ring), np.zeros((1, 127, 2))), ring)
    moved = WARP(pack_bits(ring), np.full((1, 127, 2), 1.0))
    np.testing.assert_array_equal(moved[:, :6], ring[:, :6])


def test_gaps_go_the_short_way_round():
    one, other = np.zeros((1, 6)), np.zeros((1, 6))
    one[0, 5], other[0, 5], other[0, 1] = 179, -178, 2.5
    np.testing.assert_allclose(pairing.compute_pose_gaps(one, other), [[0, 2.5, 0, 0, 0, 3]])


def test_the_nearest_goes_by_all_targets_and_round_the_circle():
    poses = np.zeros((40, 6))
    poses[:, 1], poses[:, 5] = np.linspace(-5, 5, 40), np.linspace(-179, 179, 40)
    targets = make_label_targets((), poses)
    asked = poses[[0, 20]].copy()
    asked[0, 5] = 179.5
    rows, distance = pairing.find_nearest(targets, asked, poses)
    assert rows.tolist() == [0, 20] and distance[1] == pytest.approx(0, abs=1e-6)


def test_weights_halve_at_the_median_gap():
    weights = pairing.compute_pair_weights(np.array([0.0, 1.0, 2.0]))
    np.testing.assert_allclose(weights / weights[0], [1, 0.5, 1 / 16], rtol=1e-6)
    assert weights.mean() == pytest.approx(1)
    assert np.all(np.isfinite(pairing.compute_pair_weights(np.zeros(3))))
