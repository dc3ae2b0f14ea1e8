"""Tables of labels, of pairs and of points, as laboratories and spreadsheets write them."""

import re
import unicodedata
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from jaxunshear.config.data import Recorded
from jaxunshear.config.network_config import resolve_trained_networks
from jaxunshear.config.outlines import read_outline
from jaxunshear.config.rules import validate
from jaxunshear.config.sensor import Preprocess
from jaxunshear.config.targets import list_label_fields, locate_targets, read_true_values
from jaxunshear.data.recorded_contacts import read_test_contacts
from jaxunshear.data.recorded_set import RecordedSet
from jaxunshear.data.recordings import read_recordings
from jaxunshear.errors import UserError
from jaxunshear.fit import BASE_EXPERIMENT, set_recordings
from tests.inputs.cases import Case, list_cases, run_each

OLDER = [f"{kind}_{i}" for kind in ("pose", "move") for i in range(1, 7)]
NEWER = [
    f"{kind}_{axis}" for kind in ("pose", "shear") for axis in ["x", "y", "z", "Rx", "Ry", "Rz"]
]
READ, TABLE = "read_recordings", "targets.csv"


def write_images(folder, names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.fromarray(np.eye(8, dtype=np.uint8) * 255).save(folder / name)


def write(
    root,
    columns=OLDER,
    image_column="sensor_image",
    cell="image_{}.png",
    images="images",
    scale=1.0,
):
    """A recording of 12 contacts, whose labels vary as those of an edge do. Returns its lines."""
    write_images(root / images, [f"image_{i}.png" for i in range(1, 13)])
    lines = [",".join([image_column, *columns])]
    for i in range(1, 13):
        values = [scale * value for value in (0, i - 6, 3 + i / 6, 0, 0, 10 * i) * 2]
        cells = [f"{value:.9g}" for value in values[: len(columns)]]
        lines.append(",".join([cell.format(i), *cells, *["1"] * (len(columns) - len(cells))]))
    (root / TABLE).write_text("\n".join(lines) + "\n")
    return lines


def read(root):
    return read_recordings(root, Preprocess(size=32))


def change(root, function):
    text = function((root / TABLE).read_text())
    (root / TABLE).write_bytes(text if isinstance(text, bytes) else text.encode())


def expect_labels(root, notes=()):
    """All poses are known, and what is noted is said by these words, in their order."""
    found = read(root)
    assert found.poses is not None and np.isfinite(found.poses).all()
    np.testing.assert_allclose(found.poses[:, 1], np.arange(1, 13) - 6)
    np.testing.assert_allclose(found.poses[:, 5], 10 * np.arange(1, 13))
    assert len(found.notes) == len(notes)
    for note, words in zip(found.notes, notes, strict=True):
        assert words in note
    return found


def dialect(function, notes=()):
    def check(root):
        write(root)
        change(root, function)
        expect_labels(root, notes)

    return check


def unknown(function, words, first=0):
    """The labels of one contact are unknown; a note says why."""

    def check(root):
        write(root)
        change(root, function)
        found = read(root)
        assert np.flatnonzero(np.isnan(found.poses).any(axis=1)).tolist() == [first]
        assert any(words in note and "targets.csv, row" in note for note in found.notes)

    return check


def first_cell(cell, words):
    return unknown(lambda text: text.replace("1.png,0,-5", f"1.png,0,{cell}", 1), words)


def refused(function, words):
    """No label is used; a note names the table."""

    def check(root):
        write(root)
        change(root, function)
        found = read(root)
        assert found.poses is None and len(found) == 12
        assert any(words in note and "targets.csv" in note for note in found.notes)

    return check


def check_newer_layout(root):
    lines = write(root, NEWER, "tactile_images", "tactile_images/{}.png", "tactile_images")
    for i in range(1, 13):
        (root / f"tactile_images/image_{i}.png").rename(root / f"tactile_images/{i}.png")
    write_images(root / "tactile_images", ["reference.png"])
    reference = ",".join(["tactile_images/reference.png", *["0"] * 12])
    (root / TABLE).write_text("\n".join([lines[0], reference, *lines[1:]]))
    found = read(root)
    labelled = np.isfinite(found.poses).all(axis=1)
    assert [name for name, known in zip(found.names, labelled, strict=True) if not known] == [
        "tactile_images/reference.png"
    ]
    np.testing.assert_allclose(found.poses[:12, 1], np.arange(1, 13) - 6)
    np.testing.assert_allclose(found.moves[:12, 5], 10 * np.arange(1, 13))
    assert found.notes == []


def check_other_name_of_table(root):
    write(root)
    (root / TABLE).rename(root / "image_list.csv")
    expect_labels(root)


def check_other_name_not_understood(root):
    write_images(root / "images", ["image_1.png"])
    (root / "image_list.csv").write_text("id,when\n1,monday\n")
    (note,) = read(root).notes
    assert "image_list.csv, row 1: has no column sensor_image or image_name" in note


def check_spreadsheet(root):
    write_images(root / "images", ["image_1.png"])
    (root / "targets.xlsx").write_bytes(b"PK\3\4\xff\xfe")
    (note,) = read(root).notes
    assert "targets.xlsx" in note and "save the table as CSV" in note


def check_table_above(root):
    write(root / "a")
    (root / "all.csv").write_text("image,pose_1\na/images/image_1.png,1\n")
    (root / "pairs.csv").write_text("slide,tap\nb.png,a.png\n")
    expect_labels(root, ["all.csv: is not read: a table lies beside its images"])


def check_table_among_images(root):
    write(root)
    (root / TABLE).rename(root / "images/targets.csv")
    expect_labels(root)


def check_units(scale, count):
    def check(root):
        write(root, scale=scale)
        notes = [note for note in read(root).notes if "are to be in mm" in note]
        assert len(notes) == count  # of poses and of slides

    return check


def check_radians(root):
    write(root, OLDER[:6])
    text = (root / TABLE).read_text().splitlines()
    rows = [line.rsplit(",", 1) for line in text[1:]]
    rows = [f"{start},{np.radians(float(last)):.6f}" for start, last in rows]
    (root / TABLE).write_text("\n".join([text[0], *rows]))
    notes = read(root).notes
    assert sum("are to be in degrees" in note for note in notes) == 1
    assert not any("are to be in mm" in note for note in notes)


def check_units_of_taps_and_slides(root):
    write(root / "tap", OLDER[:6])
    write(root / "slide", scale=0.001)
    folders = str(root / "tap"), str(root / "slide")
    notes = read_test_contacts(Recorded(*folders)).notes
    assert any(
        "positions of taps vary by 11 and positions of slides by 0.011" in note for note in notes
    )
    write(root / "slide")
    assert not any("units" in note for note in read_test_contacts(Recorded(*folders)).notes)


def check_four_axes(root):
    write(root, ["pose_x", "pose_y", "pose_z", "pose_Rz"])
    found = read(root)
    np.testing.assert_allclose(found.poses[:, 1], np.arange(1, 13) - 6)
    np.testing.assert_array_equal(found.poses[:, 3:], 0)
    assert any(
        "no column pose_Rx, pose_Ry: Rx, Ry of each pose is taken as 0" in note
        for note in found.notes
    )


def check_empty_columns(root):
    lines = write(root)
    rows = [line.split(",") for line in lines[1:]]
    rows = [",".join([*cells[:4], "", "NaN", *cells[6:]]) for cells in rows]
    (root / TABLE).write_text("\n".join([lines[0], *rows]))
    expect_labels(root, ["no column pose_4, pose_5: Rx, Ry of each pose is taken as 0"])


def check_other_columns(root):
    write(root, [*OLDER, "Fx", "note"])
    rows = (root / TABLE).read_text().splitlines()
    rows = [rows[0], *(f"{row[:-4]},{i}.5,{'a' * i}" for i, row in enumerate(rows[1:]))]
    (root / TABLE).write_text("\n".join(rows))
    found = expect_labels(root)
    assert list(found.others) == ["Fx"]
    np.testing.assert_array_equal(found.others["Fx"], np.arange(12) + 0.5)


def check_column_targets(root):
    """A force is learnt from slides that have one, with a pose or without."""
    count = 12
    rows = {name: np.zeros(count, np.int32) for name in ("sure", "pose_id")}
    rows |= {"slid": np.ones(count, np.int32), "number": np.arange(count, dtype=np.int32)}
    rows |= {name: np.full((count, 6), np.nan, np.float32) for name in ("pose", "move")}
    rows |= {"image": np.zeros((count, 128), np.uint8), "pins": np.zeros((count, 7, 2))}
    rows["others"] = np.stack([np.zeros(count), np.arange(count)], axis=1).astype(np.float32)
    rows["others"][3, 1] = np.nan
    stored = SimpleNamespace(metadata={"others": ["time", "Fx"]}, rows=lambda split: rows)
    learnt = RecordedSet(Recorded("a", "a"), stored, targets=("Fx",))
    targets, slides = learnt.make_targets(("Fx",)), learnt.read_slides()
    batch = slides.take("train", np.arange(slides.length("train")), list_label_fields(targets))
    assert read_true_values(targets, batch)["Fx"].tolist() == [0, 1, 2, *range(4, count)]
    (moved,) = locate_targets(targets, ["Fx"])
    assert moved.column == 0
    with pytest.raises(UserError, match="'Fx': these recordings have no such column"):
        locate_targets(targets, ["Fy"])


def check_unknown_column(root):
    write(root, [*OLDER, "Fx"])
    lines = (root / TABLE).read_text().splitlines()
    rows = [f"{line[:-2]},{i}" for i, line in enumerate(lines[1:])]
    (root / TABLE).write_text("\n".join([lines[0], *rows]))
    experiment = replace(BASE_EXPERIMENT, targets=("Fy",))
    with pytest.raises(UserError, match=r"target 'Fy' is unknown: use x_mm, .*, Fx$"):
        set_recordings(experiment, str(root), str(root))


def check_networks_of_columns(root):
    """Other columns are targets of every PoseNet; a renderer knows poses alone."""
    asked = replace(BASE_EXPERIMENT, targets=("Fx", "y_mm"), paired=Recorded("a", "a"))
    validate(asked)
    over_pins = replace(asked, unshear=replace(asked.unshear, input="pins"))
    configs = {config.name: config for config in resolve_trained_networks(over_pins)}
    assert configs["renderer"].targets == ("y_mm",)
    for name in ("posenet", "posenet_sheared"):
        assert configs[name].targets == ("Fx", "y_mm") and not configs[name].needs
    pseudo = replace(asked.paired, unlabelled="pseudo_label", labelled=0.5)
    with pytest.raises(UserError, match="pseudo_label estimates no Fx"):
        validate(replace(asked, paired=pseudo))


def check_unicode(form):
    def check(root):
        name = "taps\u00e9_1.png"
        write_images(root / "images", [unicodedata.normalize(form, name)])
        other = unicodedata.normalize({"NFC": "NFD", "NFD": "NFC"}[form], name)
        row = ",".join([other, *map(str, range(12))])
        (root / TABLE).write_text(",".join(["sensor_image", *OLDER]) + f"\n{row}\n")
        np.testing.assert_array_equal(read(root).poses, [np.arange(6)])

    return check


def check_pairs(root):
    """Pairs in another form of Unicode, and a name that two folders have."""
    write(root / "tap", OLDER[:6])
    write(root / "slide")
    (root / "slide/images/image_1.png").rename(root / "slide/images/caf\u00e9.png")
    (root / "pairs.csv").write_text("slide;tap\ncafe\u0301.png;image_2.png\n")
    settings = Recorded(str(root / "tap"), str(root / "slide"), pairs=str(root / "pairs.csv"))
    contacts = read_test_contacts(settings)
    assert sorted(contacts.names[row] for row in np.flatnonzero(contacts.pose_id >= 0)) == [
        "images/caf\u00e9.png",
        "images/image_2.png",
    ]
    write(root / "tap/more", OLDER[:6])
    (root / "tap/images").rename(root / "tap/first")
    (root / "pairs.csv").write_text("sep=;\n\nslide;tap\ncafe\u0301.png;image_2.png\n")
    with pytest.raises(UserError, match=r"row 4: there are 2 taps image_2.png: name their folders"):
        read_test_contacts(settings)


def outline(text, encoding="utf-8"):
    def check(root):
        (root / "mine.csv").write_text(text, encoding=encoding)
        assert read_outline(root / "mine.csv").points == ((0, 0), (20, 0), (20, 10), (0, 10))

    return check


def no_outline(text, words, name="mine.csv"):
    def check(root):
        (root / name).write_text(text)
        with pytest.raises(UserError, match=words):
            read_outline(root / name)

    return check


def check_missing_row(root):
    write(root)
    change(root, lambda text: text.rpartition("image_12")[0])
    found = read(root)
    assert np.isnan(found.poses).any(axis=1).tolist() == [False] * 11 + [True]
    assert "has no row for 1 of 12 images, the first image_12.png" in found.notes[0]


def check_doctor(root, command):
    write(root)
    for file in (root / "images").iterdir():
        dots = np.kron(np.arange(64) // 4 % 2, np.arange(64)[:, None] // 4 % 2)
        Image.fromarray(dots.astype(np.uint8) * 255).save(file)
    change(root, lambda text: text.replace("image_3.png,0,-3", "image_3.png,0,1_5"))
    answer = command("doctor", root)
    assert answer.code == 0, answer.err
    assert "targets.csv, row 4: pose_2 is '1_5', no usable number" in answer.out


def mix_commas(text):
    return semicolons(text).replace("1.png;0;-5", "1.png;0;-5,5", 1)


def name_windows_folders(text):
    return text.replace("image_1", r"C:\data\image_1")


def capitalise(text):
    return text.replace("pose_", "Pose_").replace("move_", "MOVE_")


def semicolons(text):
    return text.replace(",", ";")


def decimal_commas(text):
    return re.sub(r"(\d)\.(\d)", r"\1,\2", semicolons(text))


POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"
SQUARE = "0,0\n20,0\n20,10\n0,10\n"
SWAPPED = "0,0\n0,20\n10,20\n10,0\n"
CASES = [
    Case("newer layout, tactile_images and a reference", READ, "labels", check_newer_layout),
    Case("image_list.csv with labels", READ, "labels", check_other_name_of_table),
    Case("image_list.csv of other things", READ, "a note", check_other_name_not_understood),
    Case("targets.xlsx", READ, "a note", check_spreadsheet),
    Case("a table above the folders", READ, "a note", check_table_above),
    Case("the table lies among the images", READ, "labels", check_table_among_images),
    Case("metres", READ, "a note", check_units(0.001, 2)),
    Case("millimetres", READ, "labels", check_units(1, 0)),
    Case("radians", READ, "a note", check_radians),
    Case("taps in mm, slides in m", "fit", "a note", check_units_of_taps_and_slides),
    Case("four axes", READ, "labels", check_four_axes),
    Case("columns without a number", READ, "labels", check_empty_columns),
    Case("forces and words beside poses", READ, "forces kept", check_other_columns),
    Case("a force for some contacts", "RecordedSet", "learnt from these", check_column_targets),
    Case("--targets Fy without such a column", "fit", "exit 2", check_unknown_column),
    Case("--targets Fx, networks that unshear", "fit", "exit 2", check_networks_of_columns),
    Case("names in NFC, table in NFD", READ, "labels", check_unicode("NFC")),
    Case("names in NFD, table in NFC", READ, "labels", check_unicode("NFD")),
    Case("pairs in NFD, a name in two folders", "fit --pairs", "pairs, exit 2", check_pairs),
    *list_cases(
        *(READ, "labels", dialect),
        [
            ("semicolons", semicolons),
            ("tabs", lambda text: text.replace(",", "\t")),
            ("sep=;", lambda text: "sep=;\n" + semicolons(text)),
            ("sep=,", lambda text: "sep=,\r\n" + text),
            ("a comment first", lambda text: "# monday\n\n" + text),
            ("decimal commas", decimal_commas),
            ("Windows line ends and a BOM", lambda text: ("\ufeff" + text).replace("\n", "\r\n")),
            ("capitals in the heading", capitalise),
            ("folders of Windows in names", name_windows_folders),
        ],
    ),
    Case("fewer rows than images", READ, "unknown, a note", check_missing_row),
    *list_cases(
        *(READ, "unknown, a note", first_cell),
        [
            ("underscore in a number", "1_5", "is '1_5'"),
            ("Arabic digits", "\u0661", "pose_2 is"),
            ("thousands separator", '"1,234"', "'1,234'"),
        ],
    ),
    Case("points and commas in numbers", READ, "unknown, a note", unknown(mix_commas, "'-5,5'")),
    *list_cases(
        *(READ, "refused, a note", refused),
        [
            ("a pointer of Git LFS", lambda text: POINTER, "git lfs pull"),
            ("no heading", lambda text: text.partition("\n")[2], "has no heading"),
        ],
    ),
    Case("underscore in a number", "doctor", "exit 0, a line", check_doctor),
    *list_cases(
        *("read_outline", "points", outline),
        [
            ("a BOM", "x,y\n" + SQUARE, "utf-8-sig"),
            ("no heading", SQUARE),
            ("head y,x", "y_mm;x_mm\n" + SWAPPED.replace(",", ";")),
            ("a comment, then x,y", "# mine\nx,y\n" + SQUARE),
        ],
    ),
    *list_cases(
        *("read_outline", "refused", no_outline),
        [
            ("underscore in a number", SQUARE.replace("20,0", "2_0,0"), "line 2: '2_0,0' is not"),
            ("an empty file", "", "the file is empty"),
            ("a pointer of Git LFS", POINTER, "git lfs pull"),
            ("a pointer called svg", POINTER, "git lfs pull", "mine.svg"),
        ],
    ),
]


@run_each(CASES)
def test_answer(case, tmp_path, command):
    if case.door == "doctor":
        case.check(tmp_path, command)
    else:
        case.check(tmp_path)
