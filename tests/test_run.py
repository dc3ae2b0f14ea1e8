"""The whole way at its smallest: one command, then what a person does with the result."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxunshear.evaluation.measurements import reproducible

ROOT = Path(__file__).resolve().parents[1]
TINY = ROOT / "experiments" / "tiny.py"


def run_command(folder: Path, *more: str) -> list[str]:
    words = ["run", str(TINY), "--out", str(folder / "runs"), "--data", str(folder / "datasets"), *more]
    return [sys.executable, "-m", "jaxunshear", *words]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the runs/ and datasets/ of a finished tiny experiment."""
    folder = tmp_path_factory.mktemp("whole")
    done = subprocess.run(run_command(folder, "--json", str(folder / "rows.json")), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


def results(folder: Path) -> dict:
    return json.loads((folder / "runs" / "tiny" / "results.json").read_text())


def test_results_bear_the_names_that_others_rely_on(finished):
    found = results(finished)
    shapes = {"disk", "clover", "teardrop", "overall"}
    assert {kind: set(found["ms_ssim"][kind]) for kind in ("sheared", "entangled", "disentangled")} == {
        "sheared": shapes,
        "entangled": shapes,
        "disentangled": shapes,
    }
    for kind in ("tap", "sheared", "entangled", "disentangled"):
        assert set(found["pose_mae"][kind]) == {"x_mm", "yaw_deg", "edge_mm", "edge_deg"}
    assert {"swap", "pin_error", "time_s"} <= set(found) and found["simulated"] is True
    assert found["metric"]["ms_ssim"] == "ms_ssim@4"
    assert {"data", "entangled", "disentangled", "posenet", "evaluate"} <= set(found["time_s"])
    assert found["counts"]["test_poses"] == 6 and found["counts"]["dropped"] == 0
    assert 0 < found["ms_ssim"]["sheared"]["overall"] < 0.6
    measured = json.loads((finished / "rows.json").read_text())
    assert {"rows", "machine", "versions"} <= set(measured)
    assert {"name", "value", "unit", "bar", "ok"} <= set(measured["rows"][0])


def test_the_report_stands_alone(finished):
    page = (finished / "runs" / "tiny" / "report.html").read_text()
    assert "data:image/png;base64," in page and "http://" not in page and "https://" not in page


def test_a_second_run_keeps_all_work_and_all_numbers(finished):
    before = reproducible(results(finished))
    trained = {path: path.stat().st_mtime_ns for path in (finished / "runs" / "tiny").glob("*/summary.json")}
    assert len(trained) == 3
    assert subprocess.run(run_command(finished), capture_output=True).returncode == 0
    assert reproducible(results(finished)) == before
    assert trained == {path: path.stat().st_mtime_ns for path in trained}


def test_another_experiment_is_not_mixed_in(finished, command):
    answer = command("train", TINY, "--out", finished / "runs", "--data", finished / "datasets", "--train.epochs", "3")
    assert answer.code == 2 and "train.epochs" in answer.err and answer.err.count("\n") == 1


@pytest.mark.parametrize("stage", ["train", "evaluate", "ablate"])
def test_networks_of_an_earlier_version_of_the_data_are_not_taken_for_todays(finished, command, tmp_path, stage):
    import shutil

    out = shutil.copytree(finished / "runs", tmp_path / "runs")
    (out / "tiny" / "results.json").unlink()
    file = out / "tiny" / "disentangled" / "model.json"
    file.write_text(file.read_text().replace('"version": "', '"version": "0.'))
    words = [out / "tiny"] if stage == "ablate" else [TINY, "--out", out]
    answer = command(stage, *words, "--data", finished / "datasets")
    assert (
        answer.code == 2 and "learnt from a data set with another version" in answer.err and answer.err.count("\n") == 1
    )
    assert not any((out / "tiny" / name).exists() for name in ("results.json", "ablation.json"))


def test_a_network_is_taught_by_a_posenet_that_the_results_do_not_know(finished, command, tmp_path):
    words = [TINY, "--out", tmp_path, "--data", finished / "datasets", "--train.pose_weight", 1]
    done = command("run", *words, "--networks", "disentangled,posenet")
    assert done.code == 0, done.err
    folder = tmp_path / "tiny"
    logged = json.loads((folder / "disentangled" / "log.jsonl").read_text().splitlines()[-1])
    assert logged["train"]["pose"] > 0 and logged["validation"]["pose"] > 0
    teacher, other = (json.loads((folder / name / "model.json").read_text()) for name in ("posenet_teacher", "posenet"))
    assert teacher["seed"] != other["seed"] and teacher["net"] == other["net"]
    found = json.loads((folder / "results.json").read_text())
    assert "disentangled" in found["ms_ssim"] and "posenet_teacher" not in json.dumps(found["ms_per_image"])
    plain = json.loads((finished / "runs" / "tiny" / "disentangled" / "log.jsonl").read_text().splitlines()[-1])
    assert "pose" not in plain["train"]


def test_the_networks_take_images_of_people(finished, command, tmp_path):
    """Grey pins, colour, sixteen bits: all come out as images of the network's size, with a table of poses."""
    rows, columns = np.mgrid[:300, :300]
    grey = (((rows // 9 + columns // 9) % 2) * 180 * (np.hypot(rows - 150, columns - 150) < 120)).astype(np.uint8)
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    Image.fromarray(grey).save(recordings / "a.png")
    Image.fromarray(np.stack([grey] * 3, -1)).save(recordings / "b.png")
    Image.fromarray(grey.astype(np.uint16) * 257).save(recordings / "c.png")
    out = tmp_path / "out"
    answer = command("unshear", recordings, "--model", finished / "runs" / "tiny", "--out", out)
    assert answer.code == 0, answer.err
    assert "simulat" in answer.out and "simulat" in (out / "NOTE.txt").read_text()
    assert len((out / "poses.csv").read_text().splitlines()) == 4
    for path in out.glob("*.png"):
        assert np.asarray(Image.open(path)).shape == (128, 128)


@pytest.mark.long
def test_killed_ten_times_ends_with_the_same_numbers(finished, tmp_path):
    moments = random.Random(0)
    kills = 0
    while kills < 10:
        process = subprocess.Popen(
            run_command(tmp_path), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        try:
            process.wait(timeout=moments.uniform(3, 15))
            break
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            kills += 1
            time.sleep(0.1)
    last = subprocess.run(run_command(tmp_path), capture_output=True, text=True)
    assert last.returncode == 0, last.stderr
    assert kills >= 2
    assert reproducible(results(tmp_path)) == reproducible(results(finished))
