"""Stimuli: targets, extents, names, outlines, an edge and a surface."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.stimuli import Outline
from jaxunshear.errors import UserError
from jaxunshear.simulator.shapes import FAR_MM
from jaxunshear.simulator.stimuli import (
    SHAPES,
    STIMULI,
    TRAINING,
    UNSEEN,
    compute_distances,
    compute_outward_normal,
    compute_signed_distance,
    get_closed_stimulus,
    get_stimulus,
    make_stimulus,
)

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
