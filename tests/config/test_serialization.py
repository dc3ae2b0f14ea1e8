"""Stored settings and sensors are read by their own version; others are refused in one line."""

import dataclasses
import json
from dataclasses import replace
from pathlib import Path

import pytest

from jaxunshear import __version__, cli
from jaxunshear.config.data import Recorded, RecordedTaps
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import override_fields, replace_field
from jaxunshear.config.load import load_experiment
from jaxunshear.config.networks import PinUnshear
from jaxunshear.config.rules import validate
from jaxunshear.config.serialization import (
    add_version,
    apply_preset,
    from_json,
    read_preset,
    to_json,
)
from jaxunshear.errors import UserError
from jaxunshear.files import read_json, write_json
from jaxunshear.run import run_stages
from jaxunshear.training.checkpoint import read_net, write_settings

ROOT = Path(__file__).parents[2]
SHIPPED = ROOT / "docs" / "results" / "calibrate_edge_2d.json"
DEMO, RECORDINGS, SWEEP = (
    ROOT / "experiments" / f"{name}.py" for name in ("demo", "recorded", "ablations/lambda_split")
)
NOW = Experiment(name="now", claim="none")
RECORDED = replace(NOW, paired=Recorded(), pose=RecordedTaps())
OTHER = rf"was written by jaxunshear 0\.2\.0, and this is {__version__}: use that version, or make"


@pytest.mark.parametrize("name", ["epochs", "claim"])
def test_settings_that_lack_one_are_refused_by_its_name(name):
    held = to_json(NOW)
    (held if name in held else held["train"]).pop(name)
    with pytest.raises(UserError, match=rf"version .*: (train\.)?{name} is missing; .*run"):
        from_json(held)


def test_settings_of_another_version_are_refused_with_its_name():
    words = ["--train.drops", "40:0.2", "--sensor", "tactip127"]
    for experiment in (NOW, override_fields(NOW, words), RECORDED):
        stored = json.loads(json.dumps(add_version(to_json(experiment))))
        assert from_json(stored) == experiment
    patch = ".".join([*__version__.split(".")[:2], "99"])
    assert from_json(to_json(NOW) | {"version": patch}) == NOW
    with pytest.raises(UserError, match=OTHER):
        from_json(to_json(NOW) | {"version": "0.2.0"})


@pytest.mark.parametrize(
    ("field", "value", "line"),
    [
        ("pins.shear_noise", 0.0, r"pins\.shear_noise = 0\.0 is no setting; files of"),
        ("train.batch", "x", r"experiment\.json: train\.batch takes an integer, not 'x'"),
    ],
)
def test_settings_that_went_or_are_of_another_type_are_refused_by_name(field, value, line):
    held, (group, name) = to_json(NOW), field.split(".")
    held[group][name] = value
    with pytest.raises(UserError, match=line):
        from_json(held)


def test_settings_of_another_kind_are_compared_with_the_nearest_one():
    recorded = to_json(RECORDED)
    del recorded["paired"]["tap_folder"]
    with pytest.raises(UserError, match=r"paired\.tap_folder is missing; .*run"):
        from_json(recorded)
    with pytest.raises(UserError, match=r"version .*: paired is no group; run"):
        from_json(to_json(NOW) | {"paired": 3})


def test_a_run_of_another_version_does_not_go_on(tmp_path):
    folder = tmp_path / NOW.name
    write_json(folder / "experiment.json", to_json(NOW) | {"version": "0.2.0"})
    (folder / "disentangled").mkdir()
    with pytest.raises(UserError, match=OTHER):
        run_stages(NOW, (), tmp_path, tmp_path, "none")
    write_json(folder / "experiment.json", to_json(NOW))
    run_stages(NOW, (), tmp_path, tmp_path, "none")
    assert read_json(folder / "experiment.json")["version"] == __version__


def test_a_training_of_another_version_is_neither_continued_nor_read(tmp_path):
    net = PinUnshear()
    training = dataclasses.asdict(NOW.train_pins)
    settings = {"kind": "pin_unshear", "net": vars(net), "training": training}
    write_settings(tmp_path, settings)
    write_settings(tmp_path, settings)
    assert read_net(tmp_path) == net
    write_json(tmp_path / "model.json", settings | {"version": "0.2.0"})
    for act in (read_net, lambda folder: write_settings(folder, settings)):
        with pytest.raises(UserError, match=OTHER):
            act(tmp_path)
    del settings["net"]["separate_encoders"]
    write_json(tmp_path / "model.json", settings)
    with pytest.raises(
        UserError, match=r"'separate_encoders' \(files of version 0\.2\.0 and earlier"
    ):
        read_net(tmp_path)


def test_sensor_camera_and_friction_are_the_calibrated_ones():
    before = replace_field(load_experiment(DEMO), "paired.camera.frame_px", 200)
    after, reported = apply_preset(before, SHIPPED), json.loads(SHIPPED.read_text())["preset"]
    spacing_mm = reported["sensor"]["pin_spacing_mm"]
    assert after.sensor.pin_spacing_mm == spacing_mm != before.sensor.pin_spacing_mm
    for data, frame in ((after.paired, 200), (after.pose, 256)):
        assert data.friction == reported["friction"]
        assert data.camera.mm_across == reported["camera"]["mm_across"]
        assert data.camera.frame_px == frame
    back = {"sensor": before.sensor, "paired": before.paired, "pose": before.pose}
    assert replace(after, **back) == before
    validate(apply_preset(load_experiment(DEMO), SHIPPED))


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("{", "not valid JSON"),
        ("[]", "holds no preset"),
        ('{"rows": []}', "holds no preset"),
        ('{"preset": {"friction": 0.3}}', r"preset\.camera is missing, preset\.sensor is missing"),
        (
            '{"preset": {"sensor": {}, "camera": {}, "friction": 0.3}}',
            r"preset\.sensor\.dome_radius_mm is missing",
        ),
    ],
)
def test_files_that_give_no_sensor_are_refused_in_one_line(tmp_path, text, reported):
    file = tmp_path / "calibration.json"
    file.write_text(text)
    with pytest.raises(UserError, match=reported) as refused:
        read_preset(file)
    assert str(file) in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (("run", DEMO, "--sensor-from", "nowhere.json"), "nowhere.json does not exist"),
        (("data", RECORDINGS, "--sensor-from", SHIPPED), "simulated touches"),
        (("data", DEMO, "--sensor-from", SHIPPED, "--sensor.rings", "40"), "--sensor.rings"),
        (("sweep", SWEEP, "--sensor-from", "nowhere.json"), "nowhere.json does not exist"),
        (("evaluate", ".", "--sensor-from", SHIPPED), "stay as they are"),
    ],
)
def test_the_command_line_refuses_what_does_not_go_together(capsys, words, reported):
    assert cli.main([str(word) for word in words]) == 2
    line = capsys.readouterr().err
    assert reported in line and line.count("\n") == 1
