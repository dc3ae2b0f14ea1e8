"""Recordings go through the networks of a run: every readable image gets its results."""

import csv
import itertools
import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from jaxunshear import __version__
from jaxunshear.config import targets
from jaxunshear.config.data import PairedData, PoseData, Ranges
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.recordings import read_recordings
from jaxunshear.inference import infer
from jaxunshear.models import posenet, unshearnet
from tests.helpers.models import change_weights, init, write_run

SIZE = 32
NET = UnshearNet(size=SIZE, widths=(4, 4, 4), pose_channels=4, shear_channels=4)
POSENET = PoseNet(size=SIZE, widths=(4, 4, 4, 4, 4), hidden=8)
PREPROCESS = Preprocess(size=SIZE)
TARGETS = targets.make_range_targets((), Ranges())
EXPERIMENT = Experiment(
    "small",
    "none",
    unshear=NET,
    posenet=POSENET,
    paired=PairedData(preprocess=PREPROCESS),
    pose=PoseData(preprocess=PREPROCESS),
)


@pytest.fixture(scope="module")
def variables():
    """Draw variables far from the initial ones, whose outputs hardly depend on the image."""
    rng = np.random.default_rng(0)

    def add_noise(x):
        return x + rng.normal(0, 0.1, x.shape).astype(np.float32)

    return {
        "disentangled": change_weights(init(NET, 0), add_noise),
        "posenet": change_weights(init(POSENET, 1, TARGETS), add_noise),
    }


@pytest.fixture
def model(tmp_path, variables):
    """Write the folder of a finished run."""
    nets = {"disentangled": NET, "posenet": POSENET}
    return write_run(tmp_path / "runs" / "small", EXPERIMENT, nets, variables, TARGETS)


@pytest.fixture
def folder(tmp_path):
    """Write 40 binary images with labels, more than a batch, two of them broken."""
    place = tmp_path / "edge"
    (place / "images").mkdir(parents=True)
    rng = np.random.default_rng(0)
    lines = ["sensor_image," + ",".join(f"pose_{i}" for i in range(1, 7))]
    for i in range(40):
        image = np.where(rng.random((SIZE, SIZE)) < 0.3, 255, 0).astype(np.uint8)
        Image.fromarray(image).save(place / "images" / f"image_{i}.png")
        lines.append(f"image_{i}.png,{i},0,1,0,0,{-i}")
    (place / "images" / "image_5.png").write_bytes(b"no image")
    (place / "images" / "image_39.png").write_bytes(b"")
    (place / "targets.csv").write_text("\n".join(lines) + "\n")
    return place


def read_rows(out):
    with open(out / "poses.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_every_readable_image_is_unsheared_in_its_place(
    command, model, folder, variables, tmp_path
):
    out = tmp_path / "out"
    words = ("--force", "--model", model, "--out", out, "--json", tmp_path / "unshear.json")
    answer = command("unshear", folder, *words)
    assert answer.code == 0, answer.err
    assert "38 images unsheared, 2 left out" in answer.out
    assert "simulated contacts alone" in answer.out
    assert "simulated contacts alone" in (out / "NOTE.txt").read_text()
    for name in ("image_5.png", "image_39.png"):
        assert name in answer.out
        assert not (out / "images" / name).exists()

    rows = read_rows(out)
    assert len(rows) == 38
    for row in (rows[0], rows[5], rows[-1]):
        number = int(row["name"].removeprefix("images/image_").removesuffix(".png"))
        assert (float(row["recorded_pose_x_mm"]), float(row["recorded_pose_rz_deg"])) == (
            number,
            -number,
        )
        recordings = read_recordings(folder / "images" / f"image_{number}.png", PREPROCESS)
        ((_, _, image),) = recordings.iterate_frames()
        alone = image[None, :, :, None] / np.float32(255)
        expected = unshearnet.unshear(NET, variables["disentangled"], alone)
        written = np.asarray(Image.open(out / row["image"]))
        np.testing.assert_allclose(written, 255 * np.asarray(expected)[0, ..., 0], atol=0.6)
        poses = posenet.unscale_outputs(
            posenet.predict(POSENET, variables["posenet"], expected), TARGETS
        )
        assert set(poses) == {"x_mm", "yaw_deg", "edge_mm", "edge_deg"}
        for quantity, value in poses.items():
            assert float(row[quantity]) == pytest.approx(float(value[0]), abs=2e-3)

    measured = json.loads((tmp_path / "unshear.json").read_text())
    provenance = {"machine", "versions", "source", "trained_on", "trained_by", "command"}
    assert set(measured) == {"rows", "checksum"} | provenance
    assert measured["command"].startswith("jaxunshear unshear ")
    assert measured["source"]["version"] == __version__
    assert {row["name"]: row["value"] for row in measured["rows"]}["unshear.images"] == 38


@pytest.mark.parametrize("arguments", [("unshear", "--out", "out"), ("pose",)])
def test_images_that_are_not_the_sensors_are_refused_by_name(
    command, model, folder, tmp_path, monkeypatch, arguments
):
    monkeypatch.chdir(tmp_path)
    answer = command(arguments[0], folder, "--model", model, *arguments[1:])
    assert (answer.code, answer.err.count("\n")) == (2, 1)
    assert "not a lattice" in answer.err and "--force answers all the same" in answer.err
    assert not (tmp_path / "out").exists() and not answer.out


@pytest.mark.parametrize("images", ["images/image_1.png", "images"])
def test_the_time_for_an_image_is_that_of_a_batch_over_its_places(
    monkeypatch, model, folder, tmp_path, images
):
    # a second per batch
    clock = SimpleNamespace(perf_counter=itertools.count().__next__)
    monkeypatch.setattr(infer, "time", clock)
    measured = infer.unshear_recordings(folder / images, model, tmp_path / "out", force=True)
    values = {row.name: row.value for row in measured.rows}
    assert values["unshear.time_per_image"] == pytest.approx(1 / infer.BATCH)


def test_half_of_the_images_left_out_is_no_success(command, model, folder, tmp_path):
    for number in range(18):
        (folder / "images" / f"image_{number}.png").write_bytes(b"no image")
    arguments = (folder, "--force", "--model", model)
    assert command("unshear", *arguments, "--out", tmp_path / "out").code == 0  # 19 of 40
    (folder / "images" / "image_20.png").write_bytes(b"no image")
    answer = command("unshear", *arguments, "--out", tmp_path / "out")
    assert answer.code == 1 and "20 images unsheared, 20 left out" in answer.out
    answer = command("pose", *arguments)
    assert answer.code == 1 and "poses of 20 images, 20 left out" in answer.err


def test_pose_gives_both_readings_of_each_image(command, model, folder, tmp_path):
    answer = command("pose", folder, "--force", "--model", model, "--json", tmp_path / "pose.json")
    assert answer.code == 0, answer.err
    assert "simulated contacts alone" in answer.err
    rows = list(csv.DictReader(answer.out.splitlines()))
    assert len(rows) == 38
    measured = {
        row["name"]: row for row in json.loads((tmp_path / "pose.json").read_text())["rows"]
    }
    assert len(measured) == 38 * 8 + 2 and measured["pose.left_out"]["value"] == 2
    one = measured["images/image_7.png.unsheared.edge_deg"]
    assert one["unit"] == "deg"
    assert one["value"] == pytest.approx(float(rows[6]["unsheared_edge_deg"]), abs=1e-3)
    assert rows[6]["unsheared_x_mm"] != rows[6]["as_recorded_x_mm"]


def test_without_a_posenet_images_are_unsheared_all_the_same(command, model, folder, tmp_path):
    (model / "posenet").rename(tmp_path / "aside")
    answer = command("unshear", folder, "--force", "--model", model, "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    assert "no trained PoseNet" in answer.out
    assert "x_mm" not in read_rows(tmp_path / "out")[0]


def test_one_file(command, model, folder, tmp_path):
    one = folder / "images" / "image_1.png"
    assert command("unshear", one, "--force", "--model", model, "--out", tmp_path / "one").code == 0
    assert (tmp_path / "one" / "image_1.png").exists()


def test_nothing_readable_is_refused(command, model, tmp_path):
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "a.png").write_bytes(b"x")
    for place in (tmp_path / "bad", tmp_path / "bad" / "a.png"):
        answer = command("unshear", place, "--model", model, "--out", tmp_path / "out")
        assert (answer.code, answer.err.count("error:")) == (2, 1)
        assert "Traceback" not in answer.err
    assert not (tmp_path / "out").exists()


def test_real_recordings_go_through(command, model, real_recordings, tmp_path):
    unpacked = tmp_path / "real"
    subprocess.run(
        [sys.executable, real_recordings / "unpack.py", unpacked, "--limit", "8"], check=True
    )
    answer = command("unshear", unpacked, "--force", "--model", model, "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    assert "0 left out" in answer.out
    answer = command(
        "unshear", real_recordings / "raw", "--force", "--model", model, "--out", tmp_path / "raw"
    )
    assert answer.code == 0, answer.err
    assert len(read_rows(tmp_path / "raw")) == 3


def test_a_recording_is_not_taken_for_a_file_of_rows(command, model, tmp_path):
    Image.fromarray(np.zeros((SIZE, SIZE), np.uint8)).save(tmp_path / "one.png")
    kept = (tmp_path / "one.png").read_bytes()
    answer = command("pose", tmp_path / "one.png", "--model", model, "--json", tmp_path / "one.png")
    assert answer.code == 2 and "holds something else" in answer.err
    answer = command(
        "stream", tmp_path / "one.png", "--model", model, "--lines", tmp_path / "one.png"
    )
    assert answer.code == 2 and "--lines" in answer.err
    assert (tmp_path / "one.png").read_bytes() == kept
