"""Intervals against closed forms."""

import numpy as np
import pytest
from scipy.stats import norm, t

from jaxunshear.evaluation.intervals import compute_intervals
from jaxunshear.sweep.scores import (
    compute_interval,
    resample_means,
)

POSES = np.repeat(np.arange(60), 2)  # two slides each


def scores(seeds: int, of_seed: float, of_pose: float, of_slide: float = 0.0) -> np.ndarray:
    """(seeds, N) sums of an effect of the seed, one of the pose, and one of the slide."""
    random = np.random.default_rng(3)
    pose = random.normal(0, of_pose, 60)[POSES]
    return random.normal(0, of_seed, (seeds, 1)) + pose + random.normal(0, of_slide, len(POSES)) + 5


def width_expected(values: np.ndarray) -> float:
    """Additive effects: Student's t for the means of seeds, a normal distribution for poses."""
    of_seeds = values.mean(axis=1)
    of_poses = values.mean(axis=0).reshape(60, 2).mean(axis=1)
    seeds = t.ppf(0.975, len(of_seeds) - 1) ** 2 * of_seeds.var(ddof=1) / len(of_seeds)
    return 2 * np.sqrt(seeds + norm.ppf(0.975) ** 2 * of_poses.var() / len(of_poses))


@pytest.mark.parametrize(("of_seed", "of_pose"), [(0.0, 1.0), (1.0, 0.0), (0.3, 0.5)])
def test_the_width_is_that_of_seeds_and_poses_crossed(of_seed, of_pose):
    values = scores(12, of_seed, of_pose)
    low, high = compute_interval(values, POSES)
    # of 1,000 resamples; quantiles err by 5 %
    assert high - low == pytest.approx(width_expected(values), rel=0.08)
    assert low < values.mean() < high


@pytest.mark.parametrize("seeds", [2, 3, 5])
def test_where_seeds_alone_vary_it_is_students_t(seeds):
    values = scores(seeds, 1.0, 0.0)
    low, high = compute_interval(values, POSES)
    deviation = values[:, 0].std(ddof=1) / np.sqrt(seeds)
    exact = t.interval(0.95, seeds - 1, values[:, 0].mean(), deviation)
    np.testing.assert_allclose([low, high], exact, atol=0.06 * (exact[1] - exact[0]))


@pytest.mark.parametrize("seeds", [3, 5])
@pytest.mark.parametrize(
    "effects", [(1.0, 0.0, 0.0), (0.2, 1.0, 1.0), (0.1, 1.0, 0.5), (0.0, 1.0, 1.0)]
)
def test_it_holds_the_true_mean_as_often_as_it_says(seeds, effects):
    """Effects of seeds and poses and a rest vary; with 800 sweeps a share of .95 errs by .008.

    A plain bootstrap of three seeds contains the mean in three cases of four.
    """
    of_seed, of_pose, rest = effects
    random = np.random.default_rng(seeds)
    held = []
    for _ in range(800):
        crossed = random.normal(0, of_seed, (seeds, 1)) + random.normal(0, of_pose, 60)
        values = (crossed + random.normal(0, rest, (seeds, 60)))[:, POSES]
        low, high = compute_interval(values + 5, POSES)
        held.append(low <= 5 <= high)
    assert np.mean(held) >= 0.93


def test_slides_of_a_pose_are_drawn_together():
    """As independent contacts they would give an interval narrower by the square root of two."""
    values = scores(1, 0.0, 1.0)
    low, high = compute_interval(values, POSES)
    alone = compute_interval(values, np.arange(len(POSES)))
    assert (high - low) / (alone[1] - alone[0]) == pytest.approx(np.sqrt(2), rel=0.1)


def test_one_seed_gives_the_interval_of_the_evaluation():
    values = scores(1, 0.0, 1.0, 0.5)
    of_one = compute_intervals({"x": values[0]}, POSES, 0)["x"]
    assert compute_interval(values, POSES) == pytest.approx(of_one, rel=1e-12)


def test_poses_may_have_different_numbers_of_contacts():
    values, poses = np.array([[1.0, 1.0, 1.0, 5.0]]), np.array([0, 0, 0, 1])
    found = set(np.round(resample_means(values, poses), 12))
    assert found == {1.0, 2.0, 5.0}  # both drawn once: the mean over contacts, not over poses


def test_shapes_that_do_not_fit_are_refused():
    for values, poses in (
        (np.ones(3), np.ones(3)),
        (np.ones((0, 3)), np.ones(3)),
        (np.ones((2, 3)), np.ones(2)),
    ):
        with pytest.raises(ValueError, match="seeds, N"):
            compute_interval(values, poses)
