"""Test one network over recordings of two tasks, from `fit` to a pose."""

import json
import sys
from pathlib import Path

import made
import numpy as np
import pytest

from benchmarks import bench_taps_alone
from jaxunshear import load_model
from jaxunshear.cli import main
from jaxunshear.data.recordings import read_image
from jaxunshear.files import read_object
from jaxunshear.training.checkpoint import MODEL, TASK_SHARES, load_network
from tests.helpers.commands import succeed

sys.path.insert(0, str(Path(__file__).parent))
from conftest import SHORT

TARGETS = {"edge": ["y_mm", "z_mm", "Rz_deg"], "surface": ["z_mm"]}


@pytest.fixture(scope="module")
def folders(recording, tmp_path_factory):
    """An edge; a surface; and taps alone on another one."""
    folder = tmp_path_factory.mktemp("recording")
    surface, lone = made.surface(folder / "surface", 100, 100), made.surface(folder / "lone", 60, 0)
    return recording, surface, lone


@pytest.fixture(scope="module")
def run(folders, place):
    words = ["fit", "--recordings", *folders, "--name", "joint_edge_surface", *SHORT[2:]]
    words += ["--paired.validation", "0.2"]  # as in `pins_run`, whose data set it shares
    words += ["--pins.hidden", "64", "--pins.layers", "1"]  # enough here, and quicker
    words += ["--out", place / "runs", "--data", place / "datasets"]
    assert main([str(word) for word in words]) == 0
    return place / "runs" / "joint_edge_surface"


def read_tests(run):
    return json.loads((run / "results.json").read_text())["tests"]


def test_each_task_has_a_row_of_each_network(run):
    tests = read_tests(run)
    assert list(tests) == list(TARGETS)
    for name, targets in TARGETS.items():
        kinds = tests[name]["pose_mae"]
        assert set(kinds) == {"tap", "sheared", "sheared_learnt", "own", "others", "unsheared"}
        assert all(list(errors) == targets for errors in kinds.values())


def test_the_joint_network_unshears_what_a_network_of_the_other_task_does_not(run):
    errors = read_tests(run)["edge"]["pose_mae"]
    assert errors["unsheared"]["Rz_deg"] < 0.5 * errors["sheared"]["Rz_deg"]
    assert errors["others"]["Rz_deg"] > errors["sheared"]["Rz_deg"]


def test_the_folder_of_a_task_is_a_model(run, folders):
    for name, folder in zip((*TARGETS, "lone"), folders, strict=True):
        model = load_model(run / name)
        file = folder / "tap" / "csv_train" / "images" / "image_1.png"
        poses = model.pose(model.prepare(read_image(file))[None])
        assert list(poses["unsheared"]) == TARGETS.get(name, ["z_mm"])
        assert np.isfinite(list(poses["unsheared"].values())).all()


def test_the_model_of_a_task_was_given_its_task(run):
    stored = {name: run / name / "disentangled" for name in (*TARGETS, "lone")}
    shares = {name: read_object(path / MODEL).get(TASK_SHARES) for name, path in stored.items()}
    assert shares == {"edge": [1, 0, 0], "surface": [0, 1, 0], "lone": [0, 0, 1]}
    parts = [load_network(path).variables["params"]["E"]["Conv_0"] for path in stored.values()]
    assert {each["kernel"].shape for each in parts} == {(3, 3, 3, 4)}  # without inputs of tasks
    kernels = [np.asarray(each["kernel"]) for each in parts]
    assert all(np.ptp(kernels, axis=0)[:, :, -1].max(axis=(0, 1)) > 1e-3)
    np.testing.assert_array_equal(np.ptp(kernels, axis=0)[:, :, :-1], 0)


def test_a_model_is_the_folder_of_a_task(run, tmp_path, command):
    lines = (
        ("pose", tmp_path, "--model", run),
        ("compare", run, run / "edge"),
        ("ablate", run),
        ("adapt", run, "--taps", tmp_path, "--out", tmp_path / "out"),
    )
    for words in lines:
        answer = command(*words)
        assert answer.code == 2 and f"name the folder of one, {run}/TASK" in answer.err


def test_the_written_experiment_trains_nothing_twice(run, place, command):
    file, words = run.with_suffix(".py"), ("--out", place / "runs", "--data", place / "datasets")
    assert "images in" not in succeed(command, "train", file, *words).out


def test_recordings_are_scored_as_the_task_whose_labels_vary(run, place, tmp_path, command):
    other = made.surface(tmp_path / "monday", 30, 30, seed=5)
    words = ("--data", place / "datasets", "--json", tmp_path / "o.json")
    succeed(command, "evaluate", run, "--recordings", other, *words)
    rows = {row["name"] for row in json.loads((tmp_path / "o.json").read_text())["rows"]}
    assert "pose_mae.unsheared.z_mm" in rows and "pose_mae.unsheared.y_mm" not in rows


def test_taps_alone_and_slides_of_other_tasks_teach_to_unshear(run, place):
    rows = bench_taps_alone.bench_taps_alone(run, place / "datasets")
    names = [row["name"] for row in rows]
    kinds = ("tap", "sheared", "nothing", "taps alone", "slides")
    assert names == [f"{task}/{kind}" for task in TARGETS for kind in kinds]
    errors = {row["name"]: row["Rz_deg"] for row in rows if row["task"] == "edge"}
    assert errors["edge/taps alone"] < errors["edge/nothing"]
    assert "recovery_Rz_deg" in bench_taps_alone.format_table(rows)
    model = read_object(run / "trained" / "taps_of_edge" / "disentangled" / MODEL)
    origins = model["origin"]["tasks"]
    assert [origin["pairing"] for origin in origins] == ["transferred", "rendered", "transferred"]
