"""Frozen splits: the same rows for everybody, or a refusal."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxunshear.config.data import FROZEN_SPLITS, Recorded
from jaxunshear.config.splits import SPLITS
from jaxunshear.config.types import find_problems
from jaxunshear.data import frozen_splits
from jaxunshear.data.frozen_splits import (
    compute_image_checksum,
    compute_label_checksum,
    compute_row_checksum,
    read_frozen_splits,
)
from jaxunshear.data.recorded_contacts import (
    RecordedContacts,
    read_contacts,
    select_labels,
    split_contacts,
)
from jaxunshear.errors import UserError
from jaxunshear.files import format_csv

sys.path.insert(0, str(Path(__file__).parents[1] / "recordings"))
import made

ROOT = Path(__file__).resolve().parents[2]
COUNT = 60


@pytest.fixture
def published(tmp_path, monkeypatch):
    """A set of 60 taps and 60 slides whose frozen split is called edge_2d."""
    folder = tmp_path / "edge"
    for seed, part in enumerate(("tap", "shear")):
        pose, move = made.contacts(COUNT, part == "shear", seed)
        rounded = [each.astype(np.float32).astype(float) for each in (pose, move)]
        made.write(folder / part, *rounded, size=32)
    contacts = read_contacts(Recorded(str(folder), str(folder)))
    lines = ["[edge_2d]"]
    for is_slide in (False, True):
        labels, chosen = select_labels(contacts, is_slide), contacts.is_slide == is_slide
        files = [contacts.files[row] for row in np.flatnonzero(chosen)]
        frozen = {
            "contacts": len(files),
            "labels": compute_label_checksum(labels),
            "images": compute_image_checksum(labels, files),
            "rows": compute_row_checksum(labels, contacts.split[chosen]),
        }
        lines.append(f"[edge_2d.{labels.kind}]")
        lines += [f"{name} = {value!r}" for name, value in frozen.items()]
    (tmp_path / "frozen.toml").write_text("\n".join(lines))
    monkeypatch.setattr(frozen_splits, "FILE", tmp_path / "frozen.toml")
    return folder


def read_split(folder, split="edge_2d"):
    contacts = read_contacts(Recorded(str(folder), str(folder), split=split))
    return dict(zip(contacts.names, contacts.split.tolist(), strict=True))


def change_label(folder, change):
    """Change the first number that varies in the table of the slides."""
    table = folder / "shear" / "targets.csv"
    head, first, *rest = table.read_text().splitlines()
    cells = first.split(",")
    column = head.split(",").index("pose_2")
    cells[column] = repr(change(float(cells[column])))
    table.write_text("\n".join([head, ",".join(cells), *rest]))


def test_the_rows_are_as_in_a_random_split_of_seed_0(published):
    frozen = read_split(published)
    assert frozen == read_split(published, "random")
    assert set(frozen.values()) == {0, 1, 2}


def test_files_may_be_written_in_another_way(published, command):
    before = read_split(published)
    change_label(published, lambda value: value + 1e-9)  # less than a float32 resolves
    assert "1e-09" not in (published / "shear" / "targets.csv").read_text()
    file = published / "tap" / "images" / "image_1.png"
    with Image.open(file) as image:
        image.convert("RGB").save(file, compress_level=0)
    assert read_split(published) == before
    answer = command("split", "edge_2d", "--recordings", published)
    assert answer.code == 0 and answer.out.count("images as in the public set") == 2


def test_a_name_of_a_folder_changes_no_row(published):
    rows = list(read_split(published).values())
    (published / "tap").rename(published / "tap_val")
    assert list(read_split(published).values()) == rows


def test_other_recordings_are_refused(published):
    change_label(published, lambda value: value + 1e-3)
    with pytest.raises(UserError, match="slides with the names, poses and moves"):
        read_split(published)
    (published / "tap" / "images" / "image_1.png").unlink()
    with pytest.raises(UserError, match="must be used on the 60 taps of the public set, not on 59"):
        read_split(published)


def test_another_way_of_drawing_is_noticed(published):
    other = Recorded(str(published), str(published), split="edge_2d", test=0.2)
    with pytest.raises(RuntimeError, match="drawn in another way"):
        read_contacts(other)


def test_the_command_lists_rows_and_notices_another_image(published, command, tmp_path):
    image = published / "shear" / "images" / "image_3.png"
    Image.fromarray(255 - np.asarray(Image.open(image))).save(image)
    rows = tmp_path / "rows.csv"
    answer = command("split", "edge_2d", "--recordings", published, "--out", rows)
    assert answer.code == 1
    assert re.search(r"taps: .* images as in the public set", answer.out)
    assert re.search(r"slides: .* images not as in the public set", answer.out)
    head, *lines = rows.read_text().splitlines()
    assert head == "kind,name,split" and len(lines) == 2 * COUNT
    kinds = {"tap": "tap", "slide": "shear"}
    listed = {}
    for line in lines:
        kind, name, split = line.split(",")
        listed[f"{kinds[kind]}/images/{name}"] = SPLITS.index(split)
    assert listed == read_split(published)


def test_score_takes_test_slides_alone(published, command, tmp_path):
    pose, _ = made.contacts(COUNT, True, 1)
    tested = [
        int(re.findall(r"\d+", name)[-1])
        for name, split in read_split(published).items()
        if name.startswith("shear") and SPLITS[split] == "test"
    ]
    table = []
    for i, y in enumerate(pose[:, 1], 1):  # right for test slides, and wrong for all others
        table.append({"name": f"image_{i}.png", "y_mm": y if i in tested else y + 10})
    (tmp_path / "theirs.csv").write_text(format_csv(table))
    words = ("score", tmp_path / "theirs.csv", "--recordings", published)
    answer = command(*words, "--split", "edge_2d", "--json", tmp_path / "score.json")
    assert answer.code == 0
    assert f"left out {COUNT - len(tested)}: not of a slide that is scored" in answer.out
    assert re.search(rf"pose_mae.submitted.y_mm +mm +{len(tested)} +[\d.]+e-0[6-9]", answer.out)


@pytest.mark.parametrize("field", [{"test": 0.2}, {"validation": 0.2}, {"seed": 1}])
def test_rows_that_are_frozen_are_not_drawn(field):
    settings = Recorded("a", "a", split="edge_2d")
    assert not list(find_problems(settings))
    ((name, remedy),) = find_problems(replace(settings, **field))
    assert name == "split" and "fixed rows" in remedy


def test_each_public_set_is_named_and_cited():
    splits, citations = read_frozen_splits(), (ROOT / "jaxunshear" / "citations.bib").read_text()
    assert tuple(splits) == FROZEN_SPLITS
    for frozen in splits.values():
        assert f"{{{frozen['citation']}," in citations
        for kind in ("tap", "slide"):
            assert sum(frozen[kind][split] for split in SPLITS) == frozen[kind]["contacts"]


@pytest.mark.parametrize("name", FROZEN_SPLITS)
@pytest.mark.parametrize(("kind", "part"), [("tap", "tap"), ("slide", "shear")])
def test_public_recordings_have_their_frozen_rows(real_recordings, name, kind, part):
    packed = np.load(real_recordings / f"{name}_{part}_train.npz")
    count = len(packed["pose"])
    names = tuple(f"image_{i + 1}.png" for i in range(count))
    none, slides = np.zeros(count, int), np.full(count, kind == "slide")
    files = tuple(map(Path, names))
    labels = packed["pose"], packed["move"]
    contacts = RecordedContacts(files, names, *labels, none - 1, slides, none, {}, ())
    split = split_contacts(contacts, Recorded("a", "a", split=name)).split
    counts = dict(zip(SPLITS, np.bincount(split).tolist(), strict=True))
    assert counts == {each: read_frozen_splits()[name][kind][each] for each in SPLITS}
