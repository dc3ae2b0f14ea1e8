"""Files as disks, archives, other systems and cameras leave them."""

import os

import numpy as np
from PIL import Image

from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.recorded_contacts import compute_digest
from jaxunshear.data.recordings import read_recordings
from jaxunshear.files import write_json, write_text
from jaxunshear.inference.infer import _list_png_files
from tests.inputs.cases import Case, list_cases, run_each

READ, UNSHEAR, LONG = "read_recordings", "unshear", "b" * 251
SEEN = np.kron(np.random.default_rng(0).random((16, 24)) > 0.7, np.ones((4, 4)))
SEEN = SEEN.astype(np.uint8) * np.uint8(255)
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"


def save(file, image=SEEN):
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(file)


def read(root):
    return read_recordings(root, Preprocess(size=32))


def no_image(write, words):
    """One image of two is left out, with its name and the reason."""

    def check(root):
        save(root / "a.png")
        write(root / "b.png")
        recordings = read(root)
        assert [frame.name for frame in recordings.iterate_frames()] == ["a.png"]
        (note,) = recordings.notes
        assert note.startswith("left out b.png: ") and words in note
        assert compute_digest((str(root),))

    return check


def names_alone(write, expected):
    """Only these images are found, and nothing is noted."""

    def check(root):
        write(root)
        recordings = read(root)
        assert list(recordings.names) == expected
        assert recordings.notes == []

    return check


def write_rubbish(root):
    save(root / "a.png")
    save(root / "._a.png")
    (root / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
    (root / "Thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0")
    (root / "desktop.ini").write_text("[.ShellClassInfo]")
    (root / "b.png").mkdir()
    os.mkfifo(root / "c.png")


def write_links(root):
    save(root / "elsewhere/a.png")
    (root / "set").mkdir()
    (root / "set/a.png").symlink_to(root / "elsewhere/a.png")
    (root / "again").symlink_to(root)
    (root / "elsewhere/a.png").rename(root / "elsewhere/a.bin")
    (root / "set/a.png").unlink()
    (root / "set/a.png").symlink_to(root / "elsewhere/a.bin")


ODD = ["-a.png", "a b.png", 'a"b.png', "a,b.png", "a\nb.png", "\u00e9.png"]


def write_odd_names(root):
    for name in ODD:
        save(root / name)


def write_nested(root):
    save(root / "one/two/three/a.png")
    (root / "empty/folder").mkdir(parents=True)


def check_long_names(root):
    """Every length that a file system takes."""
    for length in range(250, 256):
        path = root / ("a" * (length - 5) + ".json")
        write_json(path, {"a": length})
        assert path.stat().st_size
    write_text(root / ("\u00e9" * 127), "text")
    assert len(os.listdir(root)) == 7


def outputs(names, expected):
    def check(root):
        files = _list_png_files(tuple(names))
        assert files == expected
        assert len({file.casefold() for file in files}) == len(names)
        assert max(len(os.fsencode(file)) for file in files) <= 255

    return check


def check_unsheared_twins(root, command):
    """A folder of awkward names, at the door itself: each image has its own output."""
    long, noise = f"{LONG}.png", np.uint8(255) * (np.random.default_rng(0).random((96, 96)) < 0.3)
    for name in ("a.jpg", "a.png", "A.png", long):
        save(root / "in" / name, noise)
    words = ("unshear", root / "in", "--model", "standard", "--force", "--out", root / "out")
    answer = command(*words)
    assert answer.code == 0, answer.err
    written = {"A.png", "a.jpg.png", "a.png.png", long}
    assert set(os.listdir(root / "out")) == {*written, "poses.csv", "NOTE.txt"}


CASES = [
    *list_cases(
        *(READ, "left out", no_image),
        [
            ("an empty file", lambda file: file.touch(), "the file is empty"),
            (
                "an image that is a pointer of Git LFS",
                lambda file: file.write_bytes(POINTER),
                "git lfs pull",
            ),
        ],
    ),
    Case("rubbish of other systems", READ, "passed over", names_alone(write_rubbish, ["a.png"])),
    Case("links", READ, "followed once", names_alone(write_links, ["set/a.png"])),
    Case("odd names", READ, "all", names_alone(write_odd_names, sorted(ODD))),
    Case("nested folders", READ, "found", names_alone(write_nested, ["one/two/three/a.png"])),
    Case("names of 250 to 255 bytes", "write_json", "written", check_long_names),
    *list_cases(
        *(UNSHEAR, "each its own", outputs),
        [
            ("jpg beside png", ["1.jpg", "1.png"], ["1.jpg.png", "1.png"]),
            ("jpg alone", ["x/a.jpg", "x/b.png", "y/a.jpg"], ["x/a.png", "x/b.png", "y/a.png"]),
            ("capitals", ["A.png", "a.jpg", "a.png"], ["A.png", "a.jpg.png", "a.png.png"]),
            ("long twins", [LONG + ".jpg", LONG + ".png"], ["0.png", LONG + ".png"]),
        ],
    ),
    Case("awkward names", f"{UNSHEAR} DIR", "exit 0", check_unsheared_twins),
]


@run_each(CASES)
def test_answer(case, tmp_path, command):
    if case.door == f"{UNSHEAR} DIR":
        case.check(tmp_path, command)
    else:
        case.check(tmp_path)
