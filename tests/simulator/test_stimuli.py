"""Stimuli by name; every shape, and those from points, against outlines by other means."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.stimuli import Outline
from jaxunshear.errors import UserError
from jaxunshear.simulator.shapes import FAR_MM, make_polygon, make_stroke
from jaxunshear.simulator.stimuli import (
    SHAPES,
    STIMULI,
    TRAINING,
    UNSEEN,
    Stimulus,
    compute_distances,
    compute_outward_normal,
    compute_signed_distance,
    get_closed_stimulus,
    get_stimulus,
    make_stimulus,
)
from tests.simulator.outlines import OUTLINES, arc, dense, truth

measure_distance = jax.jit(compute_signed_distance, static_argnums=0)
find_normal = jax.jit(compute_outward_normal, static_argnums=0)


@pytest.mark.parametrize("name", [*SHAPES, "edge"])
def test_target_lies_on_the_edge_with_x_outward(name):
    stimulus = STIMULI[name]
    line = jnp.asarray([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    inside, edge, outside = np.asarray(measure_distance(stimulus, line))
    assert abs(edge) < 1e-4 and inside < -0.2 and outside > 0.2
    normal = find_normal(stimulus, jnp.asarray([[1e-3, 0.0]]))[0]
    np.testing.assert_allclose(normal, [1, 0], atol=0.05)


@pytest.mark.parametrize("name", SHAPES)
def test_shape_lies_within_its_extent(name):
    angle = jnp.linspace(0, 2 * jnp.pi, 400)
    rim = (STIMULI[name].extent_mm + 0.5) * jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)
    assert np.all(np.asarray(jax.jit(STIMULI[name].distance)(rim)) > 0)


@pytest.mark.parametrize("name", STIMULI)
def test_a_distance_changes_by_no_more_than_the_step_between_two_points(name):
    """A wrong sign in a row or column through a corner would."""
    line = np.arange(-80, 80.1, 0.5, dtype=np.float32)
    found = compute_distances(STIMULI[name], np.stack(np.meshgrid(line, line), -1))
    assert max(np.abs(np.diff(found, axis=axis)).max() for axis in (0, 1)) < 0.501


def test_names():
    assert {*SHAPES, "edge", "surface"} == set(STIMULI)
    assert (*TRAINING, *UNSEEN) == SHAPES and len(UNSEEN) == 4
    assert sum(STIMULI[name].material == "acrylic" for name in UNSEEN) == 2
    with pytest.raises(UserError, match="pyramid"):
        get_stimulus("pyramid")
    with pytest.raises(UserError, match="has no outline"):
        get_closed_stimulus("surface")


def test_outlines_are_shapes_like_those_with_a_name():
    # sides of it lie on one line
    lobed = ((-9, -3), (9, -3), (9, 3), (3, 3), (3, 9), (-3, 9), (-3, 3), (-9, 3))
    own = Outline("lobed", lobed, friction=0.3)
    stimulus = make_stimulus(own)
    assert stimulus.friction == 0.3
    assert stimulus is get_closed_stimulus(own)
    assert stimulus is make_stimulus(Outline("lobed", lobed, friction=0.3))
    assert make_stimulus("disk") is STIMULI["disk"] is make_stimulus(STIMULI["disk"])
    points = jnp.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [-4.0, 7.0]])  # of the target frame
    assert own.place == (9, 1.5, 0)
    np.testing.assert_allclose(measure_distance(stimulus, points), [0, 1, -1, 2], atol=1e-5)
    np.testing.assert_allclose(find_normal(stimulus, points[:2]), [[1, 0], [1, 0]], atol=1e-6)


def test_an_edge_and_a_surface_are_exact():
    xy = jnp.asarray([[0.0, 3.0], [-7.5, -80.0], [12.0, 0.5]])
    np.testing.assert_array_equal(measure_distance(STIMULI["edge"], xy), xy[:, 0])
    np.testing.assert_array_equal(find_normal(STIMULI["edge"], xy), [[1, 0]] * 3)
    np.testing.assert_array_equal(measure_distance(STIMULI["surface"], xy), [-FAR_MM] * 3)


OFF_MM, ANGLE_DEG, SLOPE = 0.02, 1.0, 1e-3
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
    assert np.abs(distance - there.distance).max() < OFF_MM
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
