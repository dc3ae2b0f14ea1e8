"""Each door gives the same answer to what is not understood, and refuses before it writes."""

import csv
import io
import json
import shutil
from functools import cache, partial
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import onnxruntime
import pytest
from PIL import Image

from jaxunshear import load_model
from jaxunshear.api import Predictions, find_pins
from jaxunshear.apps.explore.explorer import make_explorer
from jaxunshear.apps.export.camera_pins import describe_camera_images
from jaxunshear.apps.export.onnx_file import build_onnx
from jaxunshear.apps.export.parts import load_exported_model
from jaxunshear.apps.robot.source_frame import SourceFrame
from jaxunshear.apps.robot.stream import Outputs, stream
from jaxunshear.config.sensor import TACTIP_127
from jaxunshear.config.serialization import RELEASED
from jaxunshear.data.reader import Reader
from jaxunshear.errors import Note, UserError
from jaxunshear.evaluation.recorded_evaluation import _select_understood
from jaxunshear.evaluation.recorded_results import RecordedTest
from jaxunshear.metrics.images import ms_ssim, mse, ssim
from jaxunshear.models import modality
from jaxunshear.perception.sensor_check import FOREIGN_REASON, invert_image
from jaxunshear.perception.touch import NO_CONTACT_REASON, Touch
from jaxunshear.simulator.pin_layout import compute_pin_lattice
from jaxunshear.simulator.scene import make_scenes
from jaxunshear.simulator.simulate import simulate
from tests.helpers.dots import draw_dots, press
from tests.helpers.image_files import png_of
from tests.inputs.cases import Case, run_each

SIZE = 128  # px, of `standard`

LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12345\n"


def list_files(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="session")
def standard():
    return load_model("standard")


@pytest.fixture
def given(command, standard, tmp_path):
    return SimpleNamespace(command=command, standard=standard, folder=tmp_path)


def refuse(answer, *words):
    """Assert that a command ended with one line that has these words."""
    assert (answer.code, answer.err.count("\n")) == (2, 1), answer.err
    for word in words:
        assert word in answer.err


def evaluate_released(name):
    def check(given):
        before = list_files(RELEASED / name)
        refuse(given.command("evaluate", name), "--recordings DIR", "released weights")
        assert list_files(RELEASED / name) == before

    return check


def copy_standard(given):
    return shutil.copytree(RELEASED / "standard", given.folder / "copy")


def evaluate_release_folder(given):
    folder = copy_standard(given)
    before = list_files(folder)
    refuse(given.command("evaluate", folder), "--recordings DIR")
    assert list_files(folder) == before


def run_into_release_folder(given):
    folder = copy_standard(given)
    before = list_files(folder)
    words = ("experiments/tiny.py", "--name", folder.name, "--out", folder.parent)
    refuse(given.command("run", *words), "released weights")
    assert list_files(folder) == before


def pose_by(change, *words):
    """Give a black image to released weights of which `change` spoilt a file."""

    def check(given):
        folder, image = copy_standard(given), given.folder / "image.png"
        Image.fromarray(np.zeros((128, 128), np.uint8)).save(image)
        change(folder / "posenet")
        refuse(given.command("pose", image, "--model", folder), str(folder / "posenet"), *words)

    return check


def edit_settings(change):
    def edit(folder):
        settings = json.loads((folder / "model.json").read_text())
        del settings["checksum"]
        change(settings)
        (folder / "model.json").write_text(json.dumps(settings))

    return edit


WIDEN = edit_settings(lambda settings: settings["net"].update(widths=[1] * 5))
FORGET = edit_settings(lambda settings: settings["targets"].pop())


def replace_weights(data):
    return lambda folder: (folder / "weights.npz").write_bytes(data)


def read_stub(data, *words):
    def check(given):
        (given.folder / "image.png").write_bytes(data)
        refuse(given.command("pose", given.folder / "image.png", "--model", "standard"), *words)

    return check


def score_images(metric, scale, words):
    """Give images times `scale` to a measure, which must refuse them; 1 is of the right range."""

    def check(given):
        a, b = np.random.default_rng(0).random((2, 1, 32, 32, 1), np.float32)
        with pytest.raises(ValueError, match=words):
            metric(scale * a, scale * b)
        assert 0 < float(metric(a, b)[0]) < 1

    return check


def ms_ssim_of_two(a, b):
    return ms_ssim(a, b, scales=2)


NO_RANGE = r"images in \[0, 1\] are needed"
WRITES = [
    Case(f"{name}, no recordings", "evaluate", "refused, untouched", evaluate_released(name))
    for name in ("standard", "skin")
] + [
    Case("a release folder", "evaluate", "refused, untouched", evaluate_release_folder),
    Case("into a release folder", "run", "refused, untouched", run_into_release_folder),
]
WEIGHTS = [
    Case("weights of other settings", "pose", "one line", pose_by(WIDEN, "do not fit")),
    Case("a target less in model.json", "pose", "one line", pose_by(FORGET, "do not fit")),
    Case("weights: LFS pointer", "pose", "is named", pose_by(replace_weights(LFS), "git lfs pull")),
    Case("weights: empty", "pose", "is named", pose_by(replace_weights(b""), "the file is empty")),
    Case("image: LFS pointer", "pose", "is named", read_stub(LFS, "git lfs pull")),
    Case("image: empty", "pose", "is named", read_stub(b"", "the file is empty")),
]
MEASURES = [
    Case("floats to 255", "ms_ssim", "refused", score_images(ms_ssim_of_two, 255, NO_RANGE)),
    Case("floats to 255", "ssim", "refused", score_images(ssim, 255, NO_RANGE)),
    Case("floats to 255", "mse", "refused", score_images(mse, 255, NO_RANGE)),
    Case("floats to -2", "mse", "refused", score_images(mse, -2, NO_RANGE)),
]


class Pictures(NamedTuple):
    """Images (S, S) uint8 of what cameras of other things show, beside a touch of the sensor."""

    sensor: np.ndarray
    foreign: dict[str, np.ndarray]


def draw_pins(rest):
    return np.uint8(255) * draw_dots(np.asarray(rest), 1.4).astype(bool)


@cache
def draw_pictures():
    pins = press(load_model("standard").rest)
    noise, sensor = np.random.default_rng(0).random((SIZE, SIZE)), draw_pins(pins)
    left, flat = np.arange(SIZE) < SIZE // 2, compute_pin_lattice(TACTIP_127)
    other = (SIZE - 1) / 2 + 0.375 * SIZE * flat / np.linalg.norm(flat, axis=-1).max()
    foreign = {
        "black": 0 * sensor,
        "white": 0 * sensor + 255,
        "noise": np.uint8(255) * (noise < 0.2),
        "dense noise": np.uint8(255) * (noise < 0.5),
        "half covered": sensor * left,
        "a sensor of 127 pins": draw_pins(other),
        "dark pins": invert_image(sensor),
        "off the middle": np.roll(sensor, 30, 1),
    }
    return Pictures(sensor, foreign)


def predict_foreign(name):
    def check(given):
        sensor, foreign = draw_pictures()
        found = given.standard.predict(np.stack([sensor, foreign[name]]))
        assert found.rejection.tolist() == ["", FOREIGN_REASON]
        assert found.confidence[0] > 0.5 and found.confidence[1] == 0
        for values in (found.unsheared, *found.poses["unsheared"].values()):
            assert np.isfinite(values[0]).all() and np.isnan(values[1]).all()

    return check


def scale_sensor(model, scale):
    """Draw a touch as a camera shows it that is nearer by `scale`."""
    pins = press(model.rest)
    return draw_pins(pins.mean(axis=0) + scale * (pins - pins.mean(axis=0)))


def lower_confidence(given):
    images = np.stack([scale_sensor(given.standard, scale) for scale in (1.0, 0.95, 1.05)])
    found = given.standard.predict(images)
    assert found.rejection.tolist() == ["", "", ""]
    assert (found.confidence[1:] < 0.75 * found.confidence[0]).all()
    camera = describe_camera_images(given.standard, None)
    familiarity = np.array([camera.read_image(image).familiarity for image in images])
    assert familiarity[0] > 0.95 and (familiarity[1:] < 0.75).all()


@cache
def open_exported(name):
    parts = load_exported_model(load_model(name))
    return onnxruntime.InferenceSession(build_onnx(parts, None, None, {}))


def run_exported(name, input_name, inputs):
    outputs = ["sure", "confidence", "pose", "unsheared"]
    return open_exported(name).run(outputs, {input_name: inputs})


def check_second_is_unsure(sure, confidence, pose, unsheared):
    assert sure.tolist() == [True, False] and confidence[0] > 0.5 and confidence[1] == 0
    for values in (pose, unsheared):
        assert np.isfinite(values[0]).all() and np.isnan(values[1]).all()


def export_foreign(name):
    def check(given):
        sensor, foreign = draw_pictures()
        shown = foreign | {"0 and 1": sensor // 255}
        images = np.stack([sensor, shown[name]])
        check_second_is_unsure(*run_exported("standard", "image", images))

    return check


def export_contacts(given):
    """The file is as sure of contacts as `predict`: slides, deep ones, pins that leave the view."""
    rest = given.standard.rest
    offset = rest - rest.mean(axis=0)
    push = np.exp(-np.square(offset).sum(-1, keepdims=True) / 400)
    across, up = np.array([[1, 0], [0, 1]])
    touched, deep = press(rest), rest + 0.12 * push * offset + 3 * push * across
    moved = (touched + 4 * across, touched - 9 * up, deep)
    images = np.stack([draw_pins(pins) for pins in (touched, *moved)])
    sure, confidence, pose, _ = run_exported("standard", "image", images)
    expected = given.standard.predict(images)
    assert sure.all() and not expected.rejection.any()
    np.testing.assert_allclose(confidence, expected.confidence, atol=0.03)
    poses = np.stack(list(expected.poses["unsheared"].values()), axis=1)
    np.testing.assert_allclose(pose, poses, atol=0.01)


def export_no_contact(given):
    """The module beside a file over images finds that there is no contact, as `predict` does."""
    camera = describe_camera_images(given.standard, None)
    touched, untouched = draw_pins(press(given.standard.rest)), draw_pins(given.standard.rest)
    assert given.standard.predict(untouched[None]).rejection[0] == NO_CONTACT_REASON
    reading = camera.read_image(untouched)
    assert reading.reason == NO_CONTACT_REASON and not reading.inputs.any()
    assert reading.touch["contact"] < 0.5
    reading = camera.read_image(touched)
    assert not reading.reason and (reading.inputs[0] == touched).all()


def export_pins(change):
    """Give the exported `skin` pins as they are, some missing, and as `change` spoils them."""

    def check(given):
        rest = load_exported_model(load_model("skin")).rest
        pins = rest + np.float32([2, 1])
        spoilt = np.float32(change(pins))
        pins[::20] = np.nan
        check_second_is_unsure(*run_exported("skin", "pins", np.stack([pins, spoilt])))

    return check


def write_pictures(folder, pictures):
    folder.mkdir()
    for number, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"image_{number}.png")
    return folder


def stream_mixed(foreign_count, code):
    """Stream two images of the sensor, and some of the others, none of one flat grey."""

    def check(given):
        sensor, foreign = draw_pictures()
        others = [foreign["noise"], foreign["half covered"]][:foreign_count]
        folder = write_pictures(given.folder / "mixed", [sensor, sensor, *others])
        answer = given.command("stream", folder, "--model", "standard")
        lines = [json.loads(line) for line in answer.out.splitlines()]
        assert answer.code == code, answer.err
        assert f"2 frames used, {foreign_count} skipped" in answer.err
        assert [line.get("error") for line in lines[2:]] == foreign_count * [FOREIGN_REASON]

    return check


def write_mixed(given):
    sensor, foreign = draw_pictures()
    pictures = [sensor, sensor, foreign["noise"], foreign["half covered"]]
    return write_pictures(given.folder / "mixed", pictures)


def check_half_is_left_out(answer, table):
    assert answer.code == 1 and f"left out 2: {FOREIGN_REASON}" in answer.out + answer.err
    rows = list(csv.DictReader(io.StringIO(table)))
    assert [row["left_out"] for row in rows] == 2 * [""] + 2 * [FOREIGN_REASON]
    for row in rows:
        numbers = [value for name, value in row.items() if name.endswith(("_mm", "_deg"))]
        assert len(numbers) >= 4 and all(bool(value) == (not row["left_out"]) for value in numbers)


def pose_mixed(given):
    answer = given.command("pose", write_mixed(given), "--model", "standard")
    check_half_is_left_out(answer, answer.out)


def unshear_mixed(given):
    out = given.folder / "out"
    answer = given.command("unshear", write_mixed(given), "--model", "standard", "--out", out)
    check_half_is_left_out(answer, (out / "poses.csv").read_text())
    assert sorted(file.name for file in out.glob("*.png")) == ["image_0.png", "image_1.png"]


def force_noise(given):
    noise = draw_pictures().foreign["noise"][None]
    found = load_model("standard", force=True).predict(noise)
    assert found.rejection.tolist() == [""] and found.confidence[0] < 0.01
    assert np.isfinite(found.unsheared).all()


def encode_noise(given):
    sensor, foreign = draw_pictures()
    pose = np.asarray(given.standard.codes(np.stack([sensor, foreign["noise"]])).pose)
    assert np.isfinite(pose[0]).all() and np.isnan(pose[1]).all()


def refuse_folder(door, name):
    def check(given):
        folder = write_pictures(given.folder / "all", 3 * [draw_pictures().foreign[name]])
        out = ("--out", given.folder / "out") if door == "unshear" else ()
        refuse(given.command(door, folder, "--model", "standard", *out), str(folder))
        assert not (given.folder / "out").exists()

    return check


@cache
def open_explorer():
    return make_explorer(load_model("standard"))


def explore_foreign(name, words):
    def check(given):
        explorer = open_explorer()
        with pytest.raises(UserError, match=words):
            explorer.infer_recording("a.png", png_of(draw_pictures().foreign[name]))
        assert not explorer.infer_recording("a.png", png_of(draw_pictures().sensor)).note

    return check


def evaluate_others(given):
    """Noise and no contact among other recordings are not scored; of a run's own all are."""
    (sensor, foreign), model = draw_pictures(), given.standard
    images = np.stack([sensor, foreign["noise"], sensor, draw_pins(model.rest)])
    check_left_out(model, modality.IMAGES, {"image": images}, [0, 2])


def evaluate_other_pins(given):
    rest = given.standard.rest
    pins = np.stack([press(rest), np.full_like(rest, np.nan), press(rest), rest])
    own = check_left_out(given.standard, modality.PINS, {"pins": pins}, [0, 2])
    assert own == [0, 2, 3]


def check_left_out(model, kind, contacts, expected):
    """Assert which other contacts are scored; return which of a run's own are."""
    reader = Reader(lambda split: contacts, SIZE)
    own = RecordedTest(None, reader, False, "same session")
    others = own._replace(data="other recordings", appearance=model.appearance)
    others = others._replace(touch=model.touch_reader)
    select = partial(_select_understood, kind, reader=reader, split="test", paired=None)
    assert select(test=others).tolist() == expected
    return select(test=own).tolist()


def prepare_as_stream(given):
    """Frames of 640 x 480 whose dome appears to move a little, as noise makes it."""
    random, rest = np.random.default_rng(0), given.standard.rest
    rows, columns = np.mgrid[:480, :640]
    frames = []
    for number in range(4):
        middle = np.array([320, 240]) + 2 * number
        pins = 2.6 * (rest - rest[0]) + middle
        disc = np.hypot(columns - middle[0], rows - middle[1]) < 170
        grey = np.where(disc, 30, 160) + random.normal(0, 3, disc.shape)
        column, row = np.round(pins).astype(int).T
        for dx, dy in np.ndindex(5, 5):
            grey[row + dy - 2, column + dx - 2] = 220
        frames.append(np.uint8(grey.clip(0, 255)))
    alone, streamed, shown = load_model("standard"), load_model("standard"), []

    def predict(images):
        shown.append(images[0])
        touch = Touch(*np.full((len(Touch._fields), 1), np.nan))
        return Predictions(None, {}, {}, np.array([FOREIGN_REASON]), np.zeros(1), lambda: touch)

    streamed.predict = predict
    source = (SourceFrame(i, str(i), frame) for i, frame in enumerate(frames))
    stream(source, False, streamed, Outputs(io.StringIO()))
    with pytest.warns(Note):
        prepared = [alone.prepare(frame) for frame in frames]
    np.testing.assert_array_equal(prepared, shown)
    assert (prepared[0] != prepared[3]).any()


def refuse_call(call, words):
    def check(given):
        with pytest.raises(UserError, match=words):
            call(given.standard)

    return check


def simulate_by_name(model):
    scenes = make_scenes(("disk",), np.zeros(1, int), np.array([[0, 0, 0, 3.0]]), np.zeros((1, 2)))
    simulate("tactip331", ("disk",), scenes)


def find_in_array(model):
    find_pins(np.zeros((64, 64)), None)


def predict_floats(model):
    model.predict(np.zeros((1, SIZE, SIZE)))


def show_model(given):
    assert len(repr(given.standard)) < 200 and "posenet" in repr(given.standard)


UNSURE = "NaN, a reason, no confidence"
SPOILT_PINS = {
    "all NaN": lambda pins: pins * np.nan,
    "infinite": lambda pins: pins * np.inf,
    "shares of the side": lambda pins: pins / SIZE,
    "motions": lambda pins: pins - pins.mean(axis=0),
    "rows first": lambda pins: pins[:, ::-1],
    "in another order": np.random.default_rng(0).permutation,
    "of images twice as large": lambda pins: 2 * pins,
    "mirrored": lambda pins: pins * [-1, 1] + [SIZE - 1, 0],
    "half missing": lambda pins: np.where(pins[:, :1] < SIZE / 2, np.nan, pins),
}
FOREIGN = (
    *("black", "white", "noise", "dense noise", "half covered", "a sensor of 127 pins"),
    *("dark pins", "off the middle"),
)
IMAGES = [
    Case("contacts", "export", "those of `predict`", export_contacts),
    Case("no contact", "export", "a reason; the image is black", export_no_contact),
    *(Case(name, "predict", UNSURE, predict_foreign(name)) for name in FOREIGN),
    *(Case(name, "export", UNSURE, export_foreign(name)) for name in (*FOREIGN, "0 and 1")),
    *(
        Case(f"pins: {name}", "export", UNSURE, export_pins(SPOILT_PINS[name]))
        for name in SPOILT_PINS
    ),
    Case("a camera 5 % nearer, or further", "predict", "less confidence", lower_confidence),
    Case("one of three is noise", "stream", "exit code 0, a count", stream_mixed(1, 0)),
    Case("half are foreign", "stream", "exit code 1, a count", stream_mixed(2, 1)),
    Case("half are foreign", "pose", "exit code 1, empty cells", pose_mixed),
    Case("half are foreign", "unshear", "exit code 1, no pictures", unshear_mixed),
    Case("noise, force", "predict", "an answer, no confidence", force_noise),
    Case("noise", "codes", "NaN", encode_noise),
    Case("a folder of noise", "unshear", "refused", refuse_folder("unshear", "noise")),
    Case("a folder of black", "unshear", "refused", refuse_folder("unshear", "black")),
    Case("a folder of halves", "pose", "refused", refuse_folder("pose", "half covered")),
    Case("another sensor", "pose", "refused", refuse_folder("pose", "a sensor of 127 pins")),
    Case("noise and no contact among contacts", "evaluate", "left out", evaluate_others),
    Case("no contact among pins of contacts", "evaluate", "left out", evaluate_other_pins),
    Case("noise", "explore", "a reason", explore_foreign("noise", "scattered")),
    Case("black", "explore", "a reason", explore_foreign("black", "flat grey")),
    Case("another sensor", "explore", "a reason", explore_foreign("a sensor of 127 pins", "127")),
]
PYTHON = [
    Case("a dome that trembles", "prepare", "the crop of `stream`", prepare_as_stream),
    Case("a model", "repr", "a line", show_model),
    Case("a name", "simulate", "is named", refuse_call(simulate_by_name, "'tactip331' is no Sens")),
    Case("an array", "find_pins", "is named", refuse_call(find_in_array, "not ndarray")),
    Case("floats", "predict", "refused", refuse_call(predict_floats, "float64")),
]
CASES = [*WRITES, *WEIGHTS, *MEASURES, *IMAGES, *PYTHON]


@run_each(CASES)
def test_answer(case, given):
    case.check(given)
