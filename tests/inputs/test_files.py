"""Files as disks, archives, other systems and cameras leave them."""

import os

import numpy as np
import pytest
from PIL import Image

from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.recorded_contacts import compute_digest
from jaxunshear.data.recordings import read_image, read_recordings
from jaxunshear.errors import UserError
from jaxunshear.files import write_json, write_text
from jaxunshear.inference.infer import _list_png_files
from tests.inputs.cases import Case, run_each

READ, IMAGE, UNSHEAR = "read_recordings", "read_image", "unshear"
SEEN = np.kron(np.random.default_rng(0).random((16, 24)) > 0.7, np.ones((4, 4)))
SEEN = SEEN.astype(np.uint8) * np.uint8(255)
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"


def save(file, image=SEEN, **options):
    file.parent.mkdir(parents=True, exist_ok=True)
    (image if isinstance(image, Image.Image) else Image.fromarray(image)).save(file, **options)


def read(root):
    return read_recordings(root, Preprocess(size=32))


def converted(mode, name="a.png"):
    """An image of this mode is read as the grey one is."""

    def check(root):
        image = Image.fromarray(SEEN).convert(mode)
        save(root / name, image)
        raw = read_image(root / name)
        grey = raw if raw.ndim == 2 else raw[..., 0]
        np.testing.assert_array_equal(grey > grey.max() / 2, SEEN > 127)

    return check


def check_16_bits(root):
    save(root / "a.png", SEEN.astype(np.uint16) * 257)
    np.testing.assert_array_equal(read_image(root / "a.png"), SEEN.astype(np.uint16) * 257)


def check_turned(root):
    tags = Image.Exif()
    tags[274] = 6  # to be turned by a quarter to the right
    save(root / "a.jpg", np.ascontiguousarray(SEEN.T[::-1]), exif=tags, quality=95)
    np.testing.assert_array_equal(read_image(root / "a.jpg") > 127, SEEN > 127)


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


def cut(file):
    save(file)
    file.write_bytes(file.read_bytes()[:40])


def animate(file):
    frames = [Image.fromarray(np.roll(SEEN, i)) for i in range(3)]
    frames[0].save(file, "gif", save_all=True, append_images=frames[1:])


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


def refused(make, words):
    def check(root):
        with pytest.raises(UserError, match=words) as refusal:
            read(make(root))
        assert "\n" not in str(refusal.value)

    return check


def check_long_names(root):
    """Every length that a file system takes."""
    for length in range(250, 256):
        path = root / ("a" * (length - 5) + ".json")
        write_json(path, {"a": length})
        assert path.stat().st_size
    write_text(root / ("\u00e9" * 127), "text")
    assert len(os.listdir(root)) == 7


def outputs(names, expected):
    return lambda root: compare_outputs(names, expected)


def compare_outputs(names, expected):
    files = _list_png_files(tuple(names))
    assert files == expected
    assert len({file.casefold() for file in files}) == len(names)
    assert max(len(os.fsencode(file)) for file in files) <= 255


def check_unsheared_twins(root, command):
    """A folder of awkward names, at the door itself: each image has its own output."""
    long, generator = "b" * 251 + ".png", np.random.default_rng(0)
    noise = (generator.random((96, 96)) < 0.3).astype(np.uint8) * 255
    for name in ("a.jpg", "a.png", "A.png", long):
        save(root / "in" / name, noise, quality=95) if name == "a.jpg" else save(
            root / "in" / name, noise
        )
    words = ("unshear", root / "in", "--model", "standard", "--force", "--out", root / "out")
    answer = command(*words)
    assert answer.code == 0, answer.err
    written = {"A.png", "a.jpg.png", "a.png.png", long}
    assert set(os.listdir(root / "out")) == {*written, "poses.csv", "NOTE.txt"}


CASES = [
    *(
        Case(f"mode {mode}", IMAGE, "the image", converted(mode, name))
        for mode, name in (
            *((mode, "a.png") for mode in ("1", "P", "RGB", "RGBA", "LA")),
            ("CMYK", "a.tif"),
            ("L", "a.bmp"),
        )
    ),
    Case("16 bits", IMAGE, "the image", check_16_bits),
    Case("turned by EXIF", IMAGE, "the image, upright", check_turned),
    Case("an empty file", READ, "left out", no_image(lambda f: f.touch(), "the file is empty")),
    Case(
        "an image that is a pointer of Git LFS",
        READ,
        "left out",
        no_image(lambda f: f.write_bytes(POINTER), "git lfs pull"),
    ),
    Case("a cut PNG", READ, "left out", no_image(cut, "no readable image")),
    Case("an animated GIF", READ, "left out", no_image(animate, "it holds 3 frames")),
    Case(
        "text called png",
        READ,
        "left out",
        no_image(lambda f: f.write_text("hello"), "no readable image"),
    ),
    Case(
        "a broken link",
        READ,
        "left out",
        no_image(lambda f: f.symlink_to("absent"), "No such file"),
    ),
    Case(
        "a link to itself", READ, "left out", no_image(lambda f: f.symlink_to(f), "symbolic links")
    ),
    Case("rubbish of other systems", READ, "passed over", names_alone(write_rubbish, ["a.png"])),
    Case("links", READ, "followed once", names_alone(write_links, ["set/a.png"])),
    Case("odd names", READ, "all", names_alone(write_odd_names, sorted(ODD))),
    Case("nested folders", READ, "found", names_alone(write_nested, ["one/two/three/a.png"])),
    Case("an empty folder", READ, "exit 2", refused(lambda root: root, "holds no images")),
    Case("no such place", READ, "exit 2", refused(lambda root: root / "x", "does not exist")),
    Case("names of 250 to 255 bytes", "write_json", "written", check_long_names),
    Case(
        "jpg beside png",
        UNSHEAR,
        "each its own",
        outputs(["image_1.jpg", "image_1.png"], ["image_1.jpg.png", "image_1.png"]),
    ),
    Case(
        "jpg alone",
        UNSHEAR,
        "a png",
        outputs(["x/a.jpg", "x/b.png", "y/a.jpg"], ["x/a.png", "x/b.png", "y/a.png"]),
    ),
    Case(
        "twins but for capitals",
        UNSHEAR,
        "each its own",
        outputs(["A.png", "a.jpg", "a.png"], ["A.png", "a.jpg.png", "a.png.png"]),
    ),
    Case(
        "long twins",
        UNSHEAR,
        "numbered",
        outputs(["b" * 251 + ".jpg", "b" * 251 + ".png"], ["0.png", "b" * 251 + ".png"]),
    ),
    Case("awkward names", f"{UNSHEAR} DIR", "exit 0", check_unsheared_twins),
]


@run_each(CASES)
def test_answer(case, tmp_path, command):
    if case.door == f"{UNSHEAR} DIR":
        case.check(tmp_path, command)
    else:
        case.check(tmp_path)
