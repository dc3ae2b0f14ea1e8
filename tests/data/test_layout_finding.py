"""`jaxunshear layout`: layouts of simulated sensors and drawn pads, and frames that show none."""

import json

import numpy as np
import pytest
from PIL import Image

from jaxunshear.config.sensor import TACTIP_127, TACTIP_331, Sensor, check_sensor
from jaxunshear.errors import UserError
from jaxunshear.results.layout import LayoutFile, read_layout
from jaxunshear.results.record_files import write_record
from tests.data.test_recorded_pins import SHIFTS, frames, write
from tests.helpers.commands import succeed

RECTANGULAR = Sensor(
    name="rectangular", layout="rectangular", rings=4, pin_spacing_mm=2.8, pin_radius_mm=0.7
)
WIDTH, HEIGHT = 320, 240
# of a quarter of the size: the time grows with the square of the number of specks
NOISE = np.random.default_rng(0).integers(0, 255, (4, HEIGHT // 2, WIDTH // 2), np.uint8)


def draw_pad(dark=True, columns=9, rows=7, push=0.0, hidden=(), seed=0, spacing=30):
    """Draw the grid of a pad that fills its frame, (H, W) uint8, pushed aside in one corner."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2)
    place = (grid - (np.array([columns, rows]) - 1) / 2) * spacing + [WIDTH / 2, HEIGHT / 2]
    bell = np.exp(-np.square(place - [90, 80]).sum(-1) / 60**2)
    place = place + rng.normal(0, 0.15, place.shape) + push * bell[:, None] * [1.0, 0.5]
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    near = np.zeros((HEIGHT, WIDTH))
    for number, (column, row) in enumerate(place):
        if number not in hidden:
            near = np.maximum(near, np.clip(6.5 - np.hypot(x - column, y - row), 0, 1))
    grey = 0.75 - 0.5 * near if dark else 0.15 + 0.6 * near
    shaded = grey * (0.9 + 0.1 * x / WIDTH - 0.15 * y / HEIGHT)
    return np.uint8(255 * np.clip(shaded + rng.normal(0, 0.015, grey.shape), 0, 1))


def write_pad(folder, pictures):
    folder.mkdir()
    for number, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"frame_{7 * number % 11}.png")
    return folder


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize(
    "sensor", [TACTIP_127, TACTIP_331, RECTANGULAR], ids=lambda sensor: sensor.name
)
def test_layouts_of_simulated_sensors(command, tmp_path, sensor, dark):
    """The layout is the sensor's, and pins that slid are identified by it alone."""
    file, shown = tmp_path / "mine.json", frames(sensor, [(0.0, 0.0)] * 3 + SHIFTS[1:])
    grey = 1 - shown[0] if dark else shown[0]
    write(tmp_path / "untouched", grey[:3])
    write(tmp_path / "slides", grey[3:])
    said = succeed(command, "layout", tmp_path / "untouched", "--out", file).out
    assert f"{sensor.pins} {'dark' if dark else 'light'} markers" in said
    found = read_layout(file)
    check_sensor(found)
    assert (found.name, found.pins, found.dark) == ("mine", sensor.pins, dark)
    assert 3 < 2 * len(json.loads(file.read_text())["neighbours"]) / sensor.pins < 6
    rest = ("--rest", tmp_path / "untouched", "--out", tmp_path / "out")
    succeed(command, "pins", tmp_path / "slides", "--layout", file, *rest)
    with np.load(tmp_path / "out" / "pins.npz") as stored:
        assert stored["sure"].all()
        place, motion = stored["place_px"], stored["motion_px"]
    true = shown[1]
    scale = np.ptp(place[0]) / np.ptp(true[3])
    expected = np.sort(scale * np.linalg.norm(true[3:] - true[:1], axis=-1), axis=-1)
    moved = np.sort(np.linalg.norm(motion, axis=-1), axis=-1)
    np.testing.assert_allclose(moved, expected, atol=0.8)


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_a_pad_that_fills_its_frame(command, tmp_path, dark):
    """Markers stand where they were drawn; missing ones, dust and a touch change nothing."""
    pictures = [draw_pad(dark, hidden=(5 * seed,), seed=seed) for seed in range(8)]
    pictures.append(draw_pad(dark, push=12.0))
    pictures[3][100:106, 62:68] = pictures[3][120, 160]  # a speck between markers
    folder, file = write_pad(tmp_path / "pad", pictures), tmp_path / "pad.json"
    answer = succeed(command, "layout", folder, "--out", file, "--json", tmp_path / "found.json")
    kept = json.loads((tmp_path / "found.json").read_text())
    assert (kept["frames"], kept["used"]) == (9, 8) and "versions" in kept
    assert "1 frame: something touches the sensor: frame_1.png" in answer.out
    found = np.array(read_layout(file).markers)
    grid = np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-3, 4)), -1).reshape(-1, 2)
    expected = (grid * 30 + 0.5) / HEIGHT
    np.testing.assert_allclose(found, expected, atol=0.3 / HEIGHT)
    stored = json.loads(file.read_text())
    assert stored["image_px"] == [WIDTH, HEIGHT]
    assert stored["marker_radius"] * HEIGHT == pytest.approx(6.5, abs=1)


def test_taps_give_their_mean(command, tmp_path):
    pictures = [draw_pad(push=push) for push in (0, 0, 12, -12, 9, -9, 7)]
    folder = write_pad(tmp_path / "taps", pictures)
    said = succeed(command, "layout", folder, "--out", tmp_path / "pad.json").out
    assert "63 dark markers" in said and "places are means over contacts" in said


def test_foreign_frames_are_named(command, tmp_path):
    pictures = [draw_pad(seed=seed) for seed in range(6)]
    pictures.append(draw_pad(columns=7, rows=6, spacing=36))
    folder = write_pad(tmp_path / "pad", pictures)
    said = succeed(command, "layout", folder, "--out", tmp_path / "pad.json").out
    assert "1 frame: other markers than the rest shows: frame_9.png" in said


@pytest.mark.parametrize(
    ("pictures", "said"),
    [
        ([draw_pad(True, 4, 3, seed=i, spacing=60) for i in range(4)], "20 markers, are needed"),
        ([np.full((HEIGHT, WIDTH), 90, np.uint8)] * 3, "flat grey"),
        (NOISE, "of 4 frames show the same"),
        ([draw_pad(), draw_pad()[:200]], "differ in size"),
    ],
    ids=["few markers", "flat", "noise", "two sizes"],
)
def test_frames_that_show_no_layout(command, tmp_path, pictures, said):
    folder = write_pad(tmp_path / "pad", pictures)
    answer = command("layout", folder, "--out", tmp_path / "pad.json")
    assert answer.code == 2 and said in answer.err and len(answer.err.splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == [folder]


def test_another_file_is_not_overwritten(command, tmp_path):
    folder, file = write_pad(tmp_path / "pad", [draw_pad()] * 2), tmp_path / "notes.json"
    file.write_text("mine")
    answer = command("layout", folder, "--out", file)
    assert answer.code == 2 and "is no layout" in answer.err and file.read_text() == "mine"
    file.unlink()
    for _ in range(2):  # its own is
        succeed(command, "layout", folder, "--out", file)


MARKERS = tuple((i % 5 / 10, i // 5 / 10) for i in range(25))


@pytest.mark.parametrize(
    ("markers", "said"),
    [
        (MARKERS[:19], "name at least 20"),
        (MARKERS + MARKERS[:1], "place each elsewhere"),
        ("x,y\n1,2\n", "not valid JSON"),
        ('{"schema": 1}', "lacks 'name'"),
        (None, "is no file"),
    ],
)
def test_files_that_are_no_layouts(tmp_path, markers, said):
    file = tmp_path / "pad.json"
    if isinstance(markers, str):
        file.write_text(markers)
    elif markers:
        stored = {"image_px": (64, 48), "dark": False, "marker_radius": 0.02, "neighbours": ()}
        write_record(file, LayoutFile(name="pad", markers=markers, **stored))
    with pytest.raises(UserError, match=said):
        read_layout(file)
