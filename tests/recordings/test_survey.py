"""Which contacts are taps, which are slides, and which split each is in."""

import csv

import made
import numpy as np
import pytest

from jaxunshear.config.configs import compute_config_name
from jaxunshear.config.data import Recorded
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.recorded_contacts import compute_digest, parse_folder_digests, read_contacts
from jaxunshear.errors import UserError


def both(folder, **changes):
    return Recorded(tap_folder=str(folder), slide_folder=str(folder), **changes)


def by_name(contacts):
    return dict(zip(contacts.names, contacts.split.tolist(), strict=True))


def test_taps_and_slides_of_one_folder_are_known_by_their_moves(recording):
    contacts = read_contacts(both(recording))
    assert len(contacts.names) == 320 and contacts.is_slide.sum() == 160
    assert ["shear/" in name for name in contacts.names] == contacts.is_slide.tolist()
    shares = np.bincount(contacts.split, minlength=3) / 320
    assert 0.7 < shares[0] < 0.9 and 0.04 < shares[1] < 0.17 and 0.04 < shares[2] < 0.17


def test_a_split_does_not_depend_on_the_order_of_rows(tmp_path):
    pose, move = made.contacts(40, True, 3)
    order = np.random.default_rng(0).permutation(40)
    one, other = (
        made.write(tmp_path / str(i), pose[rows], move[rows])
        for i, rows in enumerate((np.arange(40), order))
    )
    shown = [
        read_contacts(Recorded(slide_folder=str(folder), test=0.2, validation=0.2))
        for folder in (one, other)
    ]
    splits = [
        {tuple(p): s for p, s in zip(c.pose.tolist(), c.split.tolist(), strict=True)} for c in shown
    ]
    assert splits[0] == splits[1]


def test_a_tap_and_the_slides_of_its_pose_share_their_split(tmp_path):
    pose, move = made.contacts(60, True, 3)
    made.write(tmp_path / "tap", pose, 0 * move)
    made.write(tmp_path / "slide", np.repeat(pose, 2, 0), np.concatenate([move, -move]))
    folders = (str(tmp_path / name) for name in ("tap", "slide"))
    contacts = read_contacts(Recorded(*folders, test=0.2, validation=0.2))
    of_pose = {}
    for own, split in zip(contacts.pose.tolist(), contacts.split.tolist(), strict=True):
        of_pose.setdefault(tuple(own), set()).add(split)
    assert len(of_pose) == 60 and all(len(splits) == 1 for splits in of_pose.values())


@pytest.mark.parametrize("seed", [0, 1, 7])
@pytest.mark.parametrize("shares", [(0.1, 0.1), (0.3, 0.2)])
def test_no_pose_is_in_two_splits_and_larger_shares_hold_the_smaller(recording, seed, shares):
    contacts = read_contacts(both(recording, seed=seed, test=shares[0], validation=shares[1]))
    smaller = read_contacts(both(recording, seed=seed, test=0.08, validation=0.1))
    test = SPLITS.index("test")
    assert set(np.flatnonzero(smaller.split == test)) <= set(np.flatnonzero(contacts.split == test))


def test_folders_name_splits(tmp_path):
    splits = {"csv_train": "train", "csv_val": "validation", "csv_test": "test"}
    for i, name in enumerate(splits):
        made.write(tmp_path / "tap" / name, *made.contacts(12, False, i))
    contacts = read_contacts(Recorded(tap_folder=str(tmp_path)))
    for name, split in by_name(contacts).items():
        assert SPLITS[split] == splits[name.split("/")[1]]


def test_what_folders_leave_open_is_drawn_from_the_training_folder(tmp_path):
    for i, name in enumerate(("train", "test")):
        made.write(tmp_path / name, *made.contacts(40, True, i), "newer")
    splits = by_name(read_contacts(Recorded(slide_folder=str(tmp_path), validation=0.2)))
    assert {SPLITS[s] for n, s in splits.items() if n.startswith("test")} == {"test"}
    drawn = {SPLITS[s] for n, s in splits.items() if n.startswith("train")}
    assert drawn == {"train", "validation"}


BEFORE_SPLIT = (  # by a version without `paired.split`: 60 taps, then 60 slides
    "000020200000100100000000000002200001000020010210000200000010"
    "200000000001100001011000001000000000000000002000001020020020"
)


def test_a_random_split_keeps_its_bits_and_its_name(tmp_path):
    made.edge(tmp_path / "edge", 60, 60)
    assert "".join(map(str, read_contacts(both(tmp_path / "edge")).split.tolist())) == BEFORE_SPLIT
    names = {
        split: compute_config_name(Recorded(digest="aa", split=split))
        for split in ("random", "block", "folder")
    }
    assert names["random"] == "recorded-a39cc770" and len(set(names.values())) == 3


@pytest.mark.parametrize("seed", [0, 1])
def test_taps_and_slides_share_one_block_of_poses(recording, seed):
    contacts = read_contacts(both(recording, split="block", seed=seed))
    train, _, test = (np.flatnonzero(contacts.split == index) for index in range(3))
    assert len(set(contacts.is_slide[test])) == 2
    y = contacts.pose[:, 1]
    gap = np.abs(y[test][:, None] - y[train]).min()
    random = read_contacts(both(recording, seed=seed)).split
    neighbours = np.abs(y[random == 2][:, None] - y[random == 0]).min()
    assert gap > 0.15 > 10 * neighbours  # of 6 mm, with 5 % on either side
    assert any(note.startswith("split block: test poses have y from") for note in contacts.notes)


def test_a_block_has_no_contact_without_a_pose(tmp_path):
    pose, move = made.contacts(80, True, 3)
    pose[::8] = np.nan
    folder = made.write(tmp_path / "slides", np.nan_to_num(pose), move)
    text = (folder / "targets.csv").read_text().splitlines()
    text[1::8] = [f"{line.split(',')[0]},1,1{',' * 12}" for line in text[1::8]]
    (folder / "targets.csv").write_text("\n".join(text))
    contacts = read_contacts(Recorded(slide_folder=str(folder), split="block"))
    assert len(contacts.names) == 70 and np.isfinite(contacts.pose).all()
    assert any("10 contacts without a pose are left out" in note for note in contacts.notes)


def test_folders_alone_split_where_they_are_asked_to(tmp_path):
    for i, name in enumerate(("csv_train", "csv_val", "csv_test")):
        made.write(tmp_path / name, *made.contacts(12, False, i))
    named = [
        read_contacts(Recorded(tap_folder=str(tmp_path), split=split)).split.tolist()
        for split in ("folder", "random")
    ]
    assert named[0] == named[1]


@pytest.mark.parametrize(
    ("folders", "split", "complaint"),
    [
        (
            ("csv_train",),
            "folder",
            r"paired\.split folder: no folder of taps has the name of the split 'test'.*random",
        ),
        (("csv_train", "csv_test"), "folder", r"the split 'validation', such as csv_validation"),
        (
            ("csv_train", "csv_val"),
            "block",
            r"paired\.split block: the folder of csv_val/.* is a split by its name.*folder",
        ),
    ],
)
def test_folders_that_do_not_go_with_the_split_are_refused(tmp_path, folders, split, complaint):
    for i, name in enumerate(folders):
        made.write(tmp_path / name, *made.contacts(30, False, i))
    with pytest.raises(UserError, match=complaint):
        read_contacts(Recorded(tap_folder=str(tmp_path), split=split))


def test_named_taps_that_moved_are_left_out_and_said(tmp_path):
    pose, move = made.contacts(40, True, 3)
    move[10:] = 0
    made.write(tmp_path, pose, move)
    contacts = read_contacts(Recorded(tap_folder=str(tmp_path)))
    assert len(contacts.names) == 30
    (note,) = (note for note in contacts.notes if "have a move" in note)
    assert note.startswith(f"10 contacts of {tmp_path}")


def test_labels_that_do_not_part_taps_from_slides_are_refused(tmp_path):
    made.write(tmp_path / "a", *made.contacts(30, True, 3))
    (tmp_path / "a" / "targets.csv").unlink()
    with pytest.raises(UserError, match="no labels that say which contacts are taps"):
        read_contacts(both(tmp_path))


def test_pairs_by_a_table(tmp_path):
    pose, move = made.contacts(40, True, 3)
    made.write(tmp_path / "tap", pose, 0 * move)
    made.write(tmp_path / "slide", pose[::-1], move)
    table = tmp_path / "pairs.csv"
    lines = [(f"image_{i + 1}.png", f"image_{40 - i}.png") for i in range(40)]
    with open(table, "w", newline="") as file:
        csv.writer(file).writerows([("slide", "tap"), *lines])
    folders = (str(tmp_path / "tap"), str(tmp_path / "slide"))
    shares = {"test": 0.2, "validation": 0.2}
    settings = Recorded(*folders, pairs=str(table), pairing="file", **shares)
    contacts = read_contacts(settings)
    taps, slides = (
        contacts.take(np.flatnonzero(contacts.is_slide == slid)) for slid in (False, True)
    )
    of_id = dict(zip(taps.pose_id.tolist(), range(40), strict=True))
    partners = [of_id[own] for own in slides.pose_id.tolist()]
    np.testing.assert_array_equal(taps.pose[partners], slides.pose)
    np.testing.assert_array_equal(taps.split[partners], slides.split)
    with open(table, "a") as file:
        file.write("image_1.png,image_99.png\n")
    with pytest.raises(UserError, match=r"pairs\.csv.*row 42"):
        read_contacts(settings)


def test_the_digest_gives_changed_labels_and_images(tmp_path):
    folder = made.write(tmp_path / "a", *made.contacts(12, False, 0))
    before = compute_digest((str(folder),))
    assert compute_digest((str(folder),)) == before
    table = (folder / "targets.csv").rename(folder / "Targets.CSV")
    assert compute_digest((str(folder),)) == before
    text = table.read_text()
    table.write_text(text.replace("image_1.png,1,0.0", "image_1.png,1,0.5"))
    assert compute_digest((str(folder),)) != before


def test_a_folder_is_known_beside_others(tmp_path):
    taps, slides = (
        str(made.write(tmp_path / name, *made.contacts(6, name == "s", 0))) for name in ("t", "s")
    )
    table = tmp_path / "pairs.csv"
    table.write_text("slide,tap\n")
    found = parse_folder_digests(compute_digest((taps, slides), str(table)))
    assert found == {compute_digest((taps,)), compute_digest((slides,))} and len(found) == 2
