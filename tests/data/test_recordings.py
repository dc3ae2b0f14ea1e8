"""Every layout of recordings, complete and broken, written by the test."""

import contextlib
import csv
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.recordings import read_image, read_recordings
from jaxunshear.errors import UserError
from jaxunshear.perception import preprocess
from jaxunshear.perception.grey import to_grey
from jaxunshear.perception.preprocess import prepare_frame

PREPROCESS = Preprocess(size=64)
OLDER = [f"{kind}_{i}" for kind in ("pose", "move") for i in range(1, 7)]
NEWER = [f"{kind}_{i}" for kind in ("pose", "shear") for i in ("x", "y", "z", "Rx", "Ry", "Rz")]


def binary(seed, size=96):
    rng = np.random.default_rng(seed)
    white = np.kron(rng.random((size // 4, size // 4)) > 0.7, np.ones((4, 4)))
    return white.astype(np.uint8) * np.uint8(255)


def write_images(folder, names):
    folder.mkdir(parents=True)
    for seed, name in enumerate(names):
        Image.fromarray(binary(seed)).save(folder / name)


def write_targets(file, image_column, columns, names):
    with open(file, "w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow([image_column, *columns])
        for i, name in enumerate(names):
            writer.writerow([name, *(100 * i + np.arange(len(columns)))])


def older(
    root,
    images="images",
    column="sensor_image",
    names=("image_1.png", "image_2.png", "image_10.png"),
):
    write_images(root / images, names)
    write_targets(root / "targets.csv", column, OLDER, names)
    (root / "meta.json").write_text('{"tap_depth": -5.0}')
    return root


def test_a_single_image(tmp_path):
    write_images(tmp_path / "a", ["one.png"])
    recordings = read_recordings(tmp_path / "a" / "one.png", PREPROCESS)
    ((index, name, image),) = recordings.iterate_frames()
    assert (index, name, image.shape, image.dtype) == (0, "one.png", (64, 64), np.uint8)
    assert recordings.poses is None
    assert recordings.moves is None


@pytest.mark.parametrize(
    ("images", "column", "names"),
    [
        ("images", "sensor_image", ("image_1.png", "image_2.png", "image_10.png")),
        ("frames_bw", "image_name", ("frame_1_0.png", "frame_2_0.png", "frame_10_0.png")),
    ],
)
def test_the_older_layout_and_its_variant(tmp_path, images, column, names):
    recordings = read_recordings(older(tmp_path / "set", images, column, names), PREPROCESS)
    # in the order of their numbers
    assert recordings.names == tuple(f"{images}/{name}" for name in names)
    np.testing.assert_array_equal(recordings.poses, 100 * np.arange(3)[:, None] + np.arange(6))
    np.testing.assert_array_equal(recordings.moves, 100 * np.arange(3)[:, None] + np.arange(6, 12))
    assert recordings.notes == []
    assert len(list(recordings.iterate_frames())) == len(recordings) == 3


def test_the_newer_layout(tmp_path):
    for split in ("train", "val"):
        write_images(tmp_path / split / "processed_images", ["image_1.png", "image_2.png"])
        write_images(tmp_path / split / "sensor_images", ["image_1.png"])
        write_targets(
            tmp_path / split / "targets.csv", "sensor_image", NEWER, ["image_1.png", "image_2.png"]
        )
    recordings = read_recordings(tmp_path, PREPROCESS)
    assert recordings.names[0] == "train/processed_images/image_1.png"
    assert len(recordings) == 4
    assert recordings.poses.shape == recordings.moves.shape == (4, 6)
    assert recordings.notes == []


def test_bad_images_are_left_out_by_name(tmp_path):
    root = older(tmp_path / "set")
    full = (root / "images" / "image_2.png").read_bytes()
    (root / "images" / "image_2.png").write_bytes(full[: len(full) // 2])
    (root / "images" / "._image_1.png").write_bytes(b"not an image")
    recordings = read_recordings(root, PREPROCESS)
    assert [index for index, _, _ in recordings.iterate_frames()] == [0, 2]
    assert len(recordings.notes) == 1
    assert "images/image_2.png" in recordings.notes[0]


def test_a_folder_without_one_readable_image(tmp_path):
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(b"nothing")
    with pytest.raises(UserError, match="none of 2 images"):
        list(read_recordings(tmp_path, PREPROCESS).iterate_frames())


def test_pose_numbers(tmp_path):
    root = older(tmp_path / "a" / "set")
    assert read_recordings(root, PREPROCESS).pose_ids is None
    write_images(tmp_path / "a" / "bare", ["x.png"])
    lines = (root / "targets.csv").read_text().splitlines()
    more = ["pose_id,obj_id", "7,3", ",3", "9,"]
    (root / "targets.csv").write_text(
        "\n".join(f"{a},{b}" for a, b in zip(lines, more, strict=True))
    )
    recordings = read_recordings(tmp_path / "a", PREPROCESS)
    assert recordings.names[0] == "bare/x.png"
    assert recordings.pose_ids.dtype == np.int64
    np.testing.assert_array_equal(recordings.pose_ids, [-1, 7, -1, 9])


def test_images_of_other_sizes_are_reported_once(tmp_path):
    root = older(tmp_path / "set")
    Image.fromarray(binary(0, 64)).save(root / "images" / "image_2.png")
    recordings = read_recordings(root, PREPROCESS)
    assert len(list(recordings.iterate_frames())) == len(list(recordings.iterate_frames())) == 3
    (note,) = recordings.notes
    assert note == f"{root / 'images'}: images of 2 sizes: 2 of 96 x 96, 1 of 64 x 64 (image_2.png)"


def test_a_ready_frame_takes_no_arithmetic(tmp_path, monkeypatch):
    """Check that the image is as on disk within the mask, and that wider numbers give the same."""
    root = older(tmp_path / "set")
    for file in (root / "images").iterdir():  # dots within the dome, as the frames of a sensor have
        image = np.asarray(Image.open(file)) * (np.hypot(*np.mgrid[-48:48, -48:48]) < 36)
        Image.fromarray(image.astype(np.uint8)).save(file)
    ready = replace(PREPROCESS, size=96)
    recordings = read_recordings(root, ready)
    view = recordings.find_common_view()
    long = [
        prepare_frame(ready, read_image(file).astype(np.uint16), view) for file in recordings.files
    ]
    for arithmetic in ("_both_sides", "to_grey"):
        monkeypatch.setattr(preprocess, arithmetic, None)
    np.testing.assert_array_equal([image for _, _, image in recordings.iterate_frames(view)], long)
    assert 0 < np.mean(long) < 255


def test_paths_that_hold_nothing(tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        read_recordings(tmp_path / "absent", PREPROCESS)
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(UserError, match=r"notes\.txt is no image"):
        read_recordings(tmp_path / "notes.txt", PREPROCESS)
    with pytest.raises(UserError, match="holds no images"):
        read_recordings(tmp_path, PREPROCESS)


@pytest.mark.parametrize("mode", ["P", "I;16", "1", "RGB", "RGBA", "LA", "CMYK", "L"])
def test_colour_modes(tmp_path, mode):
    image = Image.fromarray(binary(0))
    wide = Image.fromarray(binary(0).astype(np.uint16) * 257)
    image = wide if mode == "I;16" else image.convert(mode)
    file = tmp_path / {"CMYK": "a.tif", "L": "a.bmp"}.get(mode, "a.png")
    image.save(file)
    Image.fromarray(binary(0)).save(tmp_path / "grey.png")
    ((_, _, same),) = read_recordings(tmp_path / "grey.png", PREPROCESS).iterate_frames()
    ((_, _, read),) = read_recordings(file, PREPROCESS).iterate_frames()
    np.testing.assert_array_equal(read, same)


def test_real_recordings(real_recordings, tmp_path):
    subprocess.run(
        [sys.executable, real_recordings / "unpack.py", tmp_path, "--limit", "3"],
        check=True,
        capture_output=True,
    )
    recordings = read_recordings(tmp_path, Preprocess(size=128))
    assert [image.shape for _, _, image in recordings.iterate_frames()] == [(128, 128)] * 12
    assert np.isfinite(recordings.poses).all()
    assert recordings.notes == []
    is_unknown = ["franka" in name for name in recordings.names]
    np.testing.assert_array_equal(recordings.pose_ids == -1, is_unknown)
    raw = read_recordings(real_recordings / "raw", PREPROCESS)
    assert len(list(raw.iterate_frames())) == len(raw.poses) == 3
    newer = read_recordings(real_recordings / "surface_3d_sample", PREPROCESS)
    assert np.isfinite(newer.poses).all()
    assert len(list(newer.iterate_frames())) == 40


def test_names_that_no_encoding_or_number_suits(tmp_path):
    """Latin-1 bytes of an old archive, and a digit that is no decimal."""
    write_images(tmp_path / "a", ["a.png", "\u00b25.png"])
    shutil.copy(tmp_path / "a" / "a.png", os.fsencode(tmp_path) + b"/a/caf\xe9.png")
    recordings = read_recordings(tmp_path / "a", PREPROCESS)
    assert set(recordings.names) == {"a.png", "caf\\xe9.png", "\u00b25.png"}
    assert len("".join(recordings.names).encode()) and len(list(recordings.iterate_frames())) == 3


@pytest.mark.parametrize("narrower", [0, 4])
def test_images_of_a_folder_are_cropped_alike(tmp_path, narrower):
    """Pins that move as one stay moved: a crop of each image's own would follow them."""
    column, row = np.meshgrid(np.arange(320), np.arange(240))
    pins = np.concatenate(
        [9 * k * np.exp(2j * np.pi * np.arange(6 * k) / (6 * k)) for k in range(1, 11)]
    )
    for folder, off in (("a", 0), ("b", 20)):
        (tmp_path / folder).mkdir()
        wide = narrower if folder == "b" else 0
        for i, shift in enumerate((-6, 0, 6)):
            grey = (20 + row // 4).astype(np.uint8)  # not of two levels
            for pin in pins + 150 + 120j + off + shift:
                grey[np.hypot(column - pin.real, row - pin.imag) < 2.5] = 200
            Image.fromarray(grey[: 240 - wide, : 320 - wide]).save(tmp_path / folder / f"{i}.png")
    recordings = read_recordings(tmp_path, Preprocess(size=128))
    # one without a crop: the folders differ in size
    other = recordings.find_common_view() if narrower else None
    for view in (None, other):
        middles = [
            np.argwhere(image).mean(axis=0)[1] for _, _, image in recordings.iterate_frames(view)
        ]
        scale = 0.375 * 128 / 90  # px of an image a px of a frame
        np.testing.assert_allclose(middles, 63.5 + scale * np.array([-6, 0, 6, -6, 0, 6]), atol=0.5)


def test_what_an_image_hides_is_reported(tmp_path):
    for folder in ("a/images", "b"):
        (tmp_path / folder).mkdir(parents=True)
        Image.fromarray(np.eye(64, dtype=np.uint8) * 255).save(tmp_path / folder / "1.png")
    assert read_recordings(tmp_path, PREPROCESS).notes == []
    Image.fromarray(np.eye(64, dtype=np.uint8) * 255).save(tmp_path / "overview.png")
    recordings = read_recordings(tmp_path, PREPROCESS)
    (note,) = recordings.notes
    assert len(recordings) == 1 and "images of its own" in note and str(tmp_path / "a") in note


def test_several_frames_in_one_file_are_refused_by_name(tmp_path):
    first, *others = (Image.fromarray(binary(seed)) for seed in range(5))
    names = ("a.tif", "b.png", "c.webp", "e.png")
    for name in names:
        form = "gif" if name == "e.png" else None  # a name may lie
        first.save(tmp_path / name, form, save_all=True, append_images=others)
    first.save(tmp_path / "d.tif")
    recordings = read_recordings(tmp_path, PREPROCESS)
    assert [name for _, name, _ in recordings.iterate_frames()] == ["d.tif"]
    for name, note in zip(names, recordings.notes, strict=True):
        assert f"{name}: it holds 5 frames" in note and "save each as a file of its own" in note


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif"])
@pytest.mark.parametrize("tag", range(1, 9))
def test_orientation_tags_are_followed(tmp_path, name, tag):
    seen = np.kron([[255, 0, 0], [0, 0, 255]], np.ones((16, 16))).astype(np.uint8)
    turned = [seen, seen[:, ::-1], seen[::-1, ::-1], seen[::-1]]
    turned += [seen.T, seen.T[::-1], seen[::-1, ::-1].T, seen[::-1].T]
    tags = Image.Exif()
    tags[274] = tag
    Image.fromarray(np.ascontiguousarray(turned[tag - 1])).save(tmp_path / name, exif=tags)
    read = read_image(tmp_path / name)
    assert read.shape == seen.shape
    np.testing.assert_array_equal(read > 127, seen > 127)


def test_wide_integers_mean_what_the_file_says(tmp_path):
    """Unsigned ones above half their range, and 16 bits whose zero is white."""
    seen = binary(0)
    wide = Image.frombytes("I", seen.shape[::-1], (seen.astype(np.uint32) * 0x01010101).tobytes())
    wide.save(tmp_path / "a.tif")
    data = (tmp_path / "a.tif").read_bytes()
    # Pillow writes it as signed; the tag is set by hand
    head, tail = data.split(signed := bytes.fromhex("5301 0300 01000000"))
    (tmp_path / "a.tif").write_bytes(head + signed + b"\1" + tail[1:])
    inverse = (255 - seen).astype(np.uint16) * np.uint16(257)
    Image.fromarray(inverse).save(tmp_path / "b.tif", tiffinfo={262: 0})
    for name in ("a.tif", "b.tif"):
        read = read_image(tmp_path / name)
        unit = 0x01010101 if name == "a.tif" else 257
        np.testing.assert_array_equal(read, seen.astype(np.int64) * unit)
        np.testing.assert_array_equal(to_grey(read), seen / np.float32(255))


def test_numbers_below_zero_are_refused(tmp_path):
    data = (binary(0).astype(np.int32) - 128).tobytes()
    Image.frombytes("I", (96, 96), data).save(tmp_path / "a.tif")
    with pytest.raises(UserError, match="below zero"):
        list(read_recordings(tmp_path, PREPROCESS).iterate_frames())


def test_a_flipped_bit_of_a_png_is_never_another_image(tmp_path):
    """Check what Pillow passes over: the checksum of the pixels.

    In a binary image many flips leave what can be decoded.
    """
    file = tmp_path / "a.png"
    Image.fromarray(np.pad(np.full((20, 20), 255, np.uint8), 14)).save(file)
    sound, right = file.read_bytes(), read_image(file)
    for bit in range(8 * len(sound)):
        damaged = bytearray(sound)
        damaged[bit // 8] ^= 1 << bit % 8
        file.write_bytes(damaged)
        with contextlib.suppress(UserError):
            np.testing.assert_array_equal(read_image(file), right, err_msg=str(bit))
