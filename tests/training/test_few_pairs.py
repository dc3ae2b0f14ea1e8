"""Fewer pairs: which poses keep their taps, and taps of no slide beside the pairs."""

from dataclasses import replace
from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest

from jaxunshear.config.experiment import PIN_TRAINING, Experiment
from jaxunshear.config.fields import override_fields
from jaxunshear.config.network_config import resolve_network
from jaxunshear.config.networks import UnshearNet
from jaxunshear.data.reader import Reader
from jaxunshear.data.sources import Examples, PinLayout, open_source
from jaxunshear.data.stored_sets import SetReader
from jaxunshear.training.examples import (
    add_same_pose_slides,
    add_taps,
    choose_poses,
    select_few_pairs,
)
from jaxunshear.training.losses import ANOTHER, ONE, TAPS

# four slides at each of twenty poses
STIMULUS, POSE = np.repeat([0, 1], 40), np.tile(np.repeat(np.arange(10), 4), 2)
TAP_IDENTITY = ["--train_pins.losses.tap_identity", "0.5"]
OVER_PINS = Experiment(
    name="few",
    claim="none",
    networks=("disentangled",),
    unshear=UnshearNet(input="pins"),
    train_pins=replace(PIN_TRAINING, losses={"supervised": 1.0, "reconstruction": 0.3}),
)


def poses(mask):
    return set(zip(STIMULUS[mask].tolist(), POSE[mask].tolist(), strict=True))


def rows(split="train"):
    number = np.arange(80)
    pins = np.broadcast_to(number[:, None, None], (80, 3, 2)).astype(np.float32)
    named = {"stimulus": STIMULUS, "pose_id": POSE, "row": number}
    return named | {"canonical_pins": pins, "sheared_pins": pins + 0.5}


def list_rows(pins):
    """Return which rows these pins (B, 3, 2) are of."""
    return pins[:, 0, 0].astype(int)


@pytest.mark.parametrize(("share", "count"), [(0.01, 1), (0.1, 2), (0.25, 5), (1.0, 20)])
def test_a_share_is_of_full_poses_and_exact(share, count):
    mask = choose_poses(STIMULUS, POSE, share, 0)
    assert len(poses(mask)) == count and mask.sum() == 4 * count
    assert poses(mask) <= poses(choose_poses(STIMULUS, POSE, 2 * share, 0))
    order = np.random.default_rng(0).permutation(80)
    np.testing.assert_array_equal(choose_poses(STIMULUS[order], POSE[order], share, 0), mask[order])


def test_seeds_draw_other_poses():
    assert len({frozenset(poses(choose_poses(STIMULUS, POSE, 0.1, seed))) for seed in range(8)}) > 4


def examples(load=rows):
    stored = SetReader(SimpleNamespace(preprocess=SimpleNamespace(size=8)), None, {"counts": {}})
    Reader.__init__(stored, load, 8)
    return Examples(stored, (), PinLayout(np.zeros((3, 2), np.float32), 1.0, 8), 80)


def numbered(start=0):
    """Batches that name their step."""
    return ({"step": np.array([step])} for step in range(start, 100))


def test_training_and_validation_have_the_share_and_the_test_has_all():
    few = select_few_pairs(examples(), 0.1, 3)
    chosen = np.flatnonzero(choose_poses(STIMULUS, POSE, 0.1, 3))
    for split in ("train", "validation"):
        assert few.reader.length(split) == 8
        found = few.reader.take(split, np.arange(8), ("row",))["row"]
        np.testing.assert_array_equal(found, chosen)
    assert few.reader.length("test") == 80
    assert few.per_epoch == 80  # as many steps as with all pairs
    batches = few.reader.train_batches(16, 0, 0.0, ("row", "canonical_pins", "sheared_pins"))()
    seen = [next(batches) for _ in range(3)]
    assert {int(row) for batch in seen for row in batch["row"]} == set(chosen.tolist())
    for batch in seen:  # a slide takes any tap of its own pose
        tap, slide = (list_rows(batch[name]) for name in ("canonical_pins", "sheared_pins"))
        np.testing.assert_array_equal(POSE[tap], POSE[slide])
        np.testing.assert_array_equal(STIMULUS[tap], STIMULUS[slide])


def test_taps_beside_pairs_follow_from_seed_and_step_alone():
    stored = {"pins": rows()["canonical_pins"], "stimulus": STIMULUS, "pose_id": np.arange(80)}
    taps = Reader(lambda split: stored, 8)
    batches = add_taps(numbered, taps, 5, 7)
    first = list(islice(batches(), 16))
    assert [int(batch["step"][0]) for batch in first] == list(range(16))
    np.testing.assert_array_equal(next(batches(11))[TAPS], first[11][TAPS])
    drawn = np.concatenate([list_rows(batch[TAPS]) for batch in first]).tolist()
    assert sorted(drawn) == list(range(80)) != drawn  # each once an epoch
    assert np.any(next(add_taps(numbered, taps, 5, 8)())[TAPS] != first[0][TAPS])


def test_slides_that_are_to_be_unsheared_alike_are_two_of_one_pose():
    batches = add_same_pose_slides(numbered, examples(), 30, 7)
    first = list(islice(batches(), 60))
    one, another = (
        np.concatenate([list_rows(batch[name]) for batch in first]) for name in (ONE, ANOTHER)
    )
    assert np.all(one != another)
    np.testing.assert_array_equal(one // 4, another // 4)  # of any pose, paired or not
    assert set(one.tolist()) == set(another.tolist()) == set(range(80))
    np.testing.assert_array_equal(next(batches(11))[ANOTHER], first[11][ANOTHER])


def test_the_only_slide_of_a_pose_is_its_own_other():
    alone = {"stimulus": STIMULUS, "pose_id": np.arange(80), "sheared_pins": rows()["sheared_pins"]}
    batch = next(add_same_pose_slides(numbered, examples(lambda split: alone), 9, 0)())
    np.testing.assert_array_equal(batch[ONE], batch[ANOTHER])


def test_a_network_that_learns_taps_needs_their_set():
    """Their set is made without a PoseNet, too."""
    taught = override_fields(OVER_PINS, TAP_IDENTITY)
    assert set(open_source(OVER_PINS).list_sets()) == {"tactip_paired"}
    assert set(open_source(taught).list_sets()) == {"tactip_paired", "tactip_pose"}


def test_no_posenet_is_another_for_fewer_pairs():
    few = override_fields(OVER_PINS, [*TAP_IDENTITY, "--train_pins.paired_share", "0.1"])
    for network, is_same in (("posenet", True), ("disentangled", False)):
        assert (resolve_network(few, network) == resolve_network(OVER_PINS, network)) == is_same
