"""Shapes: signs, distances, normals, targets."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.stimuli import Outline
from jaxunshear.errors import UserError
from jaxunshear.simulator.scene import compute_edge_labels, make_scenes
from jaxunshear.simulator.shapes import FAR_MM
from jaxunshear.simulator.stimuli import (
    SHAPES,
    STIMULI,
    TRAINING,
    UNSEEN,
    compute_outward_normal,
    compute_signed_distance,
    get_closed_stimulus,
    get_stimulus,
    make_stimulus,
)

EDGED = (*SHAPES, "edge")
CHEAP = ("disk", "clover", "edge", "surface")  # of one operation after the other
distance = jax.jit(compute_signed_distance, static_argnums=0)
normal = jax.jit(compute_outward_normal, static_argnums=0)


@pytest.mark.parametrize("name", EDGED)
def test_target_lies_on_the_edge_with_x_outward(name):
    stimulus = STIMULI[name]
    line = jnp.asarray([[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    inside, edge, outside = np.asarray(distance(stimulus, line))
    assert abs(edge) < 1e-4 and inside < -0.2 and outside > 0.2
    np.testing.assert_allclose(normal(stimulus, jnp.asarray([[1e-3, 0.0]]))[0], [1, 0], atol=0.05)


@pytest.mark.parametrize("name", EDGED)
def test_distances_never_change_faster_than_the_point_moves(name):
    points = jax.random.uniform(jax.random.key(0), (2, 4000, 2), minval=-12, maxval=12)
    first, second = (np.asarray(distance(STIMULI[name], p)) for p in points)
    apart = np.linalg.norm(np.asarray(points[0] - points[1]), axis=-1)
    assert np.all(np.abs(first - second) <= apart * (1 + 1e-4) + 1e-4)
    assert np.any(first < 0) and np.any(first > 0)


@pytest.mark.parametrize("name", SHAPES)
def test_shape_lies_within_its_extent(name):
    angle = jnp.linspace(0, 2 * jnp.pi, 400)
    rim = (STIMULI[name].extent_mm + 0.5) * jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)
    assert np.all(np.asarray(jax.jit(STIMULI[name].distance)(rim)) > 0)


def test_disk_is_exact_and_gradients_are_finite_at_centres():
    points = jnp.asarray([[0.0, 0.0], [3.0, 4.0], [-50.0, 0.0]])
    np.testing.assert_allclose(
        distance(STIMULI["disk"], points), [0, np.hypot(53, 4) - 50, -50], atol=1e-4
    )
    assert np.all(np.isfinite(normal(STIMULI["disk"], points)))


@pytest.mark.parametrize(
    "name",
    [name if name in CHEAP else pytest.param(name, marks=pytest.mark.long) for name in STIMULI],
)
def test_jit_and_vmap_agree_with_the_plain_call(name):
    points = jax.random.uniform(jax.random.key(1), (7, 2), minval=-9, maxval=9)
    plain = compute_signed_distance(STIMULI[name], points)
    mapped = jax.jit(jax.vmap(lambda point: compute_signed_distance(STIMULI[name], point)))
    np.testing.assert_allclose(mapped(points), plain, atol=1e-4)


def test_names():
    assert (
        {*SHAPES, "edge", "surface"} == set(STIMULI)
        and (*TRAINING, *UNSEEN) == SHAPES
        and len(UNSEEN) == 4
    )
    assert sum(STIMULI[name].material == "acrylic" for name in UNSEEN) == 2
    with pytest.raises(UserError, match="pyramid"):
        get_stimulus("pyramid")
    with pytest.raises(UserError, match="has no outline"):
        get_closed_stimulus("surface")


def test_outlines_are_shapes_like_those_with_a_name():
    lobed = (
        (-9, -3),
        (9, -3),
        (9, 3),
        (3, 3),
        (3, 9),
        (-3, 9),
        (-3, 3),
        (-9, 3),
    )  # sides of it lie on one line
    own = Outline("lobed", lobed, friction=0.3)
    stimulus = make_stimulus(own)
    assert (
        stimulus is get_closed_stimulus(own) is make_stimulus(Outline("lobed", lobed, friction=0.3))
        and stimulus.friction == 0.3
    )
    assert make_stimulus("disk") is STIMULI["disk"] is make_stimulus(STIMULI["disk"])
    points = jnp.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [-4.0, 7.0]])  # of the target frame
    assert own.place == (9, 1.5, 0)
    np.testing.assert_allclose(distance(stimulus, points), [0, 1, -1, 2], atol=1e-5)
    np.testing.assert_allclose(normal(stimulus, points[:2]), [[1, 0], [1, 0]], atol=1e-6)


def test_an_edge_and_a_surface_are_exact():
    xy = jnp.asarray([[0.0, 3.0], [-7.5, -80.0], [12.0, 0.5]])
    np.testing.assert_array_equal(distance(STIMULI["edge"], xy), xy[:, 0])
    np.testing.assert_array_equal(normal(STIMULI["edge"], xy), [[1, 0]] * 3)
    np.testing.assert_array_equal(distance(STIMULI["surface"], xy), [-FAR_MM] * 3)


def test_an_edges_labels_are_where_across_it_and_how_it_is_turned():
    pose = np.array([[2.5, -4.0, 30.0, 2.0], [-1.0, 3.0, -170.0, 2.0], [0.5, 0.0, 180.0, 1.0]])
    scenes = make_scenes(("edge",), np.zeros(3, int), pose, np.zeros((3, 2)))
    np.testing.assert_allclose(
        compute_edge_labels(("edge",), scenes), [[2.5, -30], [-1.0, 170], [0.5, 180]], atol=1e-5
    )


@pytest.mark.parametrize("name", STIMULI)
def test_no_row_or_column_through_a_corner_has_the_wrong_sign(name):
    """A distance changes by no more than the step between two points, wherever grid lines run."""
    line = np.arange(-80, 80.1, 0.5, dtype=np.float32)
    xy = np.stack(np.meshgrid(line, line), -1)
    found = np.asarray(
        jax.jit(
            lambda xy: jax.lax.map(lambda row: compute_signed_distance(STIMULI[name], row), xy)
        )(xy)
    )
    assert max(np.abs(np.diff(found, axis=axis)).max() for axis in (0, 1)) < 0.501
