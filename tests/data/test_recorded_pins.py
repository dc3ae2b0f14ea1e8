"""`jaxunshear pins`: simulated frames with known pins, user layouts, and images that show none."""

import json

import jax
import numpy as np
import pytest
from PIL import Image

from jaxunshear.api import find_pins
from jaxunshear.config.sensor import TACTIP_127, TACTIP_331, Camera, Nuisance
from jaxunshear.files import to_builtins
from jaxunshear.perception.lattice_fitting import make_layout
from jaxunshear.results.applications import PinScores
from jaxunshear.results.record_files import SCHEMA, convert_record
from jaxunshear.simulator.camera import project, render_frame
from jaxunshear.simulator.pin_layout import compute_pin_tips
from tests.helpers.commands import succeed

CAMERA = Camera(frame_px=256)


def frames(sensor, shifts_mm):
    """Render skins that slid by these shifts, most in the middle.

    Returns grey frames (N, 256, 256) and true pins (N, P, 2) px.
    """
    tips, key = np.asarray(compute_pin_tips(sensor), np.float32), jax.random.key(0)
    bell = np.exp(-np.sum(tips[:, :2] ** 2, axis=-1) / 50)[:, None]
    moved = np.stack([tips + np.float32(bell * [*shift, 0]) for shift in shifts_mm])
    nuisance = Nuisance(drift_px=1.0)
    look = jax.jit(jax.vmap(lambda t, k: render_frame(CAMERA, sensor, nuisance, t, k)))
    grey = look(moved, jax.random.split(key, len(moved)))
    return np.asarray(grey), np.asarray(project(CAMERA, moved, sensor))


def write(folder, grey):
    folder.mkdir()
    for number, image in enumerate(grey):
        Image.fromarray(np.round(255 * image).astype(np.uint8)).save(folder / f"image_{number}.png")


SHIFTS = [(0.0, 0.0), (1.5, 0.0), (0.0, 2.0), (-1.2, -1.0), (0.5, 0.5)]


@pytest.mark.parametrize("sensor", [TACTIP_331, TACTIP_127], ids=lambda sensor: sensor.name)
def test_pins_of_simulated_frames(command, tmp_path, sensor):
    grey, true = frames(sensor, SHIFTS)
    write(tmp_path / "images", grey)
    write(tmp_path / "rest", frames(sensor, [(0.0, 0.0)])[0])
    words = ("--sensor", sensor.name, "--rest", tmp_path / "rest", "--out", tmp_path / "out")
    answer = succeed(command, "pins", tmp_path / "images", *words)
    held = json.loads((tmp_path / "out" / "pins.json").read_text())
    rows = held["rows"]
    assert to_builtins(convert_record(held, PinScores, "pins.json", "run it again").rows) == rows
    assert held["schema"] == SCHEMA
    assert [(row["name"], row["matched"], row["sure"]) for row in rows] == [
        (f"image_{n}.png", sensor.pins, True) for n in range(len(SHIFTS))
    ]
    with np.load(tmp_path / "out" / "pins.npz") as stored:
        motion, place = stored["motion_px"], stored["place_px"]
    # pins have the identities of the simulator or of the lattice's symmetry, in another crop: so
    # the farthest motions must agree
    scale = np.ptp(place[0]) / np.ptp(true[0])
    expected = np.sort(scale * np.linalg.norm(true - true[:1], axis=-1), axis=-1)
    found = np.sort(np.linalg.norm(motion, axis=-1), axis=-1)
    np.testing.assert_allclose(found, expected, atol=0.8)
    assert Image.open(tmp_path / "out" / "pins.png").size[0] > 400
    assert f"{len(SHIFTS)} with every pin's identity sure" in answer.out


def test_from_python_as_arrays(tmp_path):
    grey, true = frames(TACTIP_127, SHIFTS)
    write(tmp_path / "images", [*grey, np.random.default_rng(0).random((256, 256))])
    found = find_pins(tmp_path / "images", make_layout(TACTIP_127))
    assert found.sure.tolist() == [True] * len(SHIFTS) + [False] and found.name[0] == "image_0.png"
    assert found.motion_px.shape == (len(SHIFTS) + 1, 127, 2)
    assert np.isnan(found.motion_px[-1]).all()
    # from the mean place in these images
    np.testing.assert_allclose(found.motion_px[:-1].mean(axis=0), 0, atol=0.8)
    assert found.table.image_px == 256
    assert [row.matched for row in found.table.rows] == [127] * len(SHIFTS) + [0]
    assert sorted(tmp_path.iterdir()) == [tmp_path / "images"]  # nothing is written


def test_frames_that_show_no_pins_are_reported_not_guessed(command, tmp_path):
    grey, _ = frames(TACTIP_331, SHIFTS)
    half = grey[1].copy()
    half[:, 128:] = 0.03
    write(tmp_path / "images", [*grey, half, np.random.default_rng(0).random((256, 256))])
    answer = succeed(command, "pins", tmp_path / "images", "--out", tmp_path / "out")
    rows = json.loads((tmp_path / "out" / "pins.json").read_text())["rows"]
    assert [row["matched"] for row in rows] == [331] * 5 + [0, 0]
    with np.load(tmp_path / "out" / "pins.npz") as stored:
        assert np.isnan(stored["place_px"][5:]).all() and not np.isnan(stored["place_px"][:5]).any()
    assert "not matched: image_5.png, image_6.png" in answer.out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--sensor", "tactip999"), "tactip999"),
        (("--size", "5"), "--size 5"),
        (("--rest", "NOWHERE"), "does not exist"),
        (("--sensor", "tactip127"), "331 pins are found"),
    ],
)
def test_refusals(command, tmp_path, words, said):
    write(tmp_path / "images", frames(TACTIP_331, SHIFTS[:1])[0])
    answer = command("pins", tmp_path / "images", "--out", tmp_path / "out", *words)
    assert answer.code == 2 and said in answer.err and len(answer.err.splitlines()) <= 3
    assert not (tmp_path / "out" / "pins.json").exists()
