"""Rows of the same pose: drawn from all of them, or from all others."""

import numpy as np

from jaxunshear.data.reader import group_by_pose

STIMULUS = np.array([0, 1, 0, 0, 1, 0, 0])
POSE = np.array([5, 5, 2, 5, 5, 5, 9])
ALIKE = [{0, 3, 5}, {1, 4}, {2}, {0, 3, 5}, {1, 4}, {0, 3, 5}, {6}]


def met(draw, times=60):
    generator, rows = np.random.default_rng(0), np.arange(7)
    return [
        set(row) for row in np.stack([draw(rows, generator) for _ in range(times)], axis=1).tolist()
    ]


def test_groups_are_of_one_pose_of_one_stimulus():
    siblings = group_by_pose(STIMULUS, POSE)
    assert [set(siblings.get_group(row).tolist()) for row in range(7)] == ALIKE


def test_any_of_a_group_is_drawn():
    assert met(group_by_pose(STIMULUS, POSE).sample_any) == ALIKE


def test_others_are_not_the_row_itself_unless_it_is_alone():
    found = met(group_by_pose(STIMULUS, POSE).sample_other)
    assert found == [rows - {row} or {row} for row, rows in enumerate(ALIKE)]


def test_all_are_as_likely():
    siblings, generator = group_by_pose(STIMULUS, POSE), np.random.default_rng(1)
    counts = np.bincount(siblings.sample_any(np.zeros(9000, int), generator), minlength=7)
    assert np.all(np.abs(counts[[0, 3, 5]] - 3000) < 200)
    counts = np.bincount(siblings.sample_other(np.zeros(9000, int), generator), minlength=7)
    assert counts[0] == 0 and np.all(np.abs(counts[[3, 5]] - 4500) < 200)
