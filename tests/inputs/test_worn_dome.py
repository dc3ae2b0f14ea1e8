"""Frames of domes that have lost pins, carry dust, or are badly lit."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from jaxunshear.config.sensor import TACTIP_127, TACTIP_331, Preprocess, Sensor
from jaxunshear.data.recorded_pins import Pins, find_pins
from jaxunshear.data.recordings import read_recordings
from jaxunshear.data.sensor_frame import find_recordings_frame, read_frames
from jaxunshear.doctor import check_recordings
from jaxunshear.errors import UserError
from jaxunshear.inference.infer import adapt_to_dome
from jaxunshear.inference.trained_model import load_model
from jaxunshear.perception.grey import explain_exposure
from jaxunshear.perception.lattice import Lattice, compute_rings, make_lattice
from jaxunshear.perception.lattice_fitting import make_layout
from jaxunshear.perception.pin_detection import detect_pins
from jaxunshear.perception.pin_track import PinTrack
from jaxunshear.perception.pin_tracking import track_images, track_pins
from jaxunshear.perception.worn_dome import find_lost_pins, track_worn_pins
from jaxunshear.simulator.pin_layout import compute_pin_lattice
from tests.inputs.cases import Case, list_cases, run_each

SIZE, FRAMES = 128, 12
INNER, RIM = 60, 320  # pins of TACTIP_331


class Place(NamedTuple):
    """What a row is given."""

    folder: Path
    command: Callable


@cache
def make_rest(sensor: Sensor) -> Lattice:
    flat = compute_pin_lattice(sensor)
    rest = (SIZE - 1) / 2 + 46 * flat / np.linalg.norm(flat, axis=1).max()
    return make_lattice(rest, compute_rings(sensor))


def press(sensor: Sensor, number: int) -> np.ndarray:
    """Return pins px of a contact: some move by half a spacing, towards one place and aside."""
    rest, generator = make_rest(sensor), np.random.default_rng(number)
    middle = (SIZE - 1) / 2 + generator.uniform(-15, 15, 2)
    bell = np.exp(-np.sum((rest.rest - middle) ** 2, axis=-1, keepdims=True) / 400)
    return rest.rest + bell * (0.06 * (rest.rest - middle) + generator.uniform(-2.5, 2.5, 2))


def draw(pins: np.ndarray, radius: float = 1.45) -> np.ndarray:
    image = np.zeros((SIZE, SIZE), np.uint8)
    row, column = np.mgrid[-3:4, -3:4]
    for x, y in pins:
        left, top = round(x), round(y)
        disc = np.hypot(column + left - x, row + top - y) <= radius
        image[top - 3 : top + 4, left - 3 : left + 4] |= disc.astype(np.uint8) * np.uint8(255)
    return image


def draw_worn(
    sensor: Sensor = TACTIP_331, lost: tuple = (), dust: tuple = (), number: int = 0
) -> np.ndarray:
    """Draw a contact without the pins `lost`, and with dots of dust at (x, y) px."""
    pins = np.delete(press(sensor, number), list(lost), axis=0)
    radius = 1.45 if sensor == TACTIP_331 else 2.4
    return draw(np.concatenate([pins, np.array(dust).reshape(-1, 2)]), radius)


def choose_lost(share: float, seed: int = 0, pins: int = 331) -> tuple[int, ...]:
    return tuple(np.random.default_rng(seed).choice(pins, round(share * pins), False).tolist())


def scatter_dust(count: int) -> tuple:
    generator = np.random.default_rng(5)
    angle, away = generator.uniform(0, 2 * np.pi, count), 44 * generator.uniform(size=count) ** 0.5
    return tuple(zip(63.5 + away * np.cos(angle), 63.5 + away * np.sin(angle), strict=True))


def track_alone(image: np.ndarray, lattice: Lattice) -> PinTrack:
    detected = detect_pins(image)
    return track_worn_pins(lattice, detected, track_pins(lattice, detected))


def assert_right(track: PinTrack, sensor: Sensor, lost: tuple, number: int = 0) -> None:
    """No pin stands where another one does, and no lost one was made up off its place."""
    lattice = make_rest(sensor)
    assert track.identified
    error = np.linalg.norm(lattice.rest + track.motion - press(sensor, number), axis=-1)
    assert np.nanmax(error) < 0.3 * lattice.spacing
    assert np.isnan(error).sum() <= len(lost) + 0.03 * len(error)


def sees(sensor: Sensor, lost: tuple, dust: tuple = ()) -> Callable[[Place], None]:
    """One image by itself is sure, and right."""

    def check(place: Place) -> None:
        for number in range(3):
            image = draw_worn(sensor, lost, dust, number)
            assert_right(track_alone(image, make_rest(sensor)), sensor, lost, number)

    return check


def refuses(image: Callable[[], np.ndarray]) -> Callable[[Place], None]:
    def check(place: Place) -> None:
        assert not track_alone(image(), make_rest(TACTIP_331)).identified

    return check


def save(folder: Path, change: Callable = lambda image: image, **worn) -> Path:
    folder.mkdir(parents=True)
    for number in range(FRAMES):
        image = change(draw_worn(number=number, **worn))
        Image.fromarray(image).save(folder / f"image_{number}.png")
    return folder


def find(place: Place, without: tuple = (), **worn) -> Pins:
    folder = save(place.folder / "frames", **worn)
    return find_pins(folder, make_layout(worn.get("sensor", TACTIP_331)), without=without)


def finds_lost(share: float, dust: int = 0) -> Callable[[Place], None]:
    """A folder shows which pins are lost; their places are left out of each image."""

    def check(place: Place) -> None:
        lost = choose_lost(share)
        found = find(place, lost=lost, dust=scatter_dust(dust))
        assert set(found.lattice.lost) == set(lost)
        assert found.sure.mean() >= 0.95
        assert np.isnan(found.motion_px[:, list(lost)]).all()
        numbers = [int(name.split("_")[-1].split(".")[0]) for name in found.name]
        for pins, number in zip(
            found.place_px[found.sure], np.array(numbers)[found.sure], strict=True
        ):
            error = np.linalg.norm(pins - press(TACTIP_331, number), axis=-1)
            assert np.nanquantile(error, 0.98) < 1
            assert np.nanmax(error) < 0.55 * found.lattice.spacing  # where dust covers a pin

    return check


def names_lost(place: Place) -> None:
    found = find(place, without=(INNER,))
    assert found.lattice.lost == (INNER,) and found.sure.all()
    assert np.isnan(found.motion_px[:, INNER]).all()
    assert np.isfinite(found.motion_px[:, INNER + 1]).all()


def fills_lost(place: Place) -> None:
    """Networks take the motion of a lost pin from its neighbours."""
    rest = make_rest(TACTIP_331)
    lattice = make_lattice(rest.rest, rest.ring, (INNER, RIM))
    motion, identified = track_images(lattice, [draw_worn(lost=(INNER, RIM))], independent=True)
    assert identified.all() and np.isnan(motion[0, [INNER, RIM]]).all()
    filled = lattice.fill_holes(motion[0])
    error = np.linalg.norm(rest.rest + filled - press(TACTIP_331, 0), axis=-1)
    assert error[[INNER, RIM]].max() < 0.5


def keeps_hidden(place: Place) -> None:
    motion = np.zeros((331, 2))
    motion[RIM] = np.nan
    assert np.isnan(make_rest(TACTIP_331).fill_holes(motion)[RIM]).all()


def leaves_sound_dome(place: Place) -> None:
    rest = make_rest(TACTIP_331)
    detected = [detect_pins(draw_worn(number=number)) for number in range(10)]
    tracks = [track_pins(rest, each) for each in detected]
    assert find_lost_pins(tracks) == []
    for each, track in zip(detected, tracks, strict=True):
        assert track_worn_pins(rest, each, track) is track


def ends_with_2(
    message: str, without: str, change: Callable = lambda image: image
) -> Callable[[Place], None]:
    def check(place: Place) -> None:
        folder = save(place.folder / "frames", change)
        words = ("--without", without) if without else ()
        answer = place.command("pins", folder, *words, "--out", place.folder / "out")
        assert answer.code == 2 and message in answer.err.splitlines()[-1]
        assert not (place.folder / "out").exists()

    return check


def says(reason: str, change: Callable) -> Callable[[Place], None]:
    """The doctor names no command, and the reason."""

    def check(place: Place) -> None:
        diagnosis = check_recordings(save(place.folder / "frames", change))
        assert diagnosis.next == "" and not diagnosis.usable
        assert reason in diagnosis.note

    return check


def scale(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    """Make a grey frame, soft as a camera's, and scale its light."""

    def change(image: np.ndarray) -> np.ndarray:
        soft = ndimage.gaussian_filter(image.astype(float), 0.6)
        return np.clip(10 + factor * (20 + soft), 0, 255).astype(np.uint8)

    return change


def hide(grey: float) -> Callable[[np.ndarray], np.ndarray]:
    """Make a frame of nearly one grey, in whose noise pins cannot be seen."""

    def change(image: np.ndarray) -> np.ndarray:
        noise = np.random.default_rng(int(image.sum())).normal(0, 4, image.shape)
        return np.clip(grey + scale(0.05)(image) + noise, 0, 255).astype(np.uint8)

    return change


def dim(contrast: float, light: float) -> Callable[[np.ndarray], np.ndarray]:
    """Make a frame of usual light, and take contrast from it towards a grey `light`."""

    def change(image: np.ndarray) -> np.ndarray:
        usual = scale(0.7)(image).astype(float)
        return np.round(contrast * usual + (1 - contrast) * light).astype(np.uint8)

    return change


def blur(image: np.ndarray) -> np.ndarray:
    soft = ndimage.gaussian_filter(image.astype(float), 5)
    return (200 * soft / soft.max() + 30).astype(np.uint8)


def is_named(reason: str, change: Callable, count: int = 20) -> Callable[[Place], None]:
    """Weights that read a folder's frames name the reason."""

    def check(place: Place) -> None:
        folder = place.folder / "frames"
        folder.mkdir()
        for number in range(count):
            Image.fromarray(change(draw_worn(number=number))).save(folder / f"image_{number}.png")
        with pytest.raises(UserError, match=reason):
            find_recordings_frame(read_recordings(folder, Preprocess()), Preprocess(), TACTIP_331)

    return check


def show_tacpad(image: np.ndarray) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(40, 88, 4), np.linspace(40, 88, 3))
    return draw([*np.stack([x.ravel(), y.ravel()], -1).tolist(), [64, 100]], 3.0)


def scramble(image: np.ndarray) -> np.ndarray:
    """Dots without order, as many as pins."""
    place = np.stack(np.meshgrid(np.arange(18), np.arange(18)), -1).reshape(-1, 2) * 5.0 + 20
    return draw(place + np.random.default_rng(int(image.sum())).uniform(-1.2, 1.2, place.shape))


def is_advised(change: Callable, command: str) -> Callable[[Place], None]:
    def check(place: Place) -> None:
        diagnosis = check_recordings(save(place.folder / "frames", change))
        assert command in diagnosis.next and not diagnosis.rows[0].pins.inverted

    return check


def asks_for_layout(place: Place) -> None:
    """Dark pins are known by a layout file alone."""
    diagnosis = check_recordings(save(place.folder / "frames", lambda image: 255 - image))
    assert diagnosis.next.startswith("jaxunshear layout") and "dark on a light" in diagnosis.note


def turn(image: np.ndarray) -> np.ndarray:
    return np.rot90(image).copy()


def explains_nothing(place: Place) -> None:
    assert explain_exposure(draw_worn() / np.float32(255)) == ""


def leaves_out_of_model(place: Place) -> None:
    """Networks over pins miss a pin that is named, and learn the rest of the untouched dome."""
    folder = place.folder / "frames"
    folder.mkdir()
    for number in range(20):
        Image.fromarray(draw_worn(number=number)).save(folder / f"image_{number}.png")
    model = load_model("skin", like=folder)
    adapt_to_dome(model, folder, (INNER,))
    pins = model.reader.read(read_frames(folder, model.preprocess, model.view)).pins
    assert np.isnan(pins[:, INNER]).all() and np.isfinite(np.delete(pins, INNER, axis=1)).all()
    learnt, before = model.touch_reader.gauge.lattice.rest, model.frame.rest
    np.testing.assert_allclose(np.delete(learnt - before, INNER, axis=0), 0, atol=0.6)


def refuses_number(place: Place) -> None:
    with pytest.raises(UserError, match="--without 331: pins have numbers from 0 to 330"):
        find(place, without=(331,))


CASES = [
    Case("no pin lost", "track", "as usual, to the bit", leaves_sound_dome),
    *list_cases(
        *("track", "sure and right", sees),
        [
            ("one inner pin lost", TACTIP_331, (INNER,)),
            ("one pin of the rim lost", TACTIP_331, (RIM,)),
            ("three pins lost", TACTIP_331, (3, INNER, 200)),
            ("2 % lost", TACTIP_331, choose_lost(0.02)),
            ("5 % lost", TACTIP_331, choose_lost(0.05)),
            ("5 % lost, 2 % dust", TACTIP_331, choose_lost(0.05), scatter_dust(7)),
            ("2 % dust", TACTIP_331, (), scatter_dust(7)),
            ("127 pins, 5 % lost", TACTIP_127, choose_lost(0.05, 1, 127)),
            ("one of 127 pins lost", TACTIP_127, (30,)),
        ],
    ),
    Case("a third lost", "track", "not sure", refuses(lambda: draw_worn(lost=choose_lost(0.33)))),
    Case("a region lost", "track", "not sure", refuses(lambda: draw_worn(lost=range(1, 37)))),
    Case("dots without order", "track", "not sure", refuses(lambda: scramble(draw_worn()))),
    Case("2 % lost in all frames", "find_pins", "found, 95 % sure, none wrong", finds_lost(0.02)),
    Case("5 % lost, 2 % dust", "find_pins", "found, 95 % sure, none wrong", finds_lost(0.05, 7)),
    Case("a pin named as lost", "find_pins", "it has no place, others have", names_lost),
    Case("a number that no pin has", "find_pins", "error: numbers 0 to 330", refuses_number),
    *list_cases(
        *("pins", "exit code 2, one line", ends_with_2),
        [
            ("--without no number", "--without twelve: give numbers of pins", "twelve"),
            ("--without a pin that is not there", "--without 400: pins have numbers", "400"),
            ("dark frames", "too dark", "", hide(0)),
        ],
    ),
    Case("a pin named as lost", "networks over pins", "it is missing", leaves_out_of_model),
    Case("lost pins", "networks", "filled from their neighbours", fills_lost),
    Case("a pin behind the housing", "networks", "not filled", keeps_hidden),
    *(
        Case(f"{share} of the contrast, {kind}", "doctor", "a command", is_advised(change, "pins"))
        for share, contrast in (("half", 1 / 2), ("a third", 1 / 3), ("a fifth", 1 / 5))
        for kind, change in (("dark", dim(contrast, 0)), ("light", dim(contrast, 255)))
    ),
    *list_cases(
        *("doctor", "the reason", says),
        [
            ("dark frames", "too dark", hide(0)),
            ("grey frames", "too little contrast", hide(200)),
            ("overexposed frames", "overexposed", scale(9.0)),
            ("blurred frames", "blurred", blur),
            ("a sensor of 13 pins", "about 13 pins", show_tacpad),
        ],
    ),
    Case("dark frames", "unshear", "error: too dark", is_named("too dark", hide(0))),
    Case("blurred frames", "unshear", "error: blurred", is_named("blurred", blur)),
    Case("frames at an angle of 90 deg", "doctor", "a command", is_advised(turn, "pins")),
    Case("soft frames in usual light", "doctor", "a command", is_advised(scale(0.7), "pins")),
    Case("a binary frame", "explain_exposure", "nothing is wrong", explains_nothing),
    Case("dark pins", "doctor", "a layout", asks_for_layout),
]


@run_each(CASES)
def test_worn_dome(case, tmp_path, command):
    case.check(Place(tmp_path, command))
