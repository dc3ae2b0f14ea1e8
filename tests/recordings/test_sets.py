"""Recordings on their way to a data set: pins by identity, kill and resume, pairing, labels."""

import dataclasses
import json
import shutil

import made
import numpy as np
import pytest
from PIL import Image

from jaxunshear.config.data import Recorded
from jaxunshear.config.sensor import TACTIP_127, Preprocess
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.pairing import compute_pose_gaps, find_nearest
from jaxunshear.data.recorded_contacts import read_contacts
from jaxunshear.data.recorded_frames import prepare_chunks
from jaxunshear.data.recorded_set import RecordedSet
from jaxunshear.data.sensor_frame import find_sensor_frame, identify_sensor
from jaxunshear.data.stored_sets import make_set, open_set
from jaxunshear.errors import UserError

SEEN = Preprocess(size=made.SIZE)


def settings_of(folder, **changes):
    return Recorded(str(folder), str(folder), digest=folder.name, preprocess=SEEN, **changes)


@pytest.fixture(scope="module")
def stored(recording, tmp_path_factory):
    """The recording as a stored set."""
    data = tmp_path_factory.mktemp("data")
    make_set(settings_of(recording), TACTIP_127, data)
    return data


@pytest.fixture
def opened(recording, stored):
    def opened(seed=0, **changes):
        settings = settings_of(recording, **changes)
        return RecordedSet(settings, open_set(settings, stored, TACTIP_127), seed)

    return opened


def read_all(reader, split, *fields):
    return reader.take(split, np.arange(reader.length(split)), fields)


def test_the_sensor_is_known_by_its_pins(recording, tmp_path):
    assert identify_sensor(read_contacts(settings_of(recording)), SEEN).pins == 127
    pose, move = made.contacts(20, False, 0)
    made.write(tmp_path, pose, move)
    for file in (tmp_path / "images").iterdir():
        noise = np.random.default_rng(0).random((made.SIZE, made.SIZE)) < 0.02
        Image.fromarray(noise.astype(np.uint8) * 255).save(file)
    with pytest.raises(UserError, match="pins are found in an image"):
        identify_sensor(read_contacts(Recorded(tap_folder=str(tmp_path), preprocess=SEEN)), SEEN)


def test_every_pin_is_where_it_was_drawn(recording, opened):
    reader = opened().read_slides()
    rows = read_all(reader, "train", "sheared_pins", "pose", "move", "sure")
    assert rows["sure"].mean() > 0.97
    true = np.stack([made.pins_px(p, m) for p, m in zip(rows["pose"], rows["move"], strict=True)])
    apart = np.linalg.norm(rows["sheared_pins"] - true, axis=-1)[rows["sure"] == 1]
    assert np.nanmedian(apart) < 0.25
    assert np.nanmax(apart) < 0.5 * 6.0  # half a spacing: none has another's name


def test_a_killed_reading_goes_on_to_the_same_bits(recording, tmp_path):
    settings = settings_of(recording)
    contacts = read_contacts(settings)
    frame = find_sensor_frame(contacts, settings, TACTIP_127)
    full = prepare_chunks(contacts, settings, frame, tmp_path / "full")
    assert len(full) == 2
    (tmp_path / "killed").mkdir()
    shutil.copy(full[0], tmp_path / "killed")
    again = prepare_chunks(contacts, settings, frame, tmp_path / "killed")
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in full]


def test_what_lies_in_the_test_split_bends_nothing(recording, tmp_path):
    """Check that crop and rest positions are those of training frames, whatever the test frames."""
    other = tmp_path / "edge"
    shutil.copytree(recording, other)
    settings = settings_of(other)
    contacts = read_contacts(settings)
    for file in contacts.take(np.flatnonzero(contacts.split != SPLITS.index("train"))).files:
        Image.fromarray(np.asarray(Image.open(file))[::-1, ::-1].T.copy()).save(file)
    both = (settings, settings_of(recording))
    frames = [find_sensor_frame(read_contacts(each), each, TACTIP_127) for each in both]
    np.testing.assert_array_equal(frames[0].rest, frames[1].rest)
    assert frames[0].view == frames[1].view


def test_targets_are_those_that_the_training_labels_vary(opened):
    targets = opened().make_targets(())
    assert [target.name for target in targets] == ["y_mm", "z_mm", "Rz_deg"]
    assert [target.is_circular for target in targets] == [False, False, True]
    with pytest.raises(UserError, match="'x_mm' does not vary"):
        opened().make_targets(("x_mm",))


def test_an_unreadable_frame_is_left_out_and_named(tmp_path):
    folder = made.edge(tmp_path / "edge", 40, 40)
    (folder / "tap" / "csv_train" / "images" / "image_7.png").write_bytes(b"no image")
    metadata = make_set(
        settings_of(folder, test=0.2, validation=0.2), TACTIP_127, tmp_path / "data"
    )
    assert metadata["counts"]["dropped"] == 1
    assert "image_7.png" in metadata["counts"]["dropped_frames"][0]


def test_the_nearest_tap_weighs_by_its_gap(opened):
    stored = opened(pairing="nearest")
    reader = stored.read_pairs(stored.make_targets(()))
    rows = read_all(reader, "train", "gap", "weight", "pose")
    assert rows["weight"].mean() == pytest.approx(1, rel=1e-5)
    scaled = np.hypot(rows["gap"][:, 1] / 3, 2 * np.sin(np.radians(rows["gap"][:, 5]) / 2))
    near, far = scaled < np.quantile(scaled, 0.2), scaled > np.quantile(scaled, 0.8)
    assert rows["weight"][near].mean() > 2 * rows["weight"][far].mean()
    assert np.all(rows["gap"][:, [0, 3, 4]] == 0) and 0 < np.median(rows["gap"][:, 5]) < 20


@pytest.mark.parametrize("split", SPLITS)
def test_a_partner_is_a_tap_of_the_own_split_or_of_training(opened, split):
    """Else test taps would have a say in which checkpoint is the best."""
    stored = opened(pairing="nearest")
    reader = stored.read_pairs(stored.make_targets(()))
    partners = reader.take(split, np.arange(reader.length(split)), ("canonical", "pose", "gap"))
    counts = {each: stored.count_contacts("taps", each) for each in SPLITS}
    reader, fields = stored.read_taps(), ("image", "pose")
    taps = {each: reader.take(each, np.arange(counts[each]), fields) for each in SPLITS}
    # no two taps are of one pose
    known = {image.tobytes(): each for each in SPLITS for image in taps[each]["image"]}
    assert len(known) == sum(len(part["image"]) for part in taps.values())
    assert {known[image.tobytes()] for image in partners["canonical"]} == {"train", split}
    # and the nearest of these
    allowed = np.concatenate([taps[each]["pose"] for each in dict.fromkeys(("train", split))])
    targets = stored.make_targets(())
    row, _ = find_nearest(targets, partners["pose"], allowed)
    gaps = compute_pose_gaps(partners["pose"], allowed[row])
    np.testing.assert_allclose(partners["gap"], gaps, atol=1e-4)


def test_rendered_partners_stand_where_the_renderer_says(opened):
    stored = opened()

    def render(poses):
        return np.stack([made.pins_px(pose, np.zeros(6)) for pose in poses])

    reader = stored.read_pairs(stored.make_targets(()), render)
    rows = read_all(reader, "test", "canonical", "canonical_pins", "pose", "gap", "weight")
    np.testing.assert_allclose(rows["canonical_pins"], render(rows["pose"]), rtol=1e-6)
    assert np.all(rows["gap"] == 0) and np.all(rows["weight"] == 1)
    assert 0.05 < (rows["canonical"] > 0).mean() < 0.4


def test_pairs_of_one_pose_by_its_number(tmp_path):
    pose, move = made.contacts(50, True, 3)
    made.write(tmp_path / "edge" / "tap", pose, 0 * move)
    order = np.random.default_rng(0).permutation(50)
    twice = np.concatenate([order, order])
    made.write(
        tmp_path / "edge" / "slide", pose[twice], np.concatenate([move, -move]), pose_id=twice + 1
    )
    settings = dataclasses.replace(
        settings_of(tmp_path / "edge"), pairing="pose_id", test=0.2, validation=0.2
    )
    make_set(settings, TACTIP_127, tmp_path / "data")
    stored = RecordedSet(settings, open_set(settings, tmp_path / "data", TACTIP_127))
    reader = stored.read_pairs(stored.make_targets(()))
    rows = read_all(reader, "train", "canonical_pins", "pose", "gap", "pose_id")
    assert rows["gap"].max() < 1e-3
    true = np.stack([made.pins_px(p, np.zeros(6)) for p in rows["pose"]])
    assert np.nanmedian(np.linalg.norm(rows["canonical_pins"] - true, axis=-1)) < 0.25
    assert len(np.unique(rows["pose_id"])) == len(rows["pose_id"]) / 2


def test_poses_without_taps_of_their_number_are_refused(opened):
    stored = opened(pairing="pose_id")
    with pytest.raises(UserError, match="record taps and slides of the same poses"):
        stored.read_pairs(stored.make_targets(())).length("train")


@pytest.mark.parametrize("seed", [0, 5])
def test_fewer_labels_are_drawn_at_random_and_nested(opened, seed):
    drawn = []
    for share in (0.05, 0.3, 1.0):
        reader = opened(seed=seed, labelled=share).read_slides()
        rows = reader.take("train", np.arange(reader.length("train")), ("number",))
        drawn.append(set(rows["number"].tolist()))
        assert reader.length("test") == opened().read_slides().length("test")
    assert drawn[0] < drawn[1] < drawn[2]
    assert abs(len(drawn[1]) / len(drawn[2]) - 0.3) < 0.12
    poses = opened().stored.rows("train")
    angle = {n: p[5] for n, p in zip(poses["number"].tolist(), poses["pose"].tolist(), strict=True)}
    # rows are sorted by angle: not the first ones
    assert np.ptp([angle[n] for n in drawn[1]]) > 250


def test_taps_join_the_training_slides_alone_as_slides_of_length_zero(opened):
    fields = ("number", "sheared_pins", "pose", "move")
    plain, joined = opened().read_slides(), opened(direct_taps="recorded").read_slides()
    taps = opened().read_taps()
    for split in ("validation", "test"):
        assert joined.length(split) == plain.length(split)
    count, more = plain.length("train"), taps.length("train")
    rows = joined.take("train", np.arange(joined.length("train")), fields)
    assert len(rows["number"]) == count + more
    assert len(np.unique(rows["number"])) == count + more and np.all(rows["move"][count:] == 0)
    own = taps.take("train", np.arange(more), ("number", "pins", "pose"))
    for name, other in (("number", "number"), ("sheared_pins", "pins"), ("pose", "pose")):
        np.testing.assert_array_equal(rows[name][count:], own[other])
    assert joined.take("train", np.array([count]), ("sheared",))["sheared"].ndim == 4


def test_slides_without_a_label_get_the_pose_that_is_read(opened):
    stored = opened(labelled=0.3, pairing="nearest")
    asked = []

    def read(images, pins):
        asked.append((images.shape, pins.shape))
        return np.full((len(pins), 6), 2.5, np.float32)

    few = stored.read_slides()
    all_slides = stored.read_pairs(stored.make_targets(()), estimate=read)
    fields = ("pose", "number")
    rows = all_slides.take("train", np.arange(all_slides.length("train")), fields)
    known = few.take("train", np.arange(few.length("train")), fields)
    unread = ~np.isin(rows["number"], known["number"])
    assert len(rows["number"]) == stored.count_contacts("slides", "train")
    assert asked == [((unread.sum(), made.SIZE, made.SIZE), (unread.sum(), 127, 2))]
    assert np.all(rows["pose"][unread] == 2.5)
    order = np.argsort(rows["number"][~unread]), np.argsort(known["number"])
    np.testing.assert_array_equal(rows["pose"][~unread][order[0]], known["pose"][order[1]])
    assert all_slides.length("validation") == few.length("validation")
    assert all_slides.length("test") == opened().read_slides().length("test")


def test_metadata_hold_what_a_reader_must_know(recording, stored):
    (folder,) = (stored / "tactip_recorded").glob("recorded-*/1.0.0")
    metadata = json.loads((folder / "metadata.json").read_text())
    counts = metadata["counts"]
    assert counts["contacts"] == 320 and sum(counts["written"].values()) == 320
    for split in SPLITS:
        assert counts["taps"][split] + counts["slides"][split] == counts["written"][split]
    assert len(metadata["frame"]["place_px"]) == 127
    np.testing.assert_allclose(metadata["frame"]["place_px"], made.rest_px(), atol=2.5)
