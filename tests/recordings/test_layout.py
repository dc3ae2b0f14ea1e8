"""Run every command of docs/layouts.md on a rectangular pad with dark markers."""

import importlib
import json
import re
import shlex

import made
import numpy as np
import pytest
from conftest import ROOT, SHORT
from PIL import Image

from jaxunshear.config.sensor import MarkerSensor, Sensor
from jaxunshear.data.recordings import read_image
from jaxunshear.files import read_object
from jaxunshear.inference.trained_model import load_model
from tests.helpers.commands import succeed

PAGE = (ROOT / "docs" / "layouts.md").read_text()
PAD = Sensor(name="pad", layout="rectangular", rings=4, pin_spacing_mm=2.8, pin_radius_mm=0.7)
TINY = (*SHORT[2:3], "2", *SHORT[4:], "--paired.validation", "0.2", "--pins.layers", "1")


def write_pad(folder, pose, move):
    made.write(folder, pose, move, "older", PAD)
    for file in folder.rglob("*.png"):
        Image.fromarray(np.uint8(200 - 0.6 * np.array(Image.open(file)))).save(file)


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """A folder as the page has it."""
    place = tmp_path_factory.mktemp("pad")
    write_pad(place / "recordings" / "untouched", np.zeros((4, 6)), np.zeros((4, 6)))
    for name, slid in (("tap", False), ("shear", True)):
        pose, move = made.contacts(60, slid, int(slid))
        pose[:, 2] /= 2  # few markers show less of a deep contact than many pins
        write_pad(place / "recordings" / "pad" / name / "csv_train", pose, move / 2)
    return place


def run_page(command, words):
    """Run the commands of the page that begin with one of `words`, and return their answers."""
    lines = re.findall(r"^ {4}jaxunshear (.*)$", PAGE, re.MULTILINE)
    chosen = [shlex.split(line) for line in lines if line.split()[0] in words]
    assert [each[0] for each in chosen] == list(words)
    return [succeed(command, *each, *(TINY if each[0] == "fit" else ())) for each in chosen]


def test_commands_of_the_page(command, laboratory, monkeypatch):
    """After `fit` the layout file is gone, and nothing needs it."""
    monkeypatch.chdir(laboratory)
    layout, doctor, pins, _ = run_page(command, ("layout", "doctor", "pins", "fit"))
    assert f"{PAD.pins} dark markers" in layout.out
    assert "layout of pad; followed in 100%" in doctor.out
    folders = "--taps recordings/pad/tap/csv_train --slides recordings/pad/shear/csv_train"
    assert f"fit {folders} --layout pad.json" in doctor.out
    assert (
        f"60 with every pin's identity sure (100.0 %), 60 of them with all {PAD.pins}" in pins.out
    )
    names: dict = {}
    exec(re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)[1], names)
    assert names["experiment"].sensor.pins == PAD.pins
    (laboratory / "pad.json").unlink()
    model = load_model("runs/pad")
    assert isinstance(model.sensor, MarkerSensor) and model.sensor.dark
    unshear, pose, stream, _ = run_page(command, ("unshear", "pose", "stream", "export"))
    rows = [line.split(",") for line in pose.out.splitlines()]
    left_out, contact = rows[0].index("left_out"), rows[0].index("contact")
    assert len(rows) == 61 and not any(row[left_out] or row[contact] for row in rows[1:])
    assert len(list((laboratory / "unsheared").rglob("*.png"))) == 60
    lines = [json.loads(line) for line in (laboratory / "poses.jsonl").read_text().splitlines()]
    assert len(lines) == 60 and all(line["pose"] for line in lines)
    assert set(lines[0]["touch"]) == {"divergence", "curl"}
    assert "60 frames used, 0 skipped" in stream.err


def test_the_exported_module_finds_dark_markers(laboratory, monkeypatch):
    """It reads the pins that the model reads, without the package's layout file."""
    monkeypatch.chdir(laboratory)
    monkeypatch.syspath_prepend(laboratory)
    module = importlib.import_module("pad_pins")
    frame = read_image(next((laboratory / "recordings" / "pad").rglob("image_7.png")))
    reading, model = module.CAMERA.read(frame), load_model("runs/pad")
    expected = model.reader.read(model.prepare(frame)[None])
    assert not reading.reason and set(reading.touch) == {"divergence", "curl"}
    np.testing.assert_allclose(reading.inputs, expected.values, atol=1e-3)


def test_frames_of_another_layout_are_refused(command, laboratory, tmp_path):
    other = Sensor(name="other", layout="rectangular", rings=3, pin_spacing_mm=3.5)
    made.write(tmp_path / "other", *made.contacts(6, False, 5), "older", other)
    answer = command("pose", tmp_path / "other", "--model", laboratory / "runs" / "pad")
    assert answer.code == 2 and len(answer.err.splitlines()) == 1
    stored = read_object(laboratory / "runs" / "pad" / "experiment.json")["sensor"]
    assert len(stored["markers"]) == PAD.pins


def test_frames_are_inverted_in_an_exported_file(laboratory, monkeypatch):
    """The graph of ONNX prepares dark markers as `prepare_frame` does."""
    onnxruntime = pytest.importorskip("onnxruntime")
    from onnx import TensorProto

    from jaxunshear.apps.export import onnx_graph

    monkeypatch.chdir(laboratory)
    model = load_model("runs/pad")
    frames = laboratory / "recordings" / "pad" / "tap"
    camera = onnx_graph.read_camera(frames, model.preprocess, model.view)
    graph = onnx_graph.OnnxGraph()
    white = onnx_graph.add_preprocessing(graph, camera, "frame")
    shape = ("batch", *camera.frames.shape[1:])
    size = model.preprocess.size
    image = onnx_graph.add_uint8_cast(graph, white)
    graph.add_output("image", image, ("batch", size, size), TensorProto.UINT8)
    data = graph.build("frame", shape, TensorProto.UINT8, {}).SerializeToString()
    (images,) = onnxruntime.InferenceSession(data).run(["image"], {"frame": camera.frames})
    np.testing.assert_array_equal(images, onnx_graph.preprocess_frames(camera, camera.frames))
