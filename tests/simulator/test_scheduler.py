"""Batches of scenes, their nodes and increments, and shapes as obstacles."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.errors import UserError
from jaxunshear.simulator.harmonics import make_sixfold_permutations
from jaxunshear.simulator.level import LEVELS
from jaxunshear.simulator.paths import Paths, cut_increments, make_paths
from jaxunshear.simulator.scene import make_scenes, sample_poses, sample_slides
from jaxunshear.simulator.scheduler import Simulation, make_plan
from jaxunshear.simulator.stimuli import (
    REACH_MM,
    STIMULI,
    TRAINING,
    Stimulus,
    compute_signed_distance,
    interpolate_distance,
    sample_obstacles,
)

AUTO = Simulation(TACTIP_331, TRAINING, LEVELS["auto"])


def sample_paths(count=200):
    generator = np.random.default_rng(2)
    pose = sample_poses(generator, count, 5.0, 45.0, (1.0, 6.0))
    move = sample_slides(generator, count, 2.5)
    move[::3] = 0
    pose[::10, 3] = -1.0
    paths = make_paths(make_scenes(TRAINING, generator.integers(0, 3, count), pose, move))
    paths.friction[5::20] = 0
    return paths


def test_every_path_is_planned_once_and_different_needs_apart():
    paths = sample_paths()
    batches = make_plan(AUTO, paths)
    rows = np.concatenate([batch.rows for batch in batches])
    np.testing.assert_array_equal(np.sort(rows), np.arange(200))
    for batch in batches:
        assert len(batch.rows) <= AUTO.batch
        if len(batch.nodes):
            assert np.all((paths.friction[batch.rows] > 0) == batch.friction)
            assert np.all(paths.points[batch.rows, :, 3].max(axis=1) > 0)


def test_grouping_costs_less_than_slices():
    def compute_work(level):
        batches = make_plan(replace(AUTO, level=level), sample_paths())
        return sum(len(batch.rows) * batch.steps * len(batch.nodes) ** 2 for batch in batches)

    auto = AUTO.level
    ungrouped = replace(auto, omit=tuple(name for name in auto.omit if name != "grouping"))
    whole = replace(auto, omit=())
    assert compute_work(auto) < 0.5 * compute_work(ungrouped) < 0.5 * compute_work(whole)
    parts, nodes = make_plan(replace(AUTO, level=whole), sample_paths()), len(AUTO.dome.nodes)
    assert [(len(part.nodes), part.friction) for part in parts] == [(nodes, True)] * 4


def test_turned_scenes_keep_their_own_nodes():
    """The nodes of a batch, turned back, hold those that each of its scenes can touch."""
    paths = sample_paths(64)
    turned = make_sixfold_permutations(len(AUTO.dome.nodes))
    for batch in make_plan(AUTO, paths):
        for row, turn in zip(batch.rows, batch.turn, strict=True):
            (alone,) = make_plan(AUTO, paths.take(np.array([row])))
            assert np.isin(alone.nodes, turned[turn][batch.nodes]).all()


def test_increments_follow_the_way_points():
    level = replace(LEVELS["auto"], press_mm=1.0, slide_mm=0.5)
    points = np.zeros((3, 3, 6))
    points[0, 1:, 3], points[0, 2, :2] = 2.5, [3.0, 4.0]
    points[1, 1:, 3] = 0.5
    points[2, 1:, 2] = 90.0
    paths = Paths(np.zeros(3, int), np.ones(3), points)
    path, count = cut_increments(paths, level, 20.0)
    assert count.tolist() == [3 + 10, 1, 16] and path.shape == (3, 17, 6)
    np.testing.assert_allclose(path[0, 3], [0, 0, 0, 2.5, 0, 0])
    np.testing.assert_allclose(path[0, 8], [1.5, 2, 0, 2.5, 0, 0])
    np.testing.assert_allclose(path[0, 13:], np.broadcast_to([3, 4, 0, 2.5, 0, 0], (4, 6)))
    np.testing.assert_allclose(path[2, 16, 2], np.pi / 2)
    assert cut_increments(paths, replace(level, omit=()), 20.0)[1].tolist() == [13, 2, 16]


def test_strong_friction_is_pressed_by_short_increments():
    points = np.zeros((3, 2, 6))
    points[:, 1, 3] = 6.0
    paths = Paths(np.zeros(3, int), np.array([0.5, 1.0, np.inf]), points)
    assert cut_increments(paths, LEVELS["auto"], 20.0)[1].tolist() == [2, 2, 6]


@pytest.mark.parametrize("index", range(len(STIMULI)), ids=STIMULI)
def test_sampled_obstacles_agree_with_the_shapes(index):
    points = jnp.asarray(np.random.default_rng(0).uniform(-15, 15, (1, 500, 2)), jnp.float32)
    stimulus = tuple(STIMULI.values())[index]
    exact = np.asarray(compute_signed_distance(stimulus, points))
    obstacles = sample_obstacles(tuple(STIMULI))
    sampled = np.asarray(interpolate_distance(obstacles, jnp.asarray([index]), points))
    if stimulus.name == "surface":  # has no edge within reach
        assert exact.max() < -5 and sampled.max() < -5
    else:
        assert np.percentile(np.abs(sampled - exact)[np.abs(exact) < 5], 95) < 0.01


@pytest.mark.parametrize("index", range(3))
def test_beyond_the_grid_shapes_are_far_away(index):
    far = jnp.asarray([[[REACH_MM + 40, 0.0], [0.0, -REACH_MM - 7]]])
    assert interpolate_distance(AUTO.obstacles, jnp.asarray([index]), far).min() > 7


def test_a_shape_without_distances_is_refused():
    broken = Stimulus("broken", lambda p: jnp.log(p[..., 0]), (0.0, 0.0, 0.0), 5.0)
    with pytest.raises(UserError, match="broken"):
        sample_obstacles((broken,))
