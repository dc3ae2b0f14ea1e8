import dataclasses
import itertools
import json
import re
import shutil

import numpy as np
import pytest

from jaxunshear.config.configs import get_set_folder
from jaxunshear.config.splits import SPLITS
from jaxunshear.data import stored_sets
from jaxunshear.data.reader import Reader, group_by_pose, shift_examples
from jaxunshear.data.sampling import sample_contacts
from jaxunshear.data.stored_sets import make_set, open_set
from jaxunshear.errors import UserError


@pytest.fixture
def made(paired, sensor, engine, tmp_path):
    make_set(paired, sensor, tmp_path, engine)
    return open_set(paired, tmp_path, sensor)


def take(batches, count):
    return list(itertools.islice(batches, count))


def image_of(engine, settings, row):
    return engine.render(settings, None, np.zeros((1, 1, 3)), [row], None)[0][0]


def find_rows(shots, batch, place):
    """Return the contacts that an example is made of: its slide, and its tap."""
    here = shots.scenes.stimulus == batch["stimulus"][place]
    here &= shots.pose_id == batch["pose_id"][place]
    slides = here & shots.is_slide & (shots.instance == batch["slide_id"][place])
    taps = here & ~shots.is_slide & (shots.instance == batch["tap_id"][place])
    return int(np.flatnonzero(slides)[0]), int(np.flatnonzero(taps)[0])


def test_a_split_comes_once_with_the_contacts_that_were_made(made, paired, engine):
    shots, scenes = sample_contacts(paired), sample_contacts(paired).scenes
    seen = set()
    for split in SPLITS:
        batches = list(made.split(split, 8))
        assert [len(batch["pose"]) for batch in batches[:-1]] == [8] * (len(batches) - 1)
        assert sum(len(batch["pose"]) for batch in batches) == made.length(split)
        for batch in batches:
            assert batch["sheared"].shape[1:] == batch["canonical"].shape[1:] == (32, 32, 1)
            assert batch["sheared"].dtype == np.uint8
            assert batch["sheared_pins"].shape[1:] == (19, 2)
            for name in ("pose", "edge", "move", "friction", "canonical_pins"):
                assert batch[name].dtype == np.float32
            np.testing.assert_array_equal(batch["tap_id"], batch["slide_id"] % paired.taps)
            for place in range(len(batch["pose"])):
                slide, tap = find_rows(shots, batch, place)
                for name, row in (("sheared", slide), ("canonical", tap)):
                    image = image_of(engine, paired, row)
                    np.testing.assert_array_equal(batch[name][place, :, :, 0], image)
                for name, made_as in (
                    ("edge", shots.edge[slide]),
                    ("pose", scenes.pose[slide]),
                    ("move", scenes.move[slide]),
                    ("tap_depth_mm", scenes.pose[tap, 3]),
                ):
                    np.testing.assert_allclose(batch[name][place], made_as, rtol=1e-6)
                assert shots.split[slide] == SPLITS.index(split)
                seen.add(slide)
    assert len(seen) == shots.is_slide.sum()


def test_batches_depend_on_seed_and_step_alone(made):
    steps = made.train_batches(batch=5, seed=3, shift=0.1)
    full, later = take(steps(0), 20), take(steps(13), 7)
    for before, after in zip(full[13:], later, strict=True):
        assert all(np.array_equal(before[name], after[name]) for name in before)
    other = next(made.train_batches(batch=5, seed=4, shift=0.1)(0))
    assert not np.array_equal(full[0]["pose"], other["pose"])


def test_an_epoch_has_every_slide_once_and_each_is_shuffled_anew(made):
    slides = []
    for batch in take(made.train_batches(6, 0, 0.0)(0), 12):
        keys = np.stack([batch[name] for name in ("stimulus", "pose_id", "slide_id")], axis=1)
        slides += map(tuple, keys.tolist())
    first, second = slides[:36], slides[36:]
    assert len(set(first)) == len(first) == made.length("train") == 36
    assert set(first) == set(second)
    assert first != second
    assert first != sorted(first)


def test_a_slide_meets_every_tap_of_its_pose_and_no_other(made, paired, engine):
    shots, met = sample_contacts(paired), {}
    for batch in take(made.train_batches(12, 0, 0.0)(0), 90):
        for place in range(12):
            slide, tap = find_rows(shots, batch, place)
            met.setdefault(slide, set()).add(int(batch["tap_id"][place]))
            np.testing.assert_array_equal(
                batch["canonical"][place, :, :, 0], image_of(engine, paired, tap)
            )
    assert all(taps == {0, 1} for taps in met.values())


def test_shifts_are_the_same_for_both_images_and_their_pins(made, paired, engine):
    shots, offsets = sample_contacts(paired), set()
    for batch in take(made.train_batches(12, 0, 0.1)(0), 10):
        for place in range(12):
            row, tap = find_rows(shots, batch, place)
            still = shots.scenes.pose[row, :2] + 16
            # as the stand-in places them
            offset = batch["sheared_pins"][place, 0] - still - 1e-3 * row
            np.testing.assert_allclose(
                batch["canonical_pins"][place, 0] - still - 1e-3 * tap, offset, atol=1e-4
            )
            columns, rows = np.rint(offset).astype(int)
            offsets.add((columns, rows))
            for name, number in (("sheared", row), ("canonical", tap)):
                expected = np.zeros((32, 32), np.uint8)
                full = np.pad(image_of(engine, paired, number), 8)
                expected[:] = full[8 - rows : 40 - rows, 8 - columns : 40 - columns]
                np.testing.assert_array_equal(batch[name][place, :, :, 0], expected)
    assert {abs(part) for offset in offsets for part in offset} == {0, 1, 2, 3}
    assert len(offsets) > 30


def test_a_shift_to_the_right_and_down_moves_a_pin_to_higher_columns_and_rows():
    images = np.zeros((2, 8, 8, 1), np.uint8)
    images[:, 2, 3] = 255
    pins = np.full((2, 1, 2), (3.0, 2.0), np.float32)
    moved = shift_examples(
        {"image": images, "pins": pins, "pose": np.array([7, 8])}, np.array([[2, 1], [0, -2]])
    )
    assert np.argwhere(moved["image"][..., 0]).tolist() == [[0, 3, 5], [1, 0, 3]]
    assert moved["pins"].tolist() == [[[5, 3]], [[3, 0]]]
    assert moved["pose"].tolist() == [7, 8]


def test_only_the_named_fields_are_read(made):
    fields = ("sheared", "pose")
    assert set(next(made.train_batches(4, 0, 0.0, fields)(0))) == set(fields)
    assert set(next(made.split("test", 4, fields=("edge",)))) == {"edge"}


def test_the_pose_set(pose, sensor, engine, tmp_path):
    make_set(pose, sensor, tmp_path, engine)
    reader = open_set(pose, tmp_path, sensor)
    batch = next(reader.train_batches(batch=4, seed=0, shift=0.02)(0))
    assert batch["image"].shape == (4, 32, 32, 1)
    assert batch["pose"].shape == (4, 4)
    assert batch["edge"].shape == (4, 2)
    assert reader.length("train") == 12


def test_reading_keeps_up_with_training(made):
    """After the first batch nothing is read or decoded: a step takes rows that are in memory."""
    steps = made.train_batches(16, 0, 0.015)(0)
    next(steps)
    shutil.rmtree(made.folder)
    assert len(take(steps, 20)) == 20


@pytest.mark.parametrize("damage", ["truncated", "changed", "missing", "empty"])
def test_a_damaged_shard_is_named_with_the_remedy(damage, made):
    (shard,) = made.folder.glob("*-train.array_record*")
    data = shard.read_bytes()
    if damage == "missing":
        shard.unlink()
    else:
        middle = len(data) // 2
        flipped = data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]
        shard.write_bytes({"truncated": data[:middle], "changed": flipped, "empty": b""}[damage])
    with pytest.raises(
        UserError, match=rf"{re.escape(shard.name)} is .*delete .*`jaxunshear data`"
    ):
        made.train_batches(4, 0, 0.0)
    # the others still read
    assert made.length("test") == sum(len(batch["pose"]) for batch in made.split("test", 4))


@pytest.mark.parametrize(
    "name", ["metadata.json", "shards.json", "features.json", "dataset_info.json"]
)
@pytest.mark.parametrize("text", ['{"set": ', "[]", None])
def test_broken_json_is_reported_with_the_remedy(name, text, made, paired, sensor, tmp_path):
    (made.folder / name).write_text(text) if text else (made.folder / name).unlink()
    with pytest.raises(UserError, match=r"is damaged .*: delete .*`jaxunshear data` again"):
        next(open_set(paired, tmp_path, sensor).split("test", 4))


def test_a_digit_of_the_metadata_that_changed_is_reported(made, paired, sensor, tmp_path):
    file = made.folder / "metadata.json"
    held = json.loads(file.read_text())
    held["counts"]["dropped"] = held["counts"].get("dropped", 0) + 1
    file.write_text(json.dumps(held))
    with pytest.raises(
        UserError, match=r"is damaged \(metadata\.json\): delete .*`jaxunshear data` again"
    ):
        open_set(paired, tmp_path, sensor)


def test_a_missing_set_and_a_missing_split_are_reported(made, paired, sensor, tmp_path):
    other = dataclasses.replace(paired, seed=7)
    with pytest.raises(UserError, match=r"no data set in .*jaxunshear data"):
        open_set(other, tmp_path, sensor)
    with pytest.raises(UserError, match="split 'all' is unknown"):
        made.length("all")
    assert get_set_folder(paired, sensor, tmp_path) == made.folder


def test_nobody_is_reported_to_delete_a_set_that_the_machine_could_not_read(made, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(stored_sets, "_read_rows", refuse)
    with pytest.raises(UserError, match=r"cannot read .*Permission denied") as refusal:
        next(made.split("test", 4))
    assert "again" not in str(refusal.value)


def test_where_nothing_is_drawn_every_epoch_has_every_row_once():
    rows = {"sheared_pins": np.arange(23.0), "pose": -np.arange(23.0)}
    rows |= {"stimulus": np.zeros(23), "pose_id": np.arange(23)}
    batches = Reader(lambda split: rows, 16).train_batches(5, 3, 0.0, ("sheared_pins", "pose"))
    seen = take(batches(0), 23)
    assert all(np.array_equal(batch["sheared_pins"], -batch["pose"]) for batch in seen)
    order = np.concatenate([batch["sheared_pins"] for batch in seen]).reshape(5, 23)
    assert all(np.array_equal(np.sort(epoch), np.arange(23)) for epoch in order)
    assert len({tuple(epoch) for epoch in order}) == 5
    np.testing.assert_array_equal(next(batches(7))["pose"], seen[7]["pose"])
    other = next(Reader(lambda split: rows, 16).train_batches(5, 4, 0.0, ("pose",))(0))
    assert not np.array_equal(other["pose"], seen[0]["pose"])


STIMULUS = np.array([0, 1, 0, 0, 1, 0, 0])
POSE = np.array([5, 5, 2, 5, 5, 5, 9])
ALIKE = [{0, 3, 5}, {1, 4}, {2}, {0, 3, 5}, {1, 4}, {0, 3, 5}, {6}]


def met(draw, times=60):
    generator, rows = np.random.default_rng(0), np.arange(7)
    drawn = np.stack([draw(rows, generator) for _ in range(times)], axis=1)
    return [set(row) for row in drawn.tolist()]


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
