"""Pins as dots: found again where they were drawn."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.sensor import TACTIP_127
from jaxunshear.perception.drawing import draw_dots
from jaxunshear.perception.pin_detection import detect_pin_centres
from jaxunshear.simulator.pin_layout import compute_pin_lattice

SIZE = 128
FLAT = compute_pin_lattice(TACTIP_127)
PINS = (SIZE - 1) / 2 + 0.375 * SIZE * FLAT / np.linalg.norm(FLAT, axis=-1).max()


def draw(pins):
    return np.asarray(draw_dots(jnp.asarray(pins[None], jnp.float32), 2.1, SIZE))[0, ..., 0]


def find(image):
    return detect_pin_centres((image * 255).astype(np.uint8))


@pytest.mark.parametrize("shift", [0.0, 0.3])
def test_dots_are_found_where_they_were_drawn(shift):
    image = draw(PINS + shift)
    found = find(image)
    assert len(found) == len(PINS)
    apart = np.linalg.norm(found[:, None] - (PINS + shift), axis=-1).min(axis=1)
    assert apart.max() < 0.35
    assert image.sum() / len(PINS) == pytest.approx(np.pi * 2.1**2, rel=0.1)


def test_pins_that_are_not_seen_are_not_drawn():
    holes = np.where(np.arange(len(PINS))[:, None] < 30, np.nan, PINS)
    assert len(find(draw(holes))) == len(PINS) - 30
