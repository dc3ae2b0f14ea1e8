"""Commands that put networks to use: what they refuse in one line, before they write."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from jaxunshear.config.data import PairedData, PoseData, Ranges
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.sensor import Preprocess
from jaxunshear.config.targets import make_range_targets
from jaxunshear.downstream import servo
from jaxunshear.downstream.geometry import HEIGHT_METHODS
from jaxunshear.files import to_builtins
from jaxunshear.results.applications import TrajectoryScore
from jaxunshear.results.record_files import SCHEMA, convert_record
from tests.helpers.models import init, write_run

TARGETS = make_range_targets((), Ranges())


def experiment(size):
    seen = Preprocess(size=size)
    return Experiment(
        *("small", "none"),
        unshear=UnshearNet(size=size, widths=(4, 4, 4), pose_channels=4, shear_channels=4),
        posenet=PoseNet(size=size, widths=(4, 4, 4, 4, 4), hidden=8),
        paired=PairedData(preprocess=seen),
        pose=PoseData(preprocess=seen),
    )


def run_of(folder, size, seed=0):
    """Make a run with networks that have learnt nothing."""
    small = experiment(size)
    nets = {"disentangled": small.unshear, "posenet": small.posenet}
    variables = [init(small.unshear, seed), init(small.posenet, 1, TARGETS)]
    variables = dict(zip(nets, variables, strict=True))
    return write_run(folder / "small", small, nets, variables, TARGETS)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return run_of(tmp_path_factory.mktemp("run"), 128)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("servo", "--stimulus", "cube"), "stimulus 'cube' is unknown"),
        (("servo", "--stimulus", "edge"), "no outline that closes"),
        (("reconstruct", "--stimulus", "disk,surface"), "no outline that closes"),
        (("servo", "--stimulus", "disk,disk"), "name each once"),
        (("servo", "--starts", "0"), "--starts 0"),
        (("servo", "--seed", "-1"), "--seed -1"),
        (("servo", "--json", "."), "--json . is a folder"),
        (("servo", "--depth", "99"), "--depth 99"),
        (("servo", "--depth", "-1"), "--depth -1"),
        (("servo", "--ways", "smell"), "perception 'smell' is unknown"),
        (("geometry", "--contacts", "1"), "--contacts 1"),
        (("geometry", "nowhere"), "nowhere does not exist"),
        (("geometry", "."), ". holds no images"),
        (("reconstruct", "--stimulus", "disk"), "holds no walks"),
        (("stream", ".", "--fps", "0"), "--fps 0"),
    ],
)
def test_refusals(command, tmp_path, monkeypatch, model, words, said):
    monkeypatch.chdir(tmp_path)
    answer = command(*words, *name_model(words[0], model))
    assert answer.code == 2 and said in answer.err and "Traceback" not in answer.err
    assert len(answer.err.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def name_model(command, model):
    return (model,) if command == "reconstruct" else ("--model", model)


@pytest.mark.parametrize("name", ["servo", "geometry", "reconstruct"])
def test_a_model_that_is_none(command, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "servo").mkdir()
    answer = command(name, *name_model(name, tmp_path / "nothing"))
    assert answer.code == 2 and "experiment.json" in answer.err


@pytest.mark.parametrize(
    ("name", "said"), [("servo", "--ways true"), ("geometry", "no trained network")]
)
def test_a_model_without_networks(command, tmp_path, model, name, said):
    (tmp_path / "empty").mkdir()
    shutil.copy(model / "experiment.json", tmp_path / "empty")
    answer = command(name, "--model", tmp_path / "empty", "--out", tmp_path / "out")
    assert answer.code == 2 and said in answer.err and not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["servo", "geometry", "stream", "unshear"])
def test_a_half_trained_network_is_refused(command, tmp_path, model, name):
    shutil.copytree(model, tmp_path / "half")
    (tmp_path / "half" / "disentangled" / "summary.json").unlink()
    Image.fromarray(np.zeros((128, 128), np.uint8)).save(tmp_path / "one.png")
    given = (tmp_path / "one.png",) if name in ("stream", "unshear") else ()
    given += () if name == "stream" else ("--out", tmp_path / "out")
    answer = command(name, *given, "--model", tmp_path / "half")
    assert answer.code == 2 and "was not finished" in answer.err and not (tmp_path / "out").exists()


def test_servo_then_reconstruct(command, brief, tmp_path, model):
    """A few steps by each way; networks that have learnt nothing go astray, which is said."""
    out = tmp_path / "walks"
    words = ("--model", model, "--out", out, "--stimulus", "disk")
    answer = command("servo", *words, "--starts", 1, "--json", tmp_path / "rows.json")
    assert answer.code == 0, answer.err
    held = json.loads((tmp_path / "rows.json").read_text())
    assert held["schema"] == SCHEMA
    for row in held["rows"]:
        assert to_builtins(convert_record(row, TrajectoryScore, "rows.json", "walk again")) == row
    rows = held["rows"]
    assert [row["name"] for row in rows] == ["disk/true", "disk/sheared", "disk/disentangled"]
    assert all(0 <= row["completed"] < 0.1 and row["closed"] == 0 for row in rows)
    assert all(row["mean_mm"] < 9 for row in rows)
    assert Image.open(out / "disk.png").size[0] > 300
    answer = command("reconstruct", *words[1:])
    assert answer.code == 0, answer.err
    found = json.loads((out / "reconstruct.json").read_text())
    assert len(found["rows"]) == 6 and all(0 <= row["iou"] < 0.4 for row in found["rows"])
    assert {row["object"] for row in found["rows"]} == {"voronoi", "skin"}
    assert all((out / f"disk-{name}.png").is_file() for name in ("skin", "voronoi"))
    answer = command("reconstruct", *words[1:-1], "disk,leaf")
    assert answer.code == 2 and "--stimulus leaf" in answer.err
    course, walks = servo.load_trajectories(out / "disk.npz")
    walks.end[0] = servo.WALKING
    servo._save(out / "disk.npz", course, walks)
    answer = command("reconstruct", *words[1:])
    assert answer.code == 2 and "not finished" in answer.err
    other = run_of(tmp_path, 128, seed=1)
    answer = command("servo", "--model", other, *words[2:], "--starts", 1)
    assert answer.code == 2 and "another model or sensor" in answer.err


def test_nothing_is_written_among_the_recordings(command, tmp_path, monkeypatch, model):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "images").mkdir()
    Image.fromarray(np.zeros((64, 64), np.uint8)).save(tmp_path / "images" / "000000.png")
    (tmp_path / "others").mkdir()
    Image.fromarray(np.zeros((64, 64), np.uint8)).save(tmp_path / "others" / "1.png")
    kept = (tmp_path / "images" / "000000.png").read_bytes()
    for words in (
        ("pins", "."),
        ("pins", "images", "--out", "images/new"),
        ("pins", "others", "--rest", "images", "--out", "images/new"),
        ("calibrate", "images", "--out", "images/new"),
        ("unshear", "images", "--out", "images", "--model", model),
        ("geometry", "images", "--out", "images", "--model", model),
        ("stream", "images", "--images", "images", "--model", model),
    ):
        answer = command(*words)
        assert answer.code == 2 and "lies among the recordings" in answer.err, words
    left = sorted(path.name for path in tmp_path.rglob("*"))
    assert left == ["000000.png", "1.png", "images", "others"]
    assert (tmp_path / "images" / "000000.png").read_bytes() == kept


@pytest.mark.long
def test_geometry_scores_and_draws(command, brief, tmp_path, model):
    answer = command("geometry", "--model", model, "--contacts", 6, "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    rows = {
        row["name"]: row
        for row in json.loads((tmp_path / "out" / "geometry.json").read_text())["rows"]
    }
    assert set(rows) == {
        f"{s}/{k}/{w}"
        for s in ("all", "disk", "clover", "teardrop")
        for k in ("tap", "sheared", "disentangled", "untouched")
        for w in HEIGHT_METHODS
    }
    assert rows["all/tap/areas"]["contacts"] == 15 and rows["all/tap/areas"]["correlation"] > 0.3
    unmatched = rows["all/disentangled/inverse"]
    assert unmatched["unmatched"] == 15 and "correlation" not in unmatched
    assert rows["all/tap/inverse"]["correlation"] > 0.9
    assert rows["all/untouched/inverse"]["largest_mm"] == 0
    assert rows["all/untouched/areas"]["largest_mm"] > 0
    assert (tmp_path / "out" / "geometry.png").is_file()


def test_stream_of_a_folder(command, tmp_path, model):
    folder = tmp_path / "images"
    folder.mkdir()
    dots = (np.random.default_rng(0).random((3, 64, 64)) < 0.2).astype(np.uint8) * 255
    for number, picture in enumerate(dots):
        Image.fromarray(picture).save(folder / f"{number}.png")
    (folder / "3.png").write_bytes(b"torn")
    summary = tmp_path / "summary.json"
    words = ("stream", folder, "--model", model, "--json", summary)
    refused = command(*words)
    assert refused.code == 1
    assert "skipped 3: its pins do not match the model's sensor" in refused.err
    assert not any("pose" in json.loads(line) for line in refused.out.splitlines())
    answer = command(*words, "--force")
    assert answer.code == 0, answer.err
    assert "note: These networks were trained on simulated contacts alone" in answer.err
    assert "note" not in answer.out
    lines = [json.loads(line) for line in answer.out.splitlines()]
    assert [("error" in line) for line in lines] == [False, False, False, True]
    assert set(lines[0]) >= {"pose", "confidence", "ms"} and not {"image_png"} & set(lines[0])
    assert set(lines[0]["pose"]) >= {"x_mm", "yaw_deg", "edge_mm", "edge_deg"}
    assert json.loads(summary.read_text())["used"] == 3
    assert "3 frames used, 1 skipped, 0 dropped" in answer.err
