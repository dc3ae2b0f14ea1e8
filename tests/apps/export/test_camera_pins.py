"""The module beside a file over pins gives what the model gives, without JAX and this package."""

import ast
import dataclasses
import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from jaxunshear import load_model
from jaxunshear.apps.export import camera_pins, package_source
from jaxunshear.apps.export.package_source import collect_source
from jaxunshear.apps.export.parts import load_exported_model
from jaxunshear.cli import main
from jaxunshear.perception.preprocess import View
from jaxunshear.perception.touch import Touch
from tests.helpers.robots import CONTACTS, make_frames, run_robot


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder, contacts = tmp_path_factory.mktemp("robot"), tmp_path_factory.mktemp("contacts")
    frames = make_frames(load_model("skin"))
    for number, frame in enumerate(frames[:CONTACTS]):
        Image.fromarray(frame).save(contacts / f"{number:02d}.png")
    np.save(folder / "frames.npy", frames)
    out = folder / "touch.onnx"
    assert main(["export", "skin", "--like", str(contacts), "--out", str(out)]) == 0
    lines = run_robot(folder).splitlines()
    model = load_model("skin", like=contacts)
    images = np.stack([model.prepare(frame) for frame in frames])
    return SimpleNamespace(
        read=np.load(folder / "read.npz"),
        lines=[json.loads(line) for line in lines],
        imports=ast.parse((folder / "touch_pins.py").read_text()).body,
        contacts=contacts,
        frames=frames,
        model=model,
        images=images,
        predictions=model.predict(images),
    )


def test_the_module_imports_what_it_says(exported):
    words = {node.module for node in exported.imports if isinstance(node, ast.ImportFrom)}
    words |= {node.names[0].name for node in exported.imports if isinstance(node, ast.Import)}
    packages = {word.partition(".")[0] for word in words} - sys.stdlib_module_names
    assert packages == {"numpy", "scipy", "skimage", "threadpoolctl"}


def test_pins_are_found_where_the_model_finds_them(exported):
    read, predictions = exported.read, exported.predictions
    np.testing.assert_allclose(read["pins"], exported.model.reader.read(exported.images).pins)
    *_, untouched, noise = read["reasons"].tolist()
    assert read["reasons"].tolist() == predictions.rejection.tolist()
    assert untouched == "no contact" and noise and not any(read["reasons"][:CONTACTS])
    assert np.isnan(read["inputs"][CONTACTS:]).all()


def test_a_robot_s_program_gives_the_model_s_touch(exported):
    touch = exported.model.touch(exported.images)
    for row, line in enumerate(exported.lines[:-1]):
        expected = touch.describe(row)
        assert line["touch"].keys() == expected.keys()
        np.testing.assert_allclose(list(line["touch"].values()), list(expected.values()), atol=1e-4)
    assert set(exported.lines[0]["touch"]) == set(Touch._fields)
    assert "slip" not in exported.lines[-2]["touch"] and "touch" not in exported.lines[-1]


def test_an_untouched_frame_is_learnt_as_the_model_learns_it(exported):
    model = load_model("skin", like=exported.contacts)
    model.learn_rest_positions(exported.images[-2:-1])
    expected = list(model.touch(exported.images[:1]).describe(0).values())
    np.testing.assert_allclose(exported.read["learnt"], expected, atol=1e-4)
    assert abs(exported.lines[0]["touch"]["contact"] - expected[0]) > 0


def test_a_worn_dome_is_learnt_too(exported):
    rest = load_exported_model(exported.model).rest
    camera = camera_pins.describe_camera_pins(exported.model, rest)
    worn = dataclasses.replace(camera, frame=camera.frame._replace(lost=(5,)))
    learnt = worn.learn_rest_positions(exported.frames[-2:-1])
    assert np.isfinite(learnt.untouched.rest).all()
    reading = learnt.read(exported.frames[0])
    assert np.isnan(reading.pins[5]).all() and reading.touch["contact"] > 0.5


def test_a_robot_s_program_gives_the_model_s_poses(exported):
    poses = exported.predictions.poses["unsheared"]
    assert len(exported.lines) == CONTACTS + 2
    for row, line in enumerate(exported.lines[:CONTACTS]):
        assert line["confidence"] > 0.5
        for name, value in line["pose"].items():
            error = value - poses[name][row]
            error = (error + 180) % 360 - 180 if name == "edge_deg" else error
            assert abs(error) < 0.01
    for line, reason in zip(exported.lines, exported.predictions.rejection, strict=True):
        assert line.get("error", "") == reason and ("pose" in line) == (not reason)
        assert (line["confidence"] > 0) == (not reason)


def test_without_a_camera_there_is_no_module(tmp_path, capsys):
    assert main(["export", "skin", "--out", str(tmp_path / "skin.onnx")]) == 0
    assert "name contacts of a camera by --like" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["skin.onnx"]


def test_source_holds_what_a_class_uses_alone():
    found: dict[str, object] = {}
    exec(collect_source(View), found)
    assert found["View"]() == View() and "Box" not in found


def test_two_definitions_of_one_name_are_refused(tmp_path, monkeypatch):
    (tmp_path / "second.py").write_text(
        "from first import get\n\nSIZE = 2\n\n\nclass Both:\n    sizes = SIZE, get\n"
    )
    (tmp_path / "first.py").write_text("SIZE = 1\n\n\ndef get():\n    return SIZE\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(package_source, "PACKAGE", "first")
    import second

    with pytest.raises(ValueError, match="SIZE is defined in"):
        collect_source(second.Both)


def test_a_file_of_somebody_else_stays(command, tmp_path):
    own = tmp_path / "touch_pins.py"
    own.write_text("mine = 1\n")
    answer = command("export", "skin", "--out", tmp_path / "touch.onnx")
    assert answer.code == 2 and "touch_pins.py is there" in answer.err
    assert own.read_text() == "mine = 1\n" and not (tmp_path / "touch.onnx").exists()


def test_the_module_of_an_earlier_camera_goes(command, tmp_path):
    file = tmp_path / "touch.onnx"
    path = camera_pins.get_module_path(file)
    path.write_text(camera_pins.HEADING.format(name=file.name, version="0", inputs="{}"))
    answer = command("export", "skin", "--out", file)
    assert answer.code == 0 and not path.exists()
    assert "name contacts of a camera by --like" in answer.out
