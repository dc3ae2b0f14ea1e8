"""A pose is in one split, whichever set of its seed holds it."""

from dataclasses import replace

import numpy as np
import pytest

from jaxunshear.config.data import PairedData, PoseData
from jaxunshear.config.splits import BLOCK, SPLITS, assign_split, assign_splits, count_train_poses
from jaxunshear.data.sampling import sample_contacts

GOLDEN = [2, 0, 0, 0, 1, 0, 1, 0, 2, 0, 0, 2, 1, 0, 0, 1, 0, 0, 0, 2]
DRAWN = (7, 60)
SIZES = (5, 6, 7, 8, 9, 10, 11, 13, 24, 36, 60, 150)


@pytest.mark.parametrize(
    "seed",
    [0, pytest.param(7, marks=pytest.mark.long), pytest.param(2**31 - 1, marks=pytest.mark.long)],
)
def test_no_pose_is_in_two_splits_of_sets_of_one_seed(seed):
    """Compare the poses themselves over sizes, slides, stimuli and kinds of set."""
    seen: dict[tuple, set[str]] = {}
    other = {"stimuli": ("teardrop", "flower", "disk"), "taps": 2, "slides": 5}
    for size in DRAWN:
        paired = PairedData(poses=size, seed=seed)
        for settings in (paired, replace(paired, **other), PoseData(poses=size, seed=seed)):
            shots = sample_contacts(settings)
            scenes = zip(shots.scenes.stimulus, shots.scenes.pose, shots.split, strict=True)
            for stimulus, pose, split in scenes:
                place = (settings.stimuli[stimulus], *pose.tolist())
                seen.setdefault(place, set()).add(SPLITS[split])
    assert len(seen) == 4 * max(DRAWN)
    assert all(len(splits) == 1 for splits in seen.values())


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("stimulus", ["disk", "clover", "spiral_2"])
def test_a_larger_set_begins_with_the_smaller_and_every_split_is_there(seed, stimulus):
    largest = assign_splits(seed, stimulus, max(SIZES))
    for size in SIZES:
        splits = assign_splits(seed, stimulus, size)
        np.testing.assert_array_equal(splits, largest[:size])
        assert set(splits) == {0, 1, 2}
        assert count_train_poses(seed, stimulus, size) == (splits == 0).sum()
        if size % BLOCK == 0:
            assert np.bincount(splits).tolist() == [size * 3 // 5, size // 5, size // 5]


def test_every_place_of_a_block_is_held_out_as_often():
    """Another seed or stimulus draws anew: they share a fifth of their test poses, by chance."""
    splits = assign_splits(0, "disk", 20_000)
    for split in (1, 2):
        shares = np.bincount(np.flatnonzero(splits == split) % BLOCK) / 4000
        np.testing.assert_allclose(shares, 0.2, atol=0.03)
    for other in (assign_splits(1, "disk", 20_000), assign_splits(0, "clover", 20_000)):
        assert 0.17 < (other[splits == 2] == 2).mean() < 0.23


def test_splits_are_those_of_all_later_versions():
    """They are written down: another hash would carry tests into trainings without a word."""
    assert assign_splits(0, "disk", 20).tolist() == GOLDEN
    assert [assign_split(0, "disk", pose) for pose in range(20)] == GOLDEN
