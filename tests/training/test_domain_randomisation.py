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
    slide = tap + 0.5 * np.exp(-((REST - 48) ** 2).sum(-1) / 800)[None, :, None] * RNG.normal(
        size=(count, 1, 2)
    )
    edge = np.stack([RNG.uniform(-5, 5, count), degrees], -1)
    named = {"canonical_pins": tap, "sheared_pins": slide, "edge": edge}
    return {name: jnp.asarray(value, jnp.float32) for name, value in named.items()}


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
    by = np.asarray(turned["edge"][:, 1] - given["edge"][:, 1])
    assert wrapped(by - by[0]).max() < 1e-3
    assert wrapped(by[0] / 15 % 1 * 15).max() < 1e-2
    assert wrapped(by[0]) > 1
    assert np.array_equal(turned["edge"][:, 0], given["edge"][:, 0])
    assert np.all(np.asarray(turned["edge"][:, 1]) <= 180)
    assert np.all(np.asarray(turned["edge"][:, 1]) > -180)
    expected = touch(np.asarray(turned["edge"][:, 1], np.float64))
    size = np.sqrt(np.mean((expected - REST) ** 2))
    assert np.sqrt(np.mean((turned["canonical_pins"] - expected) ** 2)) < 0.1 * size


def test_a_slide_drags_further_or_less_and_its_tap_stays_one(monkeypatch):
    for deviation in ("TURNED_DEG", "SHIFTED"):
        monkeypatch.setattr(augmentation, deviation, 0.0)
    given, draw = batch(), make_randomisation(REST, 1.0)

    def length(b):
        return np.linalg.norm(np.asarray(b["sheared_pins"] - b["canonical_pins"]), axis=(1, 2))

    times = np.concatenate(
        [length(draw(given, jax.random.key(i))) / length(given) for i in range(20)]
    )
    assert times.min() > 0.9 * MOTION_FACTOR[0]
    assert times.max() < 1.1 * MOTION_FACTOR[1]
    assert np.ptp(times) > 1
    assert np.median(times) == pytest.approx(
        1, abs=0.15
    )  # as many fall short of the simulator as go farther
    taps = [
        draw({"pins": given["canonical_pins"], "edge": given["edge"]}, jax.random.key(i))["pins"]
        for i in (0, 1)
    ]
    both = [draw(given, jax.random.key(i))["canonical_pins"] for i in (0, 1)]
    for alone, paired in zip(
        taps, both, strict=True
    ):  # one turn for both kinds of batch, by the key
        np.testing.assert_allclose(alone, paired, atol=1e-4)


def test_the_camera_moves_slides_and_not_the_taps_they_are_unsheared_to():
    given, draw = batch(64), make_randomisation(REST, 1.0)
    drawn = draw(given, jax.random.key(5))
    mean = np.asarray(drawn["sheared_pins"] - drawn["canonical_pins"]).mean(axis=1)
    still = np.asarray(given["sheared_pins"] - given["canonical_pins"]).mean(axis=1)
    spacing = 36 / TACTIP_127.rings
    assert 0.5 < mean.std() / np.hypot(still.std() * 1.5, augmentation.SHIFTED * spacing) < 2
    np.testing.assert_allclose(
        np.asarray(drawn["canonical_pins"]).mean(axis=1).std(),
        np.asarray(given["canonical_pins"]).mean(axis=1).std(),
        rtol=0.2,
    )
