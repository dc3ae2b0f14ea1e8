"""Known sensors are recovered from images; anything else is reported or refused."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from jaxunshear.calibration.calibrate import calibrate
from jaxunshear.calibration.recorded_groups import RecordedImages
from jaxunshear.config.sensor import Camera, Sensor
from jaxunshear.errors import UserError
from jaxunshear.simulator.camera import compute_outer_fraction
from tests.calibration.conftest import GUESS, SMALL, SURFACE_MM, write_recording


@pytest.fixture(scope="module")
def results(simulated, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    return calibrate(
        simulated.folder, out, SMALL, GUESS, fixed=("pin_spacing_mm", "distance_mm")
    ), out


def _parameters(results):
    return {row["name"]: row for row in results["parameters"]}


def test_known_values_are_found(results, simulated):
    parameters = _parameters(results[0])
    assert parameters["mm_across"]["after"] == pytest.approx(simulated.camera.mm_across, rel=0.01)
    assert parameters["pin_radius_mm"]["after"] == pytest.approx(
        simulated.sensor.pin_radius_mm, rel=0.05
    )
    assert parameters["friction"]["after"] == pytest.approx(simulated.friction, abs=0.05)
    preset, camera = results[0]["preset"], simulated.camera
    # a ratio to the outermost pins, whose position is fitted, too
    edge = preset["camera"]["housing"] * compute_outer_fraction(
        Camera(**preset["camera"]), Sensor(**preset["sensor"])
    )
    assert edge == pytest.approx(
        camera.housing * compute_outer_fraction(camera, simulated.sensor), rel=0.005
    )
    for name in ("mm_across", "friction", "skin_to_gel"):
        assert parameters[name]["determined"], name
    surface = next(note for note in results[0]["notes"] if "contact begins" in note)
    least, most = (float(word) for word in surface.split() if word.replace(".", "").isdigit())
    assert least - 0.1 < SURFACE_MM < most + 0.1


def test_after_is_nearer_than_before(results):
    assert results[0]["ring_error_px"]["after"] < 0.25 * results[0]["ring_error_px"]["before"]
    rows = {row["name"]: row for row in results[0]["rows"]}
    for name in (
        "pin spacing",
        "pin diameter",
        "white share of pins",
        "outermost ring, share of width",
    ):
        row = rows[name]
        assert abs(row["after"] - row["real"]) < 0.5 * abs(row["before"] - row["real"]), name
        assert row["after"] == pytest.approx(row["real"], rel=0.02), name
    lag = rows["central pins left behind, slide 0 to 1 mm"]
    assert lag["images"] > 3 and lag["after"] == pytest.approx(lag["real"], abs=0.1 * lag["real"])


def test_files(results):
    measured, out = results
    written = json.loads((out / "calibration.json").read_text())
    assert written["preset"]["friction"] == pytest.approx(measured["preset"]["friction"])
    # for `validate`, which leaves them out
    assert sorted(written["image_names"]) == sorted(f"images/image_{i}.png" for i in range(1, 37))
    assert (out / "calibration.png").read_bytes().startswith(b"\x89PNG")
    assert "friction" in (out / "calibration.txt").read_text()


def test_what_is_no_recording_is_refused(tmp_path, simulated):
    with pytest.raises(UserError, match="does not exist"):
        calibrate(tmp_path / "none")
    few = np.zeros((3, 128, 128), np.uint8)
    few[:, 30:100:10, 30:100:10] = few[:, 31:100:10, 30:100:10] = few[:, 30:100:10, 31:100:10] = 255
    write_recording(tmp_path / "few", few, None, None)
    with pytest.raises(UserError, match="49 pins are found"):
        calibrate(tmp_path / "few")
    with pytest.raises(UserError, match="cannot be held"):
        calibrate(tmp_path / "few", fixed=("colour",))
    shutil.copytree(simulated.folder / "images", tmp_path / "bare" / "images")
    with pytest.raises(UserError, match="0 contacts are labelled"):
        calibrate(tmp_path / "bare", None, SMALL, GUESS, images=3)


def test_an_image_whose_slide_cannot_be_read_is_no_tap():
    moves = np.ones((20, 6))
    moves[4] = np.nan
    part = RecordedImages(
        "one", np.zeros((20, 128, 128), np.uint8), np.arange(120.0).reshape(20, 6), moves
    )
    np.testing.assert_array_equal(part.labelled_rows, np.arange(20) != 4)
    # no move is known, so it is not known which images are taps
    unmoved = replace(part, moves=np.full((20, 6), np.nan))
    assert unmoved.labelled_rows.all()


def test_what_was_held_is_not_called_undetermined(results):
    held = _parameters(results[0])["pin_spacing_mm"]
    assert held["held"] and held["after"] == held["before"] and held["low"] is None
    lines = (results[1] / "calibration.txt").read_text().splitlines()
    line = next(line for line in lines if "pin_spacing_mm" in line)
    assert "held" in line and "not determined" not in line
