"""Simulated pins drawn as another sensor would show them: what is drawn, what stays, and that labels go along."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.sensor import TACTIP_127
from jaxunshear.simulator.pin_layout import compute_pin_lattice
from jaxunshear.training import augmentation
from jaxunshear.training.augmentation import MOTION_FACTOR, make_randomisation

FLAT = compute_pin_lattice(TACTIP_127)
REST = 48 + 36 * FLAT / np.linalg.norm(FLAT, axis=-1).max()
RNG = np.random.default_rng(0)


def touch(degrees):
    """(B, P, 2) px: pins pushed along the normal of an edge through the middle, smoothly."""
    angle = np.radians(degrees)[:, None, None]
    normal = np.concatenate([np.cos(angle), np.sin(angle)], -1)
    unit = (REST - REST.mean(axis=0)) / 36
    across = (unit * normal).sum(-1, keepdims=True)
    return REST + 3 * np.exp(-2 * (unit**2).sum(-1))[None, :, None] * (0.4 + across) * normal


def batch(count=16):
    degrees = RNG.uniform(-180, 180, count)
    tap = touch(degrees)
    bell = np.exp(-((REST - 48) ** 2).sum(-1) / 800)[None, :, None]
    slide = tap + 0.5 * bell * RNG.normal(size=(count, 1, 2))
    edge = np.stack([RNG.uniform(-5, 5, count), degrees], -1)
    named = {"canonical_pins": tap, "sheared_pins": slide, "edge": edge}
    return {name: jnp.asarray(value, jnp.float32) for name, value in named.items()}


def get_slides(b):
    """Return by how much the slides of a batch moved each pin, (B, P, 2) px."""
    return np.asarray(b["sheared_pins"] - b["canonical_pins"])


def wrapped(degrees):
    return np.abs((np.asarray(degrees) + 180) % 360 - 180)


def test_no_share_is_the_simulator_itself():
    given = batch()
    drawn = make_randomisation(REST, 0.0)(given, jax.random.key(1))
    assert all(np.array_equal(drawn[name], given[name]) for name in given)


@pytest.mark.parametrize("jit", [False, True])
def test_the_edges_direction_turns_with_the_pins(jit):
    given, draw = batch(), make_randomisation(REST, 1.0)
    turned = (jax.jit(draw) if jit else draw)(given, jax.random.key(3))
    mm, degrees = np.asarray(turned["edge"]).T
    by = degrees - np.asarray(given["edge"][:, 1])
    assert wrapped(by - by[0]).max() < 1e-3 and wrapped(by[0]) > 1
    assert wrapped(by[0] / 15 % 1 * 15).max() < 1e-2
    np.testing.assert_array_equal(mm, given["edge"][:, 0])
    assert np.all(degrees <= 180) and np.all(degrees > -180)
    expected = touch(np.float64(degrees))
    size = np.sqrt(np.mean((expected - REST) ** 2))
    assert np.sqrt(np.mean((turned["canonical_pins"] - expected) ** 2)) < 0.1 * size


def test_a_slide_drags_further_or_less_and_its_tap_stays_one(monkeypatch):
    for deviation in ("TURNED_DEG", "SHIFTED"):
        monkeypatch.setattr(augmentation, deviation, 0.0)
    given, draw = batch(), make_randomisation(REST, 1.0)
    drawn = [draw(given, jax.random.key(i)) for i in range(20)]
    length = np.linalg.norm([get_slides(b) for b in (given, *drawn)], axis=(2, 3))
    times = length[1:] / length[0]
    assert 0.9 * MOTION_FACTOR[0] < times.min() < times.max() < 1.1 * MOTION_FACTOR[1]
    assert np.ptp(times) > 1
    # as many fall short of the simulator as go farther
    assert np.median(times) == pytest.approx(1, abs=0.15)
    taps = {"pins": given["canonical_pins"], "edge": given["edge"]}
    for i in (0, 1):  # one turn for both kinds of batch, by the key
        alone = draw(taps, jax.random.key(i))["pins"]
        np.testing.assert_allclose(alone, drawn[i]["canonical_pins"], atol=1e-4)


def test_the_camera_moves_slides_and_not_the_taps_they_are_unsheared_to():
    given, draw = batch(64), make_randomisation(REST, 1.0)
    drawn = draw(given, jax.random.key(5))
    moved, still = (get_slides(b).mean(axis=1).std() for b in (drawn, given))
    shift = augmentation.SHIFTED * 36 / TACTIP_127.rings
    assert 0.5 < moved / np.hypot(1.5 * still, shift) < 2
    taps, before = (np.asarray(b["canonical_pins"]).mean(axis=1).std() for b in (drawn, given))
    assert taps == pytest.approx(before, rel=0.2)
