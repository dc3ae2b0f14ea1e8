"""Slides that poses share: what is shared, and who is whose partner."""

import dataclasses

import numpy as np
import pytest

from jaxunshear.angles import rotate_2d
from jaxunshear.config import configs
from jaxunshear.config.data import PairedData
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.reader import (
    OTHER_IMAGE,
    OTHER_PINS,
    SHEARED_IMAGE,
    SHEARED_PINS,
    SWAPPED_IMAGE,
    SWAPPED_PINS,
    shift_examples,
)
from jaxunshear.data.sampling import find_slide_leaders, sample_pairs
from jaxunshear.data.stored_sets import FactorialReader, index_shared_slides, make_set
from jaxunshear.errors import UserError

FOUR = PairedData(config="tiny", stimuli=("disk", "clover"), poses=45, slides=3, poses_a_slide=4)


def slides_of(settings, stimulus):
    """Slides as the sensor feels them (poses, slides, 2), and the split of each pose."""
    shots = sample_pairs(settings)
    here = (shots.scenes.stimulus == stimulus) & shots.is_slide
    felt = rotate_2d(shots.scenes.move[here], -np.radians(shots.scenes.pose[here, 2]))
    return felt.reshape(settings.poses, settings.slides, 2), shots.split[here][:: settings.slides]


@pytest.mark.parametrize("stimulus", [0, 1])
def test_poses_of_a_group_feel_the_same_slides_and_groups_do_not_cross_splits(stimulus):
    felt, split = slides_of(FOUR, stimulus)
    leader = find_slide_leaders(FOUR, FOUR.stimuli[stimulus])
    np.testing.assert_allclose(felt, felt[leader], atol=1e-12)
    assert np.array_equal(split, split[leader])
    sizes = np.bincount(leader)[np.unique(leader)]
    assert np.count_nonzero(sizes != 4) <= len(SPLITS) and sizes.max() == 4
    own = np.unique(leader)
    assert len(np.unique(felt[own, 0], axis=0)) == len(own)  # and groups differ


def test_a_shared_slide_includes_its_twist():
    settings = dataclasses.replace(FOUR, ranges=dataclasses.replace(FOUR.ranges, twist_deg=5.0))
    shots = sample_pairs(settings)
    twist = shots.scenes.move[(shots.scenes.stimulus == 0) & shots.is_slide, 2].reshape(45, 3)
    leader = find_slide_leaders(settings, "disk")
    np.testing.assert_array_equal(twist, twist[leader])
    assert len(np.unique(twist)) == 3 * len(np.unique(leader))


def test_without_sharing_every_pose_has_the_slides_it_always_had():
    alone = dataclasses.replace(FOUR, poses_a_slide=1)
    assert np.array_equal(find_slide_leaders(alone, "disk"), np.arange(45))
    shots = sample_pairs(alone)
    moves = shots.scenes.move[shots.is_slide]
    # along one axis of the target: not turned
    assert np.mean(np.any(moves == 0, axis=1)) == pytest.approx(2 / 3, abs=0.15)


def test_poses_and_taps_do_not_depend_on_who_shares():
    alone, shared = sample_pairs(dataclasses.replace(FOUR, poses_a_slide=1)), sample_pairs(FOUR)
    np.testing.assert_array_equal(alone.scenes.pose, shared.scenes.pose)
    np.testing.assert_array_equal(alone.split, shared.split)


def test_no_slide_for_less_than_one_pose():
    with pytest.raises(UserError, match="poses_a_slide = 0"):
        sample_pairs(dataclasses.replace(FOUR, poses_a_slide=0))


def rows(dropped=()):
    """The test split's slides, as a reader holds them."""
    shots = sample_pairs(FOUR)
    here = np.flatnonzero(shots.is_slide & (shots.split == SPLITS.index("train")))
    here = np.delete(here, list(dropped))
    fields = (shots.scenes.stimulus, shots.pose_id, shots.instance)
    names = ("stimulus", "pose_id", "slide_id")
    return {name: value[here] for name, value in zip(names, fields, strict=True)}


@pytest.mark.parametrize("dropped", [(), (0, 7, 8, 40)])
def test_partners_are_what_they_are_called(dropped):
    batch = rows(dropped)
    shared = index_shared_slides(batch, FOUR)
    every = np.arange(len(batch["pose_id"]))
    seen = set()
    for seed in range(20):
        other, swapped = shared.sample_partners(every, np.random.default_rng(seed))
        changed = other != every
        for name in ("stimulus", "pose_id"):
            np.testing.assert_array_equal(batch[name][swapped], batch[name])
        assert np.all((batch["slide_id"][swapped] != batch["slide_id"])[changed])
        np.testing.assert_array_equal(
            batch["slide_id"][swapped[changed]], batch["slide_id"][other[changed]]
        )
        assert np.all((batch["pose_id"][other] != batch["pose_id"])[changed])
        leader = np.stack([find_slide_leaders(FOUR, name) for name in FOUR.stimuli])
        np.testing.assert_array_equal(
            *(leader[batch["stimulus"][r], batch["pose_id"][r]] for r in (other, every))
        )
        assert np.array_equal(swapped == every, ~changed)
        assert changed.mean() > 0.8
        seen |= set(zip(every[changed].tolist(), other[changed].tolist(), strict=True))
    assert len(seen) > 4 * len(every)  # of each the up to six others are drawn


@pytest.fixture
def reader(sensor, engine, paired, tmp_path):
    settings = dataclasses.replace(paired, poses=20, taps=1, poses_a_slide=2)
    metadata = make_set(settings, sensor, tmp_path, engine)
    return FactorialReader(settings, configs.get_set_folder(settings, sensor, tmp_path), metadata)


def test_batches_hold_partners_and_go_on_from_any_step(reader):
    fields = (SHEARED_PINS, OTHER_PINS, SWAPPED_PINS, "pose", "pose_id")
    batches = reader.train_batches(8, 3, 0.0, fields)
    first, second = next(batches(0)), next(batches(1))
    full = list(zip(range(2), batches(0), strict=False))
    for name in fields:
        np.testing.assert_array_equal(full[0][1][name], first[name])
        np.testing.assert_array_equal(full[1][1][name], second[name])
    assert set(first) == set(fields) and first[OTHER_PINS].shape == first[SHEARED_PINS].shape
    stored = reader.rows("train")[SHEARED_PINS]
    for name in (OTHER_PINS, SWAPPED_PINS):
        found = [np.flatnonzero((stored == pins).all(axis=(1, 2))) for pins in first[name]]
        assert all(len(each) for each in found)
    assert np.any(first[OTHER_PINS] != first[SHEARED_PINS])
    assert np.any(next(reader.train_batches(8, 4, 0.0, fields)(0))[OTHER_PINS] != first[OTHER_PINS])


@pytest.mark.parametrize("shift", [0.0, 0.1])
def test_images_have_the_partners_of_their_pins_and_shift_with_them(reader, shift):
    fields = (SHEARED_PINS, OTHER_PINS, SWAPPED_PINS, SHEARED_IMAGE, OTHER_IMAGE, SWAPPED_IMAGE)
    batch = next(reader.train_batches(8, 3, shift, fields)(0))
    stored = reader.rows("train")
    size = batch[SHEARED_IMAGE].shape[1]
    moved = set()
    for pins, images in (
        (SHEARED_PINS, SHEARED_IMAGE),
        (OTHER_PINS, OTHER_IMAGE),
        (SWAPPED_PINS, SWAPPED_IMAGE),
    ):
        for place, image, own in zip(batch[pins], batch[images], batch[SHEARED_PINS], strict=True):
            off = place - stored[SHEARED_PINS]
            steps = np.round(off[:, :1])
            # moved by full pixels
            (row,) = np.flatnonzero(np.all(np.abs(off - steps) < 1e-4, axis=(1, 2)))
            offset = steps[row, 0].astype(int)
            plain = reader.take("train", np.array([row]), (SHEARED_IMAGE,))[SHEARED_IMAGE]
            np.testing.assert_array_equal(
                shift_examples({SHEARED_IMAGE: plain}, offset[None])[SHEARED_IMAGE][0], image
            )
            assert np.abs(offset).max() <= round(shift * size)
            moved.add((own.tobytes(), *offset.tolist()))
    assert len(moved) == len({own for own, *_ in moved})  # both partners by as much as the example
    assert (any(offset != [0, 0] for _, *offset in moved)) == (shift > 0)


def test_in_evaluation_partners_stay(reader):
    one, again = (reader.take("test", np.arange(6), (OTHER_PINS, "pose")) for _ in range(2))
    np.testing.assert_array_equal(one[OTHER_PINS], again[OTHER_PINS])
    split = list(reader.split("test", 5, (SHEARED_PINS, SWAPPED_PINS)))
    assert sum(len(batch[SWAPPED_PINS]) for batch in split) == reader.length("test")
    assert set(split[0]) == {SHEARED_PINS, SWAPPED_PINS}
    assert set(next(reader.split("test", 5))) >= {"pose", "sheared", "canonical_pins"}
