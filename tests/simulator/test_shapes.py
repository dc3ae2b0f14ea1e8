"""Every shape, and those that are made from points, against outlines by other means."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.simulator.shapes import make_polygon, make_stroke
from jaxunshear.simulator.stimuli import (
    SHAPES,
    STIMULI,
    Stimulus,
    compute_outward_normal,
    compute_signed_distance,
)
from tests.simulator.outlines import OUTLINES, arc, dense, truth

FAR_MM, ANGLE_DEG, SLOPE = 0.02, 1.0, 1e-3
# one corner is none
L_SHAPE = np.array([[0, 0], [30, 0], [30, 10], [20, 10], [10, 10], [10, 25], [0, 25]], float)
BOW = arc(0, 0, 20, 0, 180)[::31]  # of the 4000 points also the last
BAR = np.array([[-10.0, 0.0], [0.0, 0.0], [0.0, 0.0], [10.0, 0.0]])
L_BACKWARDS = np.concatenate([L_SHAPE, L_SHAPE[:1]])[::-1]


def draw_bar():
    return np.concatenate([arc(10, 0, 3, -90, 90), arc(-10, 0, 3, 90, 270)])


def draw_bow():
    sides = arc(0, 0, 23, 0, 180), arc(0, 0, 17, 180, 0)
    return np.concatenate([sides[0], arc(-20, 0, 3, 180, 360), sides[1], arc(20, 0, 3, 180, 360)])


CUSTOM = {  # distance, outline, target
    "L": (make_polygon(L_SHAPE), lambda: L_SHAPE, (20.0, 10.0, 90.0)),
    "L backwards": (make_polygon(L_BACKWARDS), lambda: L_SHAPE, (30.0, 5.0, 0.0)),
    "round": (
        make_polygon(arc(0, 0, 20, 0, 359.9)[::10]),
        lambda: arc(0, 0, 20, 0, 360),
        (20.0, 0.0, 0.0),
    ),
    "bar": (make_stroke(BAR, 3.0), draw_bar, (0.0, 3.0, 90.0)),
    "bow": (make_stroke(BOW, 3.0), draw_bow, (0.0, 23.0, 90.0)),
}
NAMES = (*SHAPES, *CUSTOM)


def draw(name):
    """Return the stimulus, and its outline in its target frame."""
    if name in CUSTOM:
        distance, outline, target = CUSTOM[name]
        stimulus = Stimulus(name, distance, target, 40.0)
    else:
        stimulus, outline = STIMULI[name], OUTLINES[name]
    x, y, turn = stimulus.target
    cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    return stimulus, (dense(outline()) - [x, y]) @ np.array([[cos, -sin], [sin, cos]])


def sample_places(line):
    """Sample about the target, about the full shape, on its outline, and within a hair of it."""
    generator = np.random.default_rng(0)
    target = generator.uniform(-8, 8, (1000, 2))
    full = generator.uniform(line.min(0) - 15, line.max(0) + 15, (1000, 2))
    at = generator.integers(0, len(line), 1000)
    on = (line[at] + line[(at + 1) % len(line)]) / 2
    return np.concatenate([target, full, on, on + generator.normal(0, 1e-3, on.shape)])


CHEAP = {("clover", np.float64), ("L", np.float64), *((name, np.float32) for name in NAMES)}


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        pytest.param(name, kind, marks=[] if (name, kind) in CHEAP else pytest.mark.long)
        for kind in (np.float32, np.float64)
        for name in NAMES
    ],
)
def test_distance_and_direction_are_those_of_the_outline(name, kind):
    stimulus, line = draw(name)

    @jax.jit
    def measure(xy):
        slope = jax.vmap(jax.grad(lambda p: compute_signed_distance(stimulus, p)))(xy)
        return compute_signed_distance(stimulus, xy), slope, compute_outward_normal(stimulus, xy)

    with jax.enable_x64(kind == np.float64):
        xy = jnp.asarray(sample_places(line), kind)
        distance, slope, normal = (np.asarray(value) for value in measure(xy))
    assert distance.dtype == slope.dtype == normal.dtype == kind
    there = truth(line, np.asarray(xy, float))
    assert np.abs(distance - there.distance).max() < FAR_MM
    assert there.clear.mean() > 0.95
    np.testing.assert_allclose(np.linalg.norm(slope, axis=-1)[there.clear], 1, atol=SLOPE)
    off = np.degrees(np.arccos(np.clip(np.sum(normal * there.normal, -1), -1, 1)))
    assert off[there.clear].max() < ANGLE_DEG


@pytest.mark.parametrize("name", NAMES)
def test_no_place_is_without_a_finite_slope(name):
    """Middles, axes of symmetry, corners, rows and columns through them."""
    special = np.array([0, 28, -28, 45, 23 / 5, 9, 14, 20, 10, 30, 5], np.float32)
    own = jnp.asarray(np.stack(np.meshgrid(special, special), -1).reshape(-1, 2))
    distance, slope = jax.jit(jax.vmap(jax.value_and_grad(draw(name)[0].distance)))(own)
    assert np.isfinite(distance).all() and np.isfinite(slope).all()
    assert np.linalg.norm(slope, axis=-1).max() < 1 + SLOPE


def test_a_polygon_has_a_slope_on_its_sides_and_corners_and_a_sign_beside_them():
    """Just there an unsigned distance with a sign has no slope."""
    distance, half = make_polygon(L_SHAPE), np.sqrt(0.5)
    on = jnp.asarray([[15.0, 0.0], [30.0, 5.0], [20.0, 10.0], [30.0, 10.0], [10.0, 10.0]])
    expected = [[0, -1], [1, 0], [0, 1], [half, half], [half, half]]
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(distance)))(on), expected, atol=1e-6)
    beside = [[33.0, 14.0], [7.0, 6.0], [10.0, 0.5], [-3.0, 10.0], [20.0, 9.0], [20.0, 11.0]]
    signed = jax.jit(distance)(jnp.asarray(beside))
    np.testing.assert_allclose(signed, [5, -5, -0.5, 3, -1, 1], atol=1e-5)
