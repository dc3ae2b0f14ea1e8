"""The module beside a file over images gives the model's reasons and touch, without JAX."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from jaxunshear import load_model
from jaxunshear.apps.export.export import export_model
from jaxunshear.apps.robot import stream as streams
from jaxunshear.cli import main
from jaxunshear.errors import Note
from tests.helpers.robots import CONTACTS, make_frames, run_robot


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A folder with frames, what `standard` makes of them, and what its exported file makes."""
    folder = tmp_path_factory.mktemp("robot")
    model = load_model("standard")
    frames = make_frames(model)
    frames = np.pad(frames, ((0, 0), (40, 40), (100, 100)), mode="edge")
    np.save(folder / "frames.npy", frames)
    assert main(["export", "standard", "--out", str(folder / "touch.onnx")]) == 0
    lines = [json.loads(line) for line in run_robot(folder).splitlines()]
    with pytest.warns(Note):
        # twice, as the module sees them: robot.py comes second, when it knows the crop
        images, again = np.stack([list(map(model.prepare, frames)) for _ in range(2)])
    return SimpleNamespace(
        folder=folder,
        frames=frames,
        read=np.load(folder / "read.npz"),
        lines=lines,
        model=model,
        images=images,
        predictions=model.predict(images),
        streamed=model.predict(again),
    )


def test_reasons_are_the_model_s(shared):
    reasons, expected = shared.read["reasons"].tolist(), shared.predictions.rejection.tolist()
    assert reasons == expected and expected[-2] == "no contact" and expected[-1]
    assert not any(expected[:CONTACTS])
    assert [line.get("error", "") for line in shared.lines] == expected


def test_frames_without_a_pose_become_black(shared):
    inputs, images = shared.read["inputs"], shared.images
    np.testing.assert_array_equal(inputs[:CONTACTS], images[:CONTACTS])
    assert images[CONTACTS:].any() and not inputs[CONTACTS:].any()


def test_lines_have_the_model_s_poses_and_touch(shared):
    poses, touch = shared.streamed.poses["unsheared"], shared.streamed.touch
    for row, line in enumerate(shared.lines):
        assert ("pose" in line) == (line["confidence"] > 0) == (row < CONTACTS)
        assert line["confidence"] == pytest.approx(shared.streamed.confidence[row], abs=0.03)
        for name, value in line.get("pose", {}).items():
            error = value - poses[name][row]
            error = (error + 180) % 360 - 180 if name.endswith("_deg") else error
            assert abs(error) < 0.01
        expected = touch.describe(row)
        assert line.get("touch", {}).keys() == expected.keys()
        np.testing.assert_allclose(
            list(line.get("touch", {}).values()), list(expected.values()), atol=1e-4
        )
    assert shared.lines[CONTACTS]["touch"]["contact"] < 0.5 < shared.lines[0]["touch"]["contact"]


def test_an_untouched_frame_is_learnt_as_the_model_learns_it(shared):
    model = load_model("standard")
    model.learn_rest_positions(shared.images[-2:-1])
    expected = list(model.touch(shared.images[:1]).describe(0).values())
    np.testing.assert_allclose(shared.read["learnt"], expected, atol=0.02)


def test_prepared_images_are_judged_too(shared):
    np.save(shared.folder / "frames.npy", shared.images)
    try:
        lines = [json.loads(line) for line in run_robot(shared.folder).splitlines()]
    finally:
        np.save(shared.folder / "frames.npy", shared.frames)
    assert [line.get("error") for line in lines] == [line.get("error") for line in shared.lines]


def test_a_file_of_frames_has_its_own_crop(shared, tmp_path):
    names = [tmp_path / "frames" / f"{number:02d}.png" for number in range(CONTACTS)]
    names[0].parent.mkdir()
    for name, frame in zip(names, shared.frames[:CONTACTS], strict=True):
        Image.fromarray(frame).save(name)
    export_model("standard", tmp_path / "touch.onnx", preprocess=names[0].parent)
    np.save(tmp_path / "frames.npy", shared.frames)
    lines = [json.loads(line) for line in run_robot(tmp_path).splitlines()]
    assert [line.get("error", "") for line in lines] == shared.predictions.rejection.tolist()
    assert lines[-1]["schema"] == streams.SCHEMA
    for line, other in zip(lines[:CONTACTS], shared.lines, strict=False):
        assert line["pose"]["edge_mm"] == pytest.approx(other["pose"]["edge_mm"], abs=0.2)
