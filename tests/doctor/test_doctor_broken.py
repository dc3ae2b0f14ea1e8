"""Broken folders of recordings: messages name the fault by file and row."""

import hashlib
import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxunshear.cli import main
from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.recordings import read_recordings
from jaxunshear.errors import UserError

COLUMNS = [f"{kind}_{i}" for kind in ("pose", "move") for i in range(1, 7)]
NAMES = [f"image_{i}.png" for i in range(1, 5)]


def dots(seed, size=48):
    """A grid of dots, each moved a little."""
    image = np.zeros((size, size), np.uint8)
    generator = np.random.default_rng(seed)
    for row in range(9, size - 9, 5):
        for column in range(9, size - 9, 5):
            down, right = generator.integers(0, 2, 2)
            image[row + down : row + down + 2, column + right : column + right + 2] = 255
    return image


def sound(root):
    (root / "images").mkdir(parents=True)
    lines = [",".join(["sensor_image", "obj_id", "pose_id", *COLUMNS])]
    for i, name in enumerate(NAMES):
        Image.fromarray(dots(i)).save(root / "images" / name)
        lines.append(",".join([name, "1", str(i), *(f"{0.25 * i + j}" for j in range(12))]))
    (root / "targets.csv").write_text("\n".join(lines) + "\n")
    (root / "meta.json").write_text('{"tap_depth": 5}')
    return root


def image(data):
    """Replace an image by bytes, or by a function of the file."""

    def spoil(root):
        file = root / "images" / IMAGE
        file.write_bytes(data(file) if callable(data) else data)

    return spoil


def drawn(pixels, *names):
    """Draw images anew, the second alone if none is named."""

    def spoil(root):
        for name in names or (IMAGE,):
            Image.fromarray(pixels).save(root / "images" / name)

    return spoil


def table(change):
    """Change the lines of the table, or replace its bytes."""

    def spoil(root):
        file = root / TABLE
        changed = change(file.read_text().splitlines())
        file.write_bytes(changed if isinstance(changed, bytes) else "\n".join(changed).encode())

    return spoil


def line(number, change):
    return table(lambda lines: [*lines[: number - 1], change(lines[number - 1]), *lines[number:]])


def cell(row, column, value):
    def change(cells):
        cells = cells.split(",")
        cells[["sensor_image", "obj_id", "pose_id", *COLUMNS].index(column)] = value
        return ",".join(cells)

    return line(row, change)


def without(column):
    def change(lines):
        at = lines[0].split(",").index(column)
        return [",".join(np.delete(line.split(","), at)) for line in lines]

    return table(change)


def instead(name, make):
    """Put another thing in the place of a file."""

    def spoil(root):
        (root / name).unlink()
        make(root / name)

    return spoil


def bomb(file):
    """A PNG that claims 60,000 pixels a side."""
    data = file.read_bytes()
    return data[:16] + struct.pack(">II", 60_000, 60_000) + data[24:]


def hide(name):
    return lambda root: (root / name).chmod(0)


def encoded(text, encoding):
    return table(lambda lines: "\n".join(lines).replace("image_3", text).encode(encoding))


IMAGE, TABLE = NAMES[1], "targets.csv"
FLAT = np.zeros((48, 48), np.uint8)
SEEN_BY_ALL = os.geteuid() == 0  # files of any mode
CASES = {  # what is done; the file that must be named, if any, and the row
    "image cut in its name": (image(lambda f: f.read_bytes()[:1]), IMAGE, None),
    "image cut in its head": (image(lambda f: f.read_bytes()[:33]), IMAGE, None),
    "image half": (image(lambda f: f.read_bytes()[: f.stat().st_size // 2]), IMAGE, None),
    "image of no bytes": (image(b""), IMAGE, None),
    "table named png": (image(lambda f: (f.parents[1] / TABLE).read_bytes()), IMAGE, None),
    "bomb": (image(bomb), IMAGE, None),
    "one pixel": (drawn(FLAT[:1, :1]), IMAGE, None),
    "black": (drawn(FLAT), IMAGE, None),
    "another size": (drawn(dots(1, 64)), IMAGE, None),
    "folder named png": (instead(f"images/{IMAGE}", Path.mkdir), TABLE, 3),
    "no image": (instead(f"images/{IMAGE}", lambda f: None), TABLE, 3),
    "link to nothing": (instead(f"images/{IMAGE}", lambda f: f.symlink_to("absent")), IMAGE, None),
    "link to itself": (instead(f"images/{IMAGE}", lambda f: f.symlink_to(f)), IMAGE, None),
    "queue named png": (instead(f"images/{IMAGE}", os.mkfifo), TABLE, 3),
    "image of no row": (drawn(dots(9), "image_9.png"), TABLE, None),
    "colour": (drawn(np.repeat(dots(1)[..., None], 3, -1)), "", None),
    "16 bits": (drawn(dots(1).astype(np.uint16) * 257), "", None),
    "unreadable image": (hide(f"images/{IMAGE}"), "" if SEEN_BY_ALL else IMAGE, None),
    "unreadable table": (hide(TABLE), "" if SEEN_BY_ALL else TABLE, None),
    "empty table": (table(lambda lines: b""), TABLE, None),
    "heading only": (table(lambda lines: lines[:1]), TABLE, None),
    "no heading": (table(lambda lines: lines[1:]), TABLE, 1),
    "semicolons": (table(lambda lines: [each.replace(",", ";") for each in lines]), "", None),
    "utf-16": (encoded("image_3", "utf-16"), TABLE, 1),
    "latin-1": (encoded("bild_\xfc", "latin-1"), TABLE, 4),
    "byte order mark": (encoded("image_3", "utf-8-sig"), "", None),
    "NUL bytes": (line(3, lambda text: text.replace("0.25", "0.\x0025")), TABLE, 3),
    "open quote": (line(3, lambda text: '"' + text), TABLE, 3),
    "endless cell": (table(lambda lines: [*lines[:3], "9" * 200_000]), TABLE, 4),
    "column twice": (line(1, lambda text: text.replace("pose_2", "pose_1")), TABLE, 1),
    "short row": (line(4, lambda text: text[:30]), TABLE, 4),
    "long row": (line(4, lambda text: text + ",1,2"), TABLE, 4),
    "row again": (table(lambda lines: [*lines, lines[2]]), TABLE, 6),
    "folder named csv": (instead(TABLE, Path.mkdir), "", None),
    **{f"no {name}": (without(name), TABLE, None) for name in ("sensor_image", "pose_3", "move_6")},
    **{f"no {name}": (without(name), "", None) for name in ("obj_id", "pose_id")},
    **{
        f"{value or 'nothing'} in a pose": (cell(4, "pose_1", value), TABLE, 4)
        for value in ("abc", "", "nan", "1e400", "-1e308", "0x10", "\u221e")
    },
    "inf in a move": (cell(4, "move_4", "inf"), TABLE, 4),
    **{
        f"{value} in pose_id": (cell(2, "pose_id", value), TABLE, 2)
        for value in ("x", "1.5", "-7", "1e99")
    },
    "name in another folder": (cell(3, "sensor_image", "elsewhere/image_77.png"), TABLE, 3),
    "no name": (cell(3, "sensor_image", ""), TABLE, 3),
    "link that leads back": (lambda root: (root / "again").symlink_to(root), "", None),
}
RANDOM = [
    *(("images/" + IMAGE, how, seed) for how in ("flip", "cut", "insert") for seed in range(2)),
    *((TABLE, how, seed) for how in ("flip", "cut", "insert") for seed in range(2)),
]


def spoilt(data, how, seed):
    generator = np.random.default_rng(seed)
    at = int(generator.integers(0, len(data)))
    if how == "cut":
        return data[:at]
    if how == "insert":
        return data[:at] + generator.bytes(int(generator.integers(1, 40))) + data[at:]
    changed = bytearray(data)
    for place in generator.integers(0, len(data), 1 + seed % 8):
        changed[place] ^= 1 << int(generator.integers(0, 8))
    return bytes(changed)


def contents(root):
    digests = {}
    for path in sorted(root.rglob("*")):
        digests[path] = hashlib.sha1(path.read_bytes()).hexdigest() if path.is_file() else ""
    return digests


def refusal(root):
    """What the reader says of a folder that it cannot read; nothing where it can."""
    try:
        recordings = read_recordings(root, Preprocess(size=32))
        list(recordings.iterate_frames())
    except UserError as error:
        return str(error)
    return "".join(note for note in recordings.notes if "\n" in note)


def examined(root, capsys, *options):
    """Run the reader and the doctor, which changes no file; returns code, lines and error."""
    before = contents(root)
    assert "\n" not in refusal(root)
    code = main(["doctor", str(root), *options])
    out, err = capsys.readouterr()
    assert contents(root) == before
    assert "Traceback" not in out + err
    errors = [line for line in err.splitlines() if not line.startswith("doctor ")]
    assert len(errors) == (1 if code == 2 else 0)
    assert code in (0, 1) or str(root) in errors[0]
    assert code != 2 or not out
    return code, out.splitlines(), "".join(errors)


def test_a_sound_folder_has_nothing_broken(tmp_path, capsys):
    code, lines, _ = examined(sound(tmp_path / "set"), capsys)
    assert code == 0 and not any(line.startswith("problem: ") for line in lines)


@pytest.mark.parametrize(("spoil", "file", "row"), CASES.values(), ids=CASES)
def test_what_is_broken_is_named(tmp_path, capsys, spoil, file, row):
    root = sound(tmp_path / "set")
    spoil(root)
    code, lines, _ = examined(root, capsys)
    broken = [line for line in lines if line.startswith("problem: ")]
    assert code == 0  # three images are left
    if not file:
        assert not broken
    elif row:
        assert any(f"{file}, row {row}: " in line for line in broken)
    else:
        assert any(file in line for line in broken)


@pytest.mark.parametrize(("name", "how", "seed"), RANDOM)
def test_random_damage_is_survived(tmp_path, capsys, name, how, seed):
    root = sound(tmp_path / "set")
    (root / name).write_bytes(spoilt((root / name).read_bytes(), how, seed))
    code, lines, _ = examined(root, capsys)
    assert code == 0 and any(line.startswith("next: ") for line in lines)


def all_as(data):
    return lambda root: [(root / "images" / name).write_bytes(data) for name in NAMES]


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda root: [(root / "images" / name).unlink() for name in NAMES], "holds no images"),
        (all_as(b"text"), "none of 4 images"),
        (drawn(FLAT, *NAMES), "one flat grey"),
        (drawn(FLAT[:1, :1], *NAMES), "too small"),
    ],
    ids=["none", "text", "black", "pixels"],
)
def test_where_nothing_can_be_read_nothing_is_written(tmp_path, capsys, spoil, says):
    root = sound(tmp_path / "set")
    spoil(root)
    code, _, error = examined(root, capsys, "--json", str(tmp_path / "found.json"))
    assert code == 2 and says in error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["set"]


def test_a_broken_folder_among_sound_ones(tmp_path, capsys):
    root = tmp_path / "all"
    for name in ("a", "b", "c"):
        sound(root / name)
    all_as(b"")(root / "b")
    code, lines, _ = examined(root, capsys, "--json", str(tmp_path / "found.json"))
    assert code == 0
    assert f"  frames: {len(NAMES)}, none can be used" in lines
    assert sum(line.startswith("problem: ") for line in lines) == len(NAMES)
    rows = json.loads((tmp_path / "found.json").read_text())["rows"]
    assert [row["name"] for row in rows] == ["a", "b", "c"]


def test_names_that_are_no_text(tmp_path, capsys):
    root = sound(tmp_path / "set")
    (root / "images" / IMAGE).rename(root / "images" / "b\udce9 \n.png")
    code, lines, _ = examined(root, capsys)
    assert code == 0 and any("b\\udce9" in line for line in lines)
