"""`--sensor-from`: what a calibration finds becomes the sensor of a simulated experiment."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from jaxunshear import cli
from jaxunshear.config.load import load_experiment
from jaxunshear.config.rules import validate
from jaxunshear.config.serialization import apply_preset, read_preset
from jaxunshear.errors import UserError

ROOT = Path(__file__).parents[2]
SHIPPED = ROOT / "docs" / "results" / "calibrate_edge_2d.json"
DEMO, RECORDED, SWEEP = (
    ROOT / "experiments" / f"{name}.py" for name in ("demo", "recorded", "ablations/lambda_split")
)


def test_sensor_camera_and_friction_are_the_calibrated_ones():
    before = load_experiment(DEMO)
    before = replace(
        before, paired=replace(before.paired, camera=replace(before.paired.camera, frame_px=200))
    )
    after, reported = apply_preset(before, SHIPPED), json.loads(SHIPPED.read_text())["preset"]
    assert (
        after.sensor.pin_spacing_mm
        == reported["sensor"]["pin_spacing_mm"]
        != before.sensor.pin_spacing_mm
    )
    for data, frame in ((after.paired, 200), (after.pose, 256)):
        assert (data.friction, data.camera.mm_across) == (
            reported["friction"],
            reported["camera"]["mm_across"],
        )
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
        (
            '{"preset": {"sensor": {}, "camera": {}, "friction": 0.3}}',
            r"preset\.sensor\.dome_radius_mm is missing",
        ),
        ('{"preset": {"friction": 0.3}}', r"preset\.camera is missing, preset\.sensor is missing"),
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
        (("run", DEMO, "--sensor-from", "nowhere.json"), "nowhere.json is no file"),
        (("data", RECORDED, "--sensor-from", SHIPPED), "simulated touches"),
        (("data", DEMO, "--sensor-from", SHIPPED, "--sensor.rings", "40"), "--sensor.rings"),
        (("sweep", SWEEP, "--sensor-from", "nowhere.json"), "nowhere.json is no file"),
        (("evaluate", ".", "--sensor-from", SHIPPED), "stay as they are"),
    ],
)
def test_the_command_line_refuses_what_does_not_go_together(capsys, words, reported):
    assert cli.main([str(word) for word in words]) == 2
    line = capsys.readouterr().err
    assert reported in line and line.count("\n") == 1
