"""Simulated recordings score nearly one; images of the calibration are not compared."""

import json
from dataclasses import asdict

import numpy as np
import pytest
from PIL import Image

from jaxunshear.calibration.prediction import DEFAULT_CALIBRATION, Calibration, read_calibration
from jaxunshear.calibration.recorded_groups import are_among, list_sampled_images, split_folders
from jaxunshear.calibration.validate import PRESET_RECORDINGS, validate
from jaxunshear.config.sensor import Camera
from jaxunshear.errors import UserError
from tests.calibration.conftest import write_recording


def _value(results, name):
    return next(row["value"] for row in results["rows"] if row["name"] == name)


@pytest.fixture(scope="module")
def scored(simulated, tmp_path_factory):
    calibration = Calibration("truth", simulated.sensor, simulated.camera, simulated.friction, ())
    out = tmp_path_factory.mktemp("out")
    return validate(simulated.folder, calibration, None, 0, out), out


def test_its_own_recording_scores_nearly_one(scored):
    results, out = scored
    assert _value(results, "r2.slide") > 0.98
    assert _value(results, "residual_px.slide") < 0.15  # of pins found in images
    assert results["left_out"] == []
    assert next(row["contacts"] for row in results["rows"] if row["name"] == "r2.slide") >= 12
    assert (out / "validate.png").read_bytes().startswith(b"\x89PNG")
    assert "r2" in (out / "validate.txt").read_text()


def test_another_friction_scores_less(scored, simulated):
    wrong = Calibration("wrong", simulated.sensor, simulated.camera, 3 * simulated.friction, ())
    results = validate(simulated.folder, wrong, None)
    assert _value(results, "r2.slide") < _value(scored[0], "r2.slide") - 0.02


def _recording(folder, count, labelled=True):
    images = np.zeros((count, 130, 130), np.uint8)
    images[:, 40:60, 40:60] = 255
    poses = np.arange(6.0 * count).reshape(count, 6)
    write_recording(folder, images, poses if labelled else None, 0 * poses if labelled else None)


def test_images_of_the_calibration_are_not_compared(tmp_path):
    _recording(tmp_path / "all" / "a", 30)
    _recording(tmp_path / "all" / "b", 9)
    used = {f"a/images/image_{i}.png" for i in range(1, 16)}
    parts, notes = split_folders(tmp_path / "all", 12, 0, used)
    a, b = parts
    assert len(a.scored.names) == 12 and len(a.align.names) == 10 and len(b.scored.names) == 6
    for part in parts:
        assert not set(part.scored.names) & (used | set(part.align.names))
    assert set(a.align.names) <= used
    assert any("15 of 30" in note for note in notes)
    again, _ = split_folders(tmp_path / "all", 12, 0, used)
    other, _ = split_folders(tmp_path / "all", 12, 1, used)
    assert again[0].scored.names == a.scored.names != other[0].scored.names
    with pytest.raises(UserError, match="compare with others"):
        split_folders(
            tmp_path / "all" / "a", None, 0, {f"images/image_{i}.png" for i in range(1, 31)}
        )


def test_names_from_higher_up_and_lower_down():
    used = ["tap/images/image_1.png"]
    names = ["edge/tap/images/image_1.png", "images/image_1.png", "tap/images/image_11.png"]
    assert are_among(names, used).tolist() == [True, True, False]
    assert not are_among(["tap/images/image_2.png", "other/images/image_1.png"], used).any()


def test_what_the_preset_was_fitted_to(tmp_path):
    for name in ("edge_2d/tap/csv_train", "edge_2d/shear/csv_train", "edge_2d/other", "new/train"):
        _recording(tmp_path / name, 3)
    used = list_sampled_images(tmp_path / "edge_2d", 9, 0, PRESET_RECORDINGS)
    assert len(used) == 6 and not any("other" in name for name in used)
    assert list_sampled_images(tmp_path / "new" / "train", 9, 0, PRESET_RECORDINGS) == ()


def test_a_calibration_is_read(tmp_path):
    preset = {
        "sensor": asdict(DEFAULT_CALIBRATION.sensor),
        "camera": asdict(Camera()),
        "friction": 0.5,
    }
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps({"preset": preset, "image_names": ["a/b.png"]}))
    calibration = read_calibration(file)
    assert calibration.sensor == DEFAULT_CALIBRATION.sensor and calibration.camera == Camera()
    assert calibration.friction == 0.5 and calibration.image_names == ("a/b.png",)
    assert calibration.values.skin_to_gel == pytest.approx(1 / 0.00702)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("validate nowhere", "nowhere"),
        ("validate {folder} --contacts -1", "--contacts -1"),
        ("validate {folder} --seed -1", "--seed -1"),
        ("validate {folder} --calibration {folder}/none.json", "none.json"),
        (
            "validate {folder} --calibration {folder}/other.json",
            "calibration.json of `jaxunshear calibrate --out`",
        ),
        ("validate {folder} --out {folder}/images", "lies among the recordings"),
        ("validate {folder}/bare", "pins are found"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(words, said, tmp_path, command):
    (tmp_path / "other.json").write_text('{"preset": {"sensor": {"colour": 1}}}')
    (tmp_path / "images").mkdir()
    (tmp_path / "bare").mkdir()
    for i in range(3):
        Image.fromarray(np.eye(130, dtype=np.uint8) * 255).save(
            tmp_path / "bare" / f"image_{i}.png"
        )
    answer = command(*words.format(folder=tmp_path).split())
    assert answer.code == 2 and said in answer.err and answer.err.strip().count("\n") == 0
