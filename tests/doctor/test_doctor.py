"""What the doctor says of sound recordings of several sensors and layouts, drawn by the test."""

import json
import shlex
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from PIL import Image

from jaxunshear.cli import main, make_parser
from jaxunshear.config.sensor import TACTIP_127, TACTIP_331, Sensor
from jaxunshear.doctor import check_recordings, describe
from jaxunshear.errors import UserError
from jaxunshear.simulator.pin_layout import compute_pin_lattice

SIZE = 256
AXES = ("x", "y", "z", "Rx", "Ry", "Rz")
OLDER = [f"{kind}_{i}" for kind in ("pose", "move") for i in range(1, 7)]
NEWER = [f"{kind}_{axis}" for kind in ("pose", "shear") for axis in AXES]
OTHER = replace(TACTIP_331, name="other", rings=5, pin_spacing_mm=3.0, pin_radius_mm=0.8)


@cache
def picture(sensor: Sensor, seed: int) -> np.ndarray:
    """White pins on black, each moved a little."""
    flat = compute_pin_lattice(sensor)
    flat = flat / np.linalg.norm(flat, axis=1).max()
    pins = (
        (SIZE - 1) / 2
        + 0.375 * SIZE * flat
        + np.random.default_rng(seed).normal(0, 0.3, flat.shape)
    )
    row, column = np.mgrid[:SIZE, :SIZE]
    radius = 0.25 * 0.75 * SIZE / (2 * sensor.rings + 1)
    image = np.zeros((SIZE, SIZE), np.uint8)
    for x, y in pins:
        image[np.hypot(column - x, row - y) < radius] = 255
    return image


def recorded(
    root,
    sensor=TACTIP_331,
    slide=0.0,
    columns=OLDER,
    images="images",
    count=3,
    turn=lambda image: image,
):
    (root / images).mkdir(parents=True)
    lines = [",".join(["sensor_image", "pose_id", *columns])]
    for i in range(count):
        Image.fromarray(turn(picture(sensor, i))).save(root / images / f"image_{i + 1}.png")
        labels = [0, i - 1, 3 + i, 0, 0, 120 * i - 100, slide, 0, 0, 0, 0, 0]
        lines.append(",".join([f"image_{i + 1}.png", str(i), *map(str, labels[: len(columns)])]))
    (root / "targets.csv").write_text("\n".join(lines))
    return root


def is_parsed(command):
    """Whether a command is one, with or without a field of an experiment."""
    known, _, field = command.partition(" --unshear.")
    make_parser().parse_args(shlex.split(known)[1:])
    return not field or field.split() == ["input", "pins"]


@pytest.mark.parametrize(("columns", "images"), [(OLDER, "images"), (NEWER, "processed_images")])
def test_taps_and_slides_of_each_layout(tmp_path, columns, images):
    root = tmp_path / "edge 2d"
    recorded(root / "tap" / "train", columns=columns, images=images)
    recorded(root / "shear" / "train", slide=2.0, columns=columns, images=images)
    diagnosis = check_recordings(root)
    assert [folder.name for folder in diagnosis.rows] == [
        f"{kind}/train" for kind in ("shear", "tap")
    ]
    for folder, taps, slides in zip(diagnosis.rows, (0, 3), (3, 0), strict=True):
        assert (folder.frames, folder.usable, folder.size) == (3, 3, (SIZE, SIZE))
        assert (folder.pins.layout, folder.pins.median, folder.pins.followed) == (
            "tactip331",
            331,
            1,
        )
        assert not folder.pins.inverted
        assert (folder.labels.posed, folder.labels.taps, folder.labels.slides) == (3, taps, slides)
        assert folder.labels.ranges == {"y_mm": (-1, 1), "z_mm": (3, 5), "Rz_deg": (-100, 140)}
    assert diagnosis.problems == [] and diagnosis.note == ""
    folders = f"--taps '{root}/tap/train' --slides '{root}/shear/train'"
    fit = f"jaxunshear fit {folders} --unshear.input pins"
    assert diagnosis.next == fit and is_parsed(diagnosis.next)


def test_taps_and_slides_in_several_folders_are_found_by_their_labels(tmp_path):
    for name, slide in (("tap", 0.0), ("more", 0.0), ("slide", 1.0)):
        recorded(tmp_path / name, slide=slide)
    fit = f"jaxunshear fit --taps {tmp_path} --slides {tmp_path} --unshear.input pins"
    assert check_recordings(tmp_path).next == fit


def test_one_kind_alone_teaches_poses(tmp_path):
    for name, slide in (("tap", 0.0), ("slide", 1.0)):
        root = recorded(tmp_path / name, slide=slide)
        diagnosis = check_recordings(root)
        assert diagnosis.next == f"jaxunshear fit --{name}s {root}" and is_parsed(diagnosis.next)
        assert "read poses, not to unshear" in diagnosis.note
        assert ("--paired.pairing simulated" in diagnosis.note) == (name == "tap")


@pytest.mark.parametrize(
    ("count", "command"), [(3, "pins {} --sensor tactip331"), (20, "unshear {} --out unsheared")]
)
def test_poses_without_moves(tmp_path, count, command):
    """Twenty frames or more show where pins stand, which released weights need."""
    root = recorded(tmp_path / "set", columns=OLDER[:6], count=count)
    diagnosis = check_recordings(root)
    assert diagnosis.next == f"jaxunshear {command.format(root)}" and is_parsed(diagnosis.next)
    assert ("--like" if count < 20 else "fit --taps DIR --slides DIR") in diagnosis.note
    assert "  labels: 3 poses, 0 taps, 0 slides" in "\n".join(describe(diagnosis)) or count > 3


def test_other_sensors(tmp_path):
    root = recorded(tmp_path / "127", TACTIP_127, columns=OLDER[:6])
    diagnosis = check_recordings(root)
    assert diagnosis.rows[0].pins.layout == "tactip127"
    assert diagnosis.next == f"jaxunshear pins {root} --sensor tactip127"
    assert "needs 20 frames" in diagnosis.note
    root = recorded(tmp_path / "many", TACTIP_127, columns=OLDER[:6], count=20)
    command = f"jaxunshear unshear {root} --model skin127 --out unsheared"
    assert check_recordings(root).next == command and is_parsed(command)
    root = recorded(tmp_path / "other", OTHER)
    diagnosis = check_recordings(root)
    assert diagnosis.rows[0].pins.layout is None
    assert diagnosis.next == f"jaxunshear layout {root} --out layout.json"
    assert is_parsed(diagnosis.next) and "about 91 pins" in diagnosis.note


def test_different_sensors_are_checked_apart(tmp_path):
    taps = recorded(tmp_path / "tap")
    recorded(tmp_path / "slide", TACTIP_127, slide=1.0, count=2)
    diagnosis = check_recordings(tmp_path)
    assert diagnosis.next == f"jaxunshear doctor {taps}" and is_parsed(diagnosis.next)
    assert "check each on its own" in diagnosis.note


@pytest.mark.parametrize("colours", [False, True])
def test_dark_pins_on_a_light_ground(tmp_path, capsys, colours):
    def turn(image):
        turned = 255 - image
        return np.stack([turned] * 3, -1) if colours else turned

    root = recorded(tmp_path / "set", turn=turn)
    diagnosis = check_recordings(root)
    assert diagnosis.rows[0].pins.inverted and diagnosis.rows[0].pins.layout == "tactip331"
    assert diagnosis.next == f"jaxunshear layout {root} --out layout.json"
    assert "which a layout file says" in diagnosis.note
    file = tmp_path / "layout.json"
    assert main(["layout", str(root), "--out", str(file)]) == 0
    assert main(["doctor", str(root), "--layout", str(file)]) == 0
    said = capsys.readouterr().out
    assert "layout of layout; followed in 100%" in said
    assert f"next: jaxunshear fit --taps {root} --layout {file}" in said


def test_images_without_pins_are_not_called_negatives(tmp_path):
    Image.fromarray(np.add.outer(np.arange(64), np.arange(64)).astype(np.uint8)).save(
        tmp_path / "plot.png"
    )
    diagnosis = check_recordings(tmp_path)
    assert not diagnosis.next and diagnosis.note.startswith("no pins are found")


def test_what_holds_nothing_is_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("hello")
    for path, says in (
        (tmp_path, "no images"),
        (tmp_path / "notes.txt", "no image"),
        (tmp_path / "a", "not exist"),
    ):
        with pytest.raises(UserError, match=says):
            check_recordings(path)
        assert main(["doctor", str(path)]) == 2
        out, err = capsys.readouterr()
        assert out == "" and err.count("\n") == 1 and str(path) in err


def test_text_and_json(tmp_path, capsys):
    root, file = recorded(tmp_path / "set"), tmp_path / "found.json"
    (root / "images" / "image_2.png").write_bytes(b"\x89PNG")
    assert main(["doctor", str(root), "--json", str(file)]) == 0
    lines = capsys.readouterr().out.splitlines()
    diagnosis = check_recordings(root)
    assert lines[0] == f"{root}: 3 frames in 1 folder"
    assert f"  frames: 2 of {SIZE} x {SIZE} px" in lines
    assert "  pins: about 331, layout of tactip331; followed in 100% of 2 sampled frames" in lines
    assert "left out: 1 of 3 frames (33.3%), 1 cannot be read" in lines
    found = json.loads(file.read_text())
    assert found["rows"][0]["pins"]["layout"] == "tactip331"
    assert found["rows"][0]["left_out"] == {"cannot be read": 1}
    assert found["problems"][0]["place"].endswith("image_2.png")
    assert found["next"] == diagnosis.next and found["usable"]
    assert {"command", "machine", "versions"} < found.keys()


def test_real_recordings(real_recordings):
    (folder,) = check_recordings(real_recordings / "surface_3d_sample").rows
    assert (folder.name, folder.usable, folder.labels.slides) == ("train", 40, 40)
    assert folder.pins.layout == "tactip331" and folder.pins.followed == 1
    (folder,) = check_recordings(real_recordings / "raw").rows
    assert folder.pins.layout == "tactip331"
