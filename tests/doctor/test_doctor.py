"""What the doctor says of sound recordings of several sensors and layouts, drawn by the test."""

import json
import shlex
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from PIL import Image

from jaxunshear.cli import _parser, main
from jaxunshear.dataset.preparing import LEAST_FRAMES
from jaxunshear.doctor.doctor import examine
from jaxunshear.errors import UserError
from jaxunshear.report.doctor_text import text_of
from jaxunshear.scene.pins import pin_lattice
from jaxunshear.settings.sensor import TACTIP_127, TACTIP_331, Sensor

SIZE = 256
AXES = ("x", "y", "z", "Rx", "Ry", "Rz")
OLDER = [f"{kind}_{i}" for kind in ("pose", "move") for i in range(1, 7)]
NEWER = [f"{kind}_{axis}" for kind in ("pose", "shear") for axis in AXES]
OTHER = replace(TACTIP_331, name="other", rings=5, pin_spacing_mm=3.0, pin_radius_mm=0.8)


@cache
def picture(sensor: Sensor, seed: int) -> np.ndarray:
    """White pins on black, each moved a little."""
    flat = pin_lattice(sensor)
    flat = flat / np.linalg.norm(flat, axis=1).max()
    pins = (SIZE - 1) / 2 + 0.375 * SIZE * flat + np.random.default_rng(seed).normal(0, 0.3, flat.shape)
    row, column = np.mgrid[:SIZE, :SIZE]
    radius = 0.25 * 0.75 * SIZE / (2 * sensor.rings + 1)
    image = np.zeros((SIZE, SIZE), np.uint8)
    for x, y in pins:
        image[np.hypot(column - x, row - y) < radius] = 255
    return image


def recorded(root, sensor=TACTIP_331, slide=0.0, columns=OLDER, images="images", count=3, turn=lambda image: image):
    (root / images).mkdir(parents=True)
    lines = [",".join(["sensor_image", "pose_id", *columns])]
    for i in range(count):
        Image.fromarray(turn(picture(sensor, i))).save(root / images / f"image_{i + 1}.png")
        labels = [0, i - 1, 3 + i, 0, 0, 120 * i - 100, slide, 0, 0, 0, 0, 0]
        lines.append(",".join([f"image_{i + 1}.png", str(i), *map(str, labels[: len(columns)])]))
    (root / "targets.csv").write_text("\n".join(lines))
    return root


def works(diagnosis):
    return [use.command for use in diagnosis.uses if use.works]


@pytest.mark.parametrize(
    ("columns", "images", "count", "layout"),
    [
        (OLDER, "images", 10, "older layout (images/)"),
        (OLDER, "frames_bw", 3, "variant of the older layout (frames_bw/)"),
        (NEWER, "processed_images", 3, "newer layout (processed_images/)"),
    ],
)
def test_taps_and_slides_of_each_layout(tmp_path, columns, images, count, layout):
    root = tmp_path / "edge 2d"
    taps = recorded(root / "tap" / "train", columns=columns, images=images, count=count)
    slides = recorded(root / "shear" / "train", slide=2.0, columns=columns, images=images, count=count)
    diagnosis = examine(root)
    assert [(part.name, part.taps, part.slides, part.posed) for part in diagnosis.parts] == [
        ("shear/train", 0, count, count),
        ("tap/train", count, 0, count),
    ]
    for part in diagnosis.parts:
        assert part.layout == layout and part.size == (SIZE, SIZE)
        assert part.seen.pins.sensor == "tactip331" and part.seen.pins.sure == 1
        assert (part.seen.pins.least, part.seen.pins.most) == (331, 331)
        assert part.seen.pixels.kind == "binary" and not part.seen.pixels.negative
        named = {each.name: each for each in part.columns}
        assert list(named) == columns
        assert (named[columns[2]].low, named[columns[2]].high, named[columns[2]].unit) == (3, 2 + count, "mm")
        assert (named[columns[5]].low, named[columns[5]].high, named[columns[5]].unit) == (
            -100,
            120 * count - 220,
            "deg",
        )
        assert [each.name for each in part.columns if each.varies] == [columns[1], columns[2], columns[5]]
    assert (diagnosis.pairing.by_id, diagnosis.pairing.gap_mm, diagnosis.pairing.gap_deg) == (count, 0, 0)
    assert diagnosis.problems == diagnosis.lacks == ()
    of_many = (("unshear", root, "--out", "unsheared"), ("pose", root)) if 2 * count >= LEAST_FRAMES else ()
    assert works(diagnosis) == [
        shlex.join(["jaxunshear", *map(str, words)])
        for words in (
            ("pins", root),
            *of_many,
            ("fit", "--taps", taps, "--slides", slides),
            ("run", "experiments/recorded.py", "--recordings", root),
        )
    ]
    for command in works(diagnosis):
        _parser().parse_args(shlex.split(command)[1:])


def test_too_few_images_to_give_where_pins_stand(tmp_path):
    (unshear,) = (use for use in examine(recorded(tmp_path / "tap")).uses if " unshear " in use.command)
    assert not unshear.works and "20 contacts or more" in unshear.why_not and "--like" in unshear.why_not


def test_one_kind_alone_teaches_poses(tmp_path):
    for name, slide, lacks in (("tap", 0.0, "no slides: every known move is 0"), ("slide", 1.0, "no taps: no known")):
        root = recorded(tmp_path / name, slide=slide)
        diagnosis = examine(root)
        assert len(diagnosis.lacks) == 1 and diagnosis.lacks[0].startswith(lacks)
        assert works(diagnosis)[-2:] == [
            f"jaxunshear fit --{name}s {root}",
            f"jaxunshear run experiments/recorded.py --recordings {root}",
        ]
        (note,) = (
            line for line in text_of(diagnosis) if line.startswith("note: of taps or slides alone networks learn")
        )
        assert note.endswith("they unshear by simulated slides" if name == "tap" else "not to unshear")


def test_poses_without_moves(tmp_path):
    root = recorded(tmp_path / "set", columns=OLDER[:6])
    (fit,) = (use for use in examine(root).uses if " fit " in use.command)
    assert fit.why_not == "which contacts are taps is not known: name the folders of both yourself"
    lines = text_of(examine(root))
    assert "lacking: no moves: whether a contact is a tap or a slide is not known" in lines
    assert "  contacts: moves not known, 3 with a pose" in lines


def test_taps_and_slides_in_one_folder(tmp_path):
    root = recorded(tmp_path / "set", slide=1.0)
    file = root / "targets.csv"
    file.write_text(file.read_text().replace("-100,1.0", "-100,0.0"))
    diagnosis = examine(root)
    assert (diagnosis.parts[0].taps, diagnosis.parts[0].slides) == (1, 2)
    assert f"jaxunshear fit --taps {root} --slides {root}" in works(diagnosis)


def test_different_sensors_are_not_put_together(tmp_path):
    taps = recorded(tmp_path / "tap")
    recorded(tmp_path / "slide", TACTIP_127, slide=1.0, count=2)
    diagnosis = examine(tmp_path)
    assert works(diagnosis)[:2] == [
        f"jaxunshear pins {tmp_path / 'slide'} --sensor tactip127",
        f"jaxunshear pins {taps}",
    ]
    assert f"jaxunshear fit --taps {taps}" in works(diagnosis)
    assert f"jaxunshear run experiments/recorded.py --recordings {taps}" in works(diagnosis)
    assert (diagnosis.pairing.taps, diagnosis.pairing.slides) == (3, 0)


def test_folders_above_splits_and_those_beside_others(tmp_path):
    for split in ("csv_train", "csv_val"):
        recorded(tmp_path / "edge" / "tap" / split, count=2)
        recorded(tmp_path / "edge" / "shear" / split, slide=1.0, count=2)
    edge = tmp_path / "edge"
    both = [
        f"jaxunshear fit --taps {edge / 'tap'} --slides {edge / 'shear'}",
        f"jaxunshear run experiments/recorded.py --recordings {edge}",
    ]
    assert works(examine(edge))[-2:] == both
    recorded(tmp_path / "other", TACTIP_127, count=2)
    diagnosis = examine(tmp_path)
    assert works(diagnosis)[-2:] == both
    assert (diagnosis.pairing.taps, diagnosis.pairing.slides) == (4, 4)
    recorded(edge / "other", TACTIP_127, count=2)
    (run,) = (use for use in examine(edge).uses if " run " in use.command)
    assert run.why_not == f"{edge} holds recordings of another kind too: use `fit`"


def test_other_sensors(tmp_path):
    recorded(tmp_path / "127", TACTIP_127)
    diagnosis = examine(tmp_path / "127")
    assert diagnosis.parts[0].seen.pins.sensor == "tactip127"
    assert works(diagnosis)[0] == f"jaxunshear pins {tmp_path / '127'} --sensor tactip127"
    refused = [use for use in diagnosis.uses if not use.works]
    assert [use.command.split()[1] for use in refused] == ["unshear", "pose"]
    assert "know 331 pins" in refused[0].why_not
    recorded(tmp_path / "other", OTHER)
    diagnosis = examine(tmp_path / "other")
    assert diagnosis.parts[0].seen.pins.sensor is None
    assert diagnosis.lacks[-1].startswith("no known sensor in other: about 91 pins")
    assert works(diagnosis) == [f"jaxunshear pins {tmp_path / 'other'} --layout FILE"]


@pytest.mark.parametrize("colours", [False, True])
def test_dark_pins_on_a_light_ground(tmp_path, capsys, colours):
    def turn(image):
        turned = 255 - image
        return np.stack([turned] * 3, -1) if colours else turned

    recorded(tmp_path / "set", turn=turn)
    diagnosis = examine(tmp_path / "set")
    assert diagnosis.parts[0].seen.pixels.negative
    assert diagnosis.parts[0].seen.pins.sensor == "tactip331"
    assert "negatives in set: dark pins on a light ground; invert these images first" in diagnosis.lacks
    assert works(diagnosis) == []
    assert main(["doctor", str(tmp_path / "set")]) == 1
    assert "negatives (dark pins on a light ground)" in capsys.readouterr().out


def test_images_without_labels_and_one_image(tmp_path):
    recorded(tmp_path / "set")
    diagnosis = examine(tmp_path / "set" / "images")
    assert diagnosis.parts[0].layout == "images without a table"
    assert diagnosis.lacks == (
        f"no labels: no image's pose is known; those of these images lie above, in {tmp_path / 'set'}: "
        "examine that folder",
    )
    diagnosis = examine(tmp_path / "set" / "images" / "image_1.png")
    assert (diagnosis.parts[0].name, diagnosis.parts[0].layout) == ("image_1.png", "one image")
    assert diagnosis.images == 1
    assert works(diagnosis)[0] == f"jaxunshear pins {tmp_path / 'set' / 'images' / 'image_1.png'}"


def test_what_holds_nothing_is_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("hello")
    for path, says in ((tmp_path, "no images"), (tmp_path / "notes.txt", "no image"), (tmp_path / "a", "not exist")):
        with pytest.raises(UserError, match=says):
            examine(path)
        assert main(["doctor", str(path)]) == 2
        out, err = capsys.readouterr()
        assert out == "" and err.count("\n") == 1 and str(path) in err


def test_text_and_files(tmp_path, capsys):
    recorded(tmp_path / "set")
    out, file = tmp_path / "out", tmp_path / "found.json"
    assert main(["doctor", str(tmp_path / "set"), "--out", str(out), "--json", str(file)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:-1] == text_of(examine(tmp_path / "set"))
    assert lines[0] == f"{tmp_path / 'set'}: 3 images in 1 folder, 3 with a pose"
    assert "  labels: pose_2 = y -1 to 1 mm, pose_3 = z 3 to 5 mm, pose_6 = Rz -100 to 140 deg" in lines
    assert "  contacts: 3 taps, 0 slides, 3 with a pose" in lines
    found = json.loads(file.read_text())
    assert found == json.loads((out / "doctor.json").read_text())
    assert found["rows"][0]["seen"]["pins"]["sensor"] == "tactip331"
    assert {"command", "machine", "versions"} < found.keys()
    with Image.open(out / "doctor.png") as figure:
        assert min(figure.size) > 300


def test_results_do_not_go_among_the_recordings(tmp_path, capsys):
    recorded(tmp_path / "set")
    assert main(["doctor", str(tmp_path / "set"), "--out", str(tmp_path / "set" / "out")]) == 2
    assert "lies among the recordings" in capsys.readouterr().err
    assert not (tmp_path / "set" / "out").exists()


def test_real_recordings(real_recordings):
    (part,) = examine(real_recordings / "surface_3d_sample").parts
    assert (part.name, part.images, part.slides) == ("train", 40, 40)
    assert part.seen.pins.sensor == "tactip331" and part.seen.pins.sure == 1
    (part,) = examine(real_recordings / "raw").parts
    assert part.seen.pixels.kind == "colour" and part.seen.pins.sensor == "tactip331"
