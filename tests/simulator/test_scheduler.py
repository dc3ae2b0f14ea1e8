"""Batches of scenes, their nodes and increments, and shapes as obstacles."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.errors import UserError
from jaxunshear.simulator.dome import load_dome
from jaxunshear.simulator.harmonics import make_sixfold_permutations
from jaxunshear.simulator.level import LEVELS, without_omissions
from jaxunshear.simulator.obstacle import REACH_MM, interpolate_distance, sample_distances
from jaxunshear.simulator.paths import Paths, make_paths
from jaxunshear.simulator.scene import make_scenes, sample_poses, sample_slides
from jaxunshear.simulator.scheduler import cut_increments, make_plan, pad_count
from jaxunshear.simulator.stimuli import (
    STIMULI,
    TRAINING,
    Stimulus,
    compute_signed_distance,
    get_stimulus,
)

RADIUS = TACTIP_331.dome_radius_mm


@pytest.fixture(scope="module")
def obstacles():
    return sample_distances(tuple(map(get_stimulus, TRAINING)))


@pytest.fixture(scope="module")
def nodes():
    return load_dome(TACTIP_331).nodes


def mixed(count=200, seed=2):
    generator = np.random.default_rng(seed)
    pose = sample_poses(generator, count, 5.0, 45.0, (1.0, 6.0))
    move = sample_slides(generator, count, 2.5)
    move[::3] = 0
    pose[::10, 3] = -1.0
    found = make_paths(make_scenes(TRAINING, generator.integers(0, 3, count), pose, move))
    found.friction[5::20] = 0
    return found


def planned(obstacles, nodes, paths, level, batch=64):
    return make_plan(obstacles, nodes, RADIUS, paths, level, batch, False)


def test_every_path_once_and_needs_apart(obstacles, nodes):
    paths = mixed()
    batches = planned(obstacles, nodes, paths, LEVELS["auto"])
    np.testing.assert_array_equal(
        np.sort(np.concatenate([part.rows for part in batches])), np.arange(200)
    )
    for part in batches:
        assert len(part.rows) <= 64
        assert np.all((paths.friction[part.rows] > 0) == part.friction) or not len(part.nodes)
        touching = paths.points[part.rows, :, 3].max(axis=1) > 0
        assert np.all(touching) or not len(part.nodes)


def test_grouping_costs_less_than_slices(obstacles, nodes):
    def work(level):
        return sum(
            len(b.rows) * b.steps * len(b.nodes) ** 2
            for b in planned(obstacles, nodes, mixed(), level)
        )

    auto = LEVELS["auto"]
    ungrouped = replace(auto, omit=tuple(name for name in auto.omit if name != "grouping"))
    assert work(auto) < 0.5 * work(ungrouped) < 0.5 * work(without_omissions(auto))


def test_turned_scenes_keep_their_own_nodes(obstacles, nodes):
    """The nodes of a batch, turned back, hold those that each of its scenes can touch."""
    paths = mixed(64)
    turned = make_sixfold_permutations(len(nodes))
    for part in planned(obstacles, nodes, paths, LEVELS["auto"]):
        for row, turn in zip(part.rows, part.turn, strict=True):
            alone = planned(obstacles, nodes, paths.take(np.array([row])), LEVELS["auto"], 1)[0]
            assert np.isin(alone.nodes, turned[turn][part.nodes]).all()


def test_nothing_left_out_is_everything(obstacles, nodes):
    parts = planned(obstacles, nodes, mixed(), without_omissions(LEVELS["auto"]))
    assert len(parts) == 4 and all(
        len(part.nodes) == len(nodes) and part.friction for part in parts
    )


def test_increments_follow_the_way_points():
    level = replace(LEVELS["auto"], press_mm=1.0, slide_mm=0.5)
    points = np.zeros((3, 3, 6))
    points[0, 1:, 3] = 2.5
    points[0, 2, :2] = 3.0, 4.0
    points[1, 1:, 3] = 0.5
    points[2, 1:, 2] = 90.0
    path, count = cut_increments(Paths(np.zeros(3, int), np.ones(3), points), level, 20.0)
    assert count.tolist() == [3 + 10, 1, 16] and path.shape == (3, 17, 6)
    np.testing.assert_allclose(path[0, 3], [0, 0, 0, 2.5, 0, 0])
    np.testing.assert_allclose(path[0, 8], [1.5, 2, 0, 2.5, 0, 0])
    np.testing.assert_allclose(path[0, 13:], np.broadcast_to([3, 4, 0, 2.5, 0, 0], (4, 6)))
    np.testing.assert_allclose(path[2, 16, 2], np.pi / 2)
    fixed, count = cut_increments(
        Paths(np.zeros(3, int), np.ones(3), points), without_omissions(level), 20.0
    )
    assert count.tolist() == [13, 2, 16]


def test_padding():
    assert [pad_count(count, (4, 16)) for count in (1, 4, 5, 16, 17)] == [4, 4, 16, 16, 17]


def test_sampled_obstacles_agree_with_the_shapes():
    points = np.random.default_rng(0).uniform(-15, 15, (1, 500, 2))
    obstacles = sample_distances(tuple(STIMULI.values()))
    for index, stimulus in enumerate(STIMULI.values()):
        exact = np.asarray(compute_signed_distance(stimulus, jnp.asarray(points, jnp.float32)))
        sampled = np.asarray(
            interpolate_distance(obstacles, jnp.asarray([index]), jnp.asarray(points, jnp.float32))
        )
        if stimulus.name == "surface":  # has no edge within reach
            assert exact.max() < -5 and sampled.max() < -5
            continue
        near = np.abs(exact) < 5
        assert np.percentile(np.abs(sampled - exact)[near], 95) < 0.01, stimulus.name


def test_beyond_the_grid_shapes_are_far_away(obstacles):
    far = jnp.asarray([[[REACH_MM + 40, 0.0], [0.0, -REACH_MM - 7]]])
    for which in range(3):
        assert float(interpolate_distance(obstacles, jnp.asarray([which]), far).min()) > 7


def test_a_shape_without_distances_is_refused():
    broken = Stimulus("broken", lambda p: jnp.log(p[..., 0]), (0.0, 0.0, 0.0), 5.0)
    with pytest.raises(UserError, match="broken"):
        sample_distances((broken,))
