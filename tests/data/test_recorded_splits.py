"""A block of poses: no test pose has a near neighbour in training."""

import re

import numpy as np
import pytest

from jaxunshear.config.splits import SPLITS
from jaxunshear.data.recorded_splits import cut_block
from jaxunshear.errors import UserError


def draw_poses(count, seed=0):
    """Draw poses (N, 6) of an edge: y evenly over 12 mm, z over 2 mm, Rz over the full circle."""
    generator, pose = np.random.default_rng(seed), np.zeros((count, 6))
    pose[:, 1] = generator.permutation(np.linspace(-6, 6, count))
    pose[:, 2] = generator.uniform(3, 4.99, count)
    pose[:, 5] = generator.uniform(-180, 180, count)
    return pose


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("test", "validation"), [(0.1, 0.1), (0.2, 0.3), (0.45, 0.45)])
def test_no_training_pose_is_nearer_to_a_test_pose_than_the_gap(seed, test, validation):
    pose = draw_poses(1000)
    split, note = cut_block(pose, test, validation, seed)
    gap = float(re.search(r"lies within ([\d.]+) mm of them", note)[1])
    train, validated, tested = (pose[split == index, 1] for index in range(3))
    nearest = np.abs(tested[:, None] - train).min()
    assert nearest >= 0.99 * gap and gap == pytest.approx(12 * validation / 2, rel=0.03)
    assert (train < tested.min()).any() and (train > tested.max()).any()  # nothing is extrapolated
    assert (validated < tested.min()).any() and (validated > tested.max()).any()
    shares = np.bincount(split, minlength=3) / len(pose)
    np.testing.assert_allclose(shares, (1 - test - validation, validation, test), atol=0.005)
    inside = (pose[:, 1] >= tested.min()) & (pose[:, 1] <= tested.max())
    assert (split[inside] == SPLITS.index("test")).all()  # contiguous


def test_the_seed_moves_the_block_and_the_order_of_the_poses_does_not():
    pose, order = draw_poses(500), np.random.default_rng(1).permutation(500)
    split, note = cut_block(pose, 0.1, 0.1, 0)
    again, same = cut_block(pose[order], 0.1, 0.1, 0)
    np.testing.assert_array_equal(again, split[order])
    assert same == note != cut_block(pose, 0.1, 0.1, 1)[1]


def test_equal_values_are_in_one_split():
    pose = draw_poses(600)
    pose[:, 1] = np.round(pose[:, 1])
    pose[:, 2] = 4
    split, _ = cut_block(pose, 0.1, 0.3, 0)
    for value in np.unique(pose[:, 1]):
        assert len(set(split[pose[:, 1] == value])) == 1


def test_the_label_of_most_values_is_cut_and_a_full_circle_last():
    pose = draw_poses(300)
    pose[:, 1] = np.round(pose[:, 1])  # 13 values: z has more, Rz as many and turns
    assert "test poses have z " in cut_block(pose, 0.1, 0.1, 0)[1]
    pose[:, 1:3] = 0
    split, note = cut_block(pose, 0.1, 0.1, 0)
    train, tested = pose[split == 0, 5], pose[split == 2, 5]
    apart = np.abs((tested[:, None] - train + 180) % 360 - 180)
    assert "test poses have Rz " in note and apart.min() > 10


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ([0.0], "no label of the poses varies"),
        ([0.0, 1.0, 2.0, 3.0], "y_mm takes only 4 values, too few"),
    ],
)
def test_labels_that_leave_no_gap_are_refused_with_the_remedy(values, complaint):
    pose = np.zeros((100, 6))
    pose[:, 1] = np.resize(values, 100)
    with pytest.raises(
        UserError, match=rf"paired\.split block: {complaint}.*--paired\.split random"
    ):
        cut_block(pose, 0.1, 0.1, 0)
