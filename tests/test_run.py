"""The full way at its smallest: one command, then what a person does with the result."""

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from PIL import Image

from jaxunshear import run
from jaxunshear.config import configs
from jaxunshear.config.experiment import Experiment
from jaxunshear.data import sources
from jaxunshear.errors import UserError
from jaxunshear.files import hold_lock, read_json, write_json
from jaxunshear.sweep import tasks
from jaxunshear.training.checkpoint import load_best
from tests.golden import make_runs
from tests.helpers.reproducible import select_results

ROOT = Path(__file__).resolve().parents[1]
TINY = ROOT / "experiments" / "tiny.py"
SMALL = Experiment(name="small", claim="none")


def folders(place: Path, out: Path | None = None) -> list[str]:
    """Return the words that name the runs, and the data sets at `place`."""
    return ["--out", str(out or place / "runs"), "--data", str(place / "datasets")]


def run_command(place: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "jaxunshear", "run", str(TINY), *folders(place), *more]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder with the runs/ and datasets/ of a finished tiny experiment."""
    folder = tmp_path_factory.mktemp("full")
    words = run_command(folder, "--json", str(folder / "rows.json"))
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (folder / "printed.txt").write_text(done.stdout)
    return folder


def results(folder: Path) -> dict:
    return read_json(folder / "runs" / "tiny" / "results.json")


def test_results_bear_the_names_that_others_rely_on(finished):
    found = results(finished)
    shapes = {"disk", "clover", "teardrop", "overall"}
    for kind in ("sheared", "entangled", "disentangled"):
        assert set(found["ms_ssim"][kind]) == shapes
    for kind in ("tap", "sheared", "entangled", "disentangled"):
        assert set(found["pose_mae"][kind]) == {"x_mm", "yaw_deg", "edge_mm", "edge_deg"}
    assert {"swap", "pin_error", "time_s"} <= set(found) and found["simulated"] is True
    assert found["metric"]["ms_ssim"] == "ms_ssim@4"
    assert {"data", "entangled", "disentangled", "posenet", "evaluate"} <= set(found["time_s"])
    assert found["counts"]["test_poses"] == 6 and found["counts"]["dropped"] == 0
    assert 0 < found["ms_ssim"]["sheared"]["overall"] < 0.6
    measured = json.loads((finished / "rows.json").read_text())
    assert {"rows", "machine", "versions", "source", "command"} <= set(measured)
    assert set(found["trained_by"]) == {"entangled", "disentangled", "posenet"}
    assert measured["source"] == found["source"] == found["trained_by"]["posenet"]
    assert {"name", "value", "unit", "bar", "ok"} <= set(measured["rows"][0])


def test_golden_figures_of_a_run_over_images(finished):
    found = make_runs.collect_run(finished / "runs" / "tiny", finished / "datasets")
    make_runs.hold("run over simulated images", found)


def test_golden_figures_of_a_run_over_pins(finished, command):
    pins = "--name pins --unshear.input pins --networks disentangled,posenet"
    training = "--batch 6 --epochs 2 --validate_every 4 --learning_rate 0.001"
    words = f"{pins} {training.replace('--', '--train_pins.')}".split()
    answer = command("run", TINY, *folders(finished), *words)
    assert answer.code == 0, answer.err
    found = make_runs.collect_run(finished / "runs" / "pins", finished / "datasets")
    make_runs.hold("run over simulated pins", found)


def test_a_run_ends_with_what_fits_a_screen(finished):
    lines = (finished / "printed.txt").read_text().splitlines()
    (start,) = (place for place, line in enumerate(lines) if line.split()[:1] == ["ms_ssim@4"])
    shown = lines[start:]
    assert len(shown) <= 12 and shown[-1].endswith("report.html") and "results.json" in shown[-2]
    found = results(finished)
    (unsheared,) = (line for line in shown if line.startswith("unsheared, disentangled"))
    errors = found["pose_mae"]["disentangled"]
    values = (found["ms_ssim"]["disentangled"]["overall"], *errors.values())
    assert unsheared.split()[2:] == [f"{value:.3g}" for value in values]


def test_the_report_stands_alone(finished):
    page = (finished / "runs" / "tiny" / "report.html").read_text()
    assert "data:image/png;base64," in page and "http://" not in page and "https://" not in page


@pytest.mark.long
def test_leakage_of_networks_over_images(finished, command):
    run = finished / "runs" / "tiny"
    places = ("--data", finished / "datasets", "--json", finished / "leakage.json")
    answer = command("ablate", run, "--leakage", *places)
    assert answer.code == 0, answer.err
    found = json.loads((run / "leakage.json").read_text())
    assert found == json.loads((finished / "leakage.json").read_text())
    assert found["exchanged"] is None
    assert len(found["rows"]) == 16 and found["slides"] == {"learnt": 36, "tested": 12}
    assert (run / "leakage.png").stat().st_size > 10_000 and "slide from z_p" in answer.out


def test_a_second_run_keeps_all_work_and_all_numbers(finished, command):
    before = select_results(results(finished))
    summaries = list((finished / "runs" / "tiny").glob("*/summary.json"))
    trained = [path.stat().st_mtime_ns for path in summaries]
    assert len(trained) == 3
    answer = command("run", TINY, *folders(finished))
    assert answer.code == 0, answer.err
    assert select_results(results(finished)) == before
    assert trained == [path.stat().st_mtime_ns for path in summaries]


def test_another_experiment_is_not_mixed_in(finished, command):
    answer = command("train", TINY, *folders(finished), "--train.epochs", "3")
    assert answer.code == 2 and "train.epochs" in answer.err and answer.err.count("\n") == 1


@pytest.mark.parametrize("stage", ["train", "evaluate", "ablate"])
def test_networks_of_an_earlier_version_of_the_data_are_not_taken_for_todays(
    finished, command, tmp_path, stage
):
    out = shutil.copytree(finished / "runs", tmp_path / "runs")
    (out / "tiny" / "results.json").unlink()
    file = out / "tiny" / "disentangled" / "model.json"
    model = json.loads(file.read_text())
    write_json(file, model | {"origin": model["origin"] | {"version": "2.4.0"}})
    words = [out / "tiny"] if stage == "ablate" else [TINY, "--out", out]
    answer = command(stage, *words, "--data", finished / "datasets")
    assert answer.code == 2 and answer.err.count("\n") == 1
    assert "learnt from a data set with another version" in answer.err
    assert not any((out / "tiny" / name).exists() for name in ("results.json", "ablation.json"))


@pytest.mark.long
def test_a_network_is_taught_by_a_posenet_and_reported_poses(finished, command, tmp_path):
    """Results do not know that PoseNet; released weights hold no DS."""
    words = [TINY, *folders(finished, tmp_path)]
    words += ["--networks", "disentangled,posenet", "--train.losses.pose_label", 1]
    done = command("run", *words)
    assert done.code == 0, done.err
    folder = tmp_path / "tiny"
    logged = json.loads((folder / "disentangled" / "log.jsonl").read_text().splitlines()[-1])
    assert logged["train"]["pose_label"] > 0 and logged["validation"]["pose_label"] > 0
    teacher = json.loads((folder / "posenet_teacher" / "model.json").read_text())
    other = json.loads((folder / "posenet" / "model.json").read_text())
    assert teacher["seed"] != other["seed"] and teacher["net"] == other["net"]
    found = json.loads((folder / "results.json").read_text())
    assert "disentangled" in found["pose_mae"] and "disentangled" in found["ms_ssim"]
    assert "posenet_teacher" not in json.dumps(found["ms_per_image"])
    plain = (finished / "runs" / "tiny" / "disentangled" / "log.jsonl").read_text()
    assert "pose_label" not in json.loads(plain.splitlines()[-1])["train"]

    assert command("release", folder, "--out", tmp_path / "weights").code == 0
    with np.load(tmp_path / "weights" / "disentangled" / "weights.npz") as file:
        parts = {name.split(".")[1] for name in file if name.startswith("params.")}
    assert parts == {"E", "pose", "DC"}

    shutil.rmtree(folder / "disentangled")
    teacher["origin"]["version"] = "2.3.0"
    write_json(folder / "posenet_teacher" / "model.json", teacher)
    refused = command("train", *words, "--network", "disentangled")
    assert refused.code == 2
    assert "posenet_teacher learnt from a data set with another version" in refused.err


def test_a_training_goes_on_from_another_run(finished, command, tmp_path):
    """With so small a learning rate it stays there: equal but for the statistics' last digits."""
    words = [*folders(finished, tmp_path), "--networks", "disentangled,posenet"]
    words += ["--train.epochs", 1]
    begin = ["--train.start", finished / "runs" / "tiny", "--train.learning_rate", 1e-9]
    done = command("train", TINY, *words, *begin, "--network", "disentangled")
    assert done.code == 0, done.err
    source = finished / "runs" / "tiny" / "disentangled"
    before = load_best(source)["params"]
    after = load_best(tmp_path / "tiny" / source.name)["params"]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), before, after)
    older = shutil.copytree(source, tmp_path / "older" / source.name)
    model = json.loads((older / "model.json").read_text())
    del model["data"]
    write_json(older / "model.json", model)
    leaks = command("run", TINY, *words[:6], "--name", "leak", "--train.start", older.parent)
    assert leaks.code == 2 and f"{older} learnt from unknown data" in leaks.err
    assert leaks.err.count("\n") == 1 and not (tmp_path / "leak").exists()
    unknown = command("run", TINY, *words[:4], "--name", "other", "--train.start", "nowhere")
    assert unknown.code == 2 and "start: nowhere holds no" in unknown.err
    assert not (tmp_path / "other").exists()
    teacher = ("--train.losses.pose_tap", 0.1, "--train_teacher.start", "standard")
    refused = command("run", TINY, *words, *teacher)
    assert refused.code == 2 and "--train_teacher.start" in refused.err


def test_the_networks_take_images_of_people(finished, command, tmp_path):
    """Grey, colour and sixteen bits give images of the network's size, and a table of poses."""
    rows, columns = np.mgrid[:300, :300]
    inside = np.hypot(rows - 150, columns - 150) < 120
    grey = (((rows // 9 + columns // 9) % 2) * 180 * inside).astype(np.uint8)
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    Image.fromarray(grey).save(recordings / "a.png")
    Image.fromarray(np.stack([grey] * 3, -1)).save(recordings / "b.png")
    Image.fromarray(grey.astype(np.uint16) * 257).save(recordings / "c.png")
    out = tmp_path / "out"
    words = ("--force", "--model", finished / "runs" / "tiny", "--out", out)
    answer = command("unshear", recordings, *words)
    assert answer.code == 0, answer.err
    assert "simulat" in answer.out and "simulat" in (out / "NOTE.txt").read_text()
    assert len((out / "poses.csv").read_text().splitlines()) == 4
    for path in out.glob("*.png"):
        assert np.asarray(Image.open(path)).shape == (128, 128)


@pytest.fixture
def clock(monkeypatch):
    """Seconds, in a list of one, that have passed for whoever counts a stage's time."""
    passed = [0.0]
    monkeypatch.setattr(run, "time", SimpleNamespace(perf_counter=lambda: passed[0]))
    return passed


@pytest.fixture
def stage(tmp_path, monkeypatch, clock):
    """Return `stage(5, "stop")`: it runs a training of 5 s that stops, and returns times.json."""
    folder = tmp_path / "small" / "posenet"

    def act(seconds, ending):
        def train(current_run, network):
            if ending == "refuse":
                raise UserError("there is no data set")
            if (folder / "summary.json").exists():
                return False
            write_json(folder / "model.json", {})
            clock[0] += seconds
            if ending == "stop":
                raise KeyboardInterrupt
            write_json(folder / "summary.json", {})
            return True

        monkeypatch.setattr(run, "_train", train)
        with contextlib.suppress(KeyboardInterrupt, UserError):
            run.run_stages(SMALL, ("posenet",), tmp_path, tmp_path, "none")
        path = tmp_path / "small" / "times.json"
        return read_json(path) if path.exists() else {}

    return act


def test_a_stopped_stage_counts_all_of_its_time(stage, tmp_path):
    assert stage(0, "refuse") == {}
    assert stage(5, "stop") == {"posenet": 5}
    assert stage(7, "stop") == {"posenet": 12}
    assert stage(4, "finish") == {"posenet": 16}
    assert stage(9, "finish") == {"posenet": 16}  # there was nothing to do


@pytest.mark.parametrize("ending", ["stop", "finish"])
def test_a_stage_done_again_from_the_start_counts_anew(stage, tmp_path, ending):
    stage(5, ending)
    shutil.rmtree(tmp_path / "small" / "posenet")
    assert stage(3, "stop") == {"posenet": 3}
    assert stage(3, "finish") == {"posenet": 6}


def test_data_count_all_of_the_time_that_they_took(tmp_path, monkeypatch, clock):
    made = {
        name: configs.get_set_folder(getattr(SMALL, name), SMALL.sensor, tmp_path)
        for name in ("paired", "pose")
    }

    def make(*_):
        clock[0] += 5
        part = configs.get_unfinished_folder(SMALL.paired, SMALL.sensor, tmp_path)
        if not part.exists():
            part.mkdir(parents=True)
            raise KeyboardInterrupt
        for folder in made.values():
            folder.mkdir(parents=True)
        part.rmdir()
        return {}

    monkeypatch.setattr(sources.DataSource, "make_sets", make)
    for seconds in (5, 10):
        with contextlib.suppress(KeyboardInterrupt):
            run.run_stages(SMALL, ("data",), tmp_path, tmp_path, "none")
        assert read_json(tmp_path / "small" / "times.json") == {"data": seconds}
    for folder in made.values():
        shutil.rmtree(folder)
    with contextlib.suppress(KeyboardInterrupt):
        run.run_stages(SMALL, ("data",), tmp_path, tmp_path, "none")
    assert read_json(tmp_path / "small" / "times.json") == {"data": 5}


def test_two_runs_in_one_folder_are_refused(stage, tmp_path):
    folder = tmp_path / "small"
    with hold_lock(folder / run.LOCK, wait=False) as free:
        assert free
        with pytest.raises(UserError, match=f"another run is at work in {folder}"):
            run.run_stages(SMALL, ("posenet",), tmp_path, tmp_path, "none")
        assert [path.name for path in folder.iterdir()] == [run.LOCK]
    with hold_lock(folder / tasks.LOCK, wait=False) as free:  # as the worker of a row holds it
        assert free and stage(1, "finish") == {"posenet": 1}


# What a run writes, in this order.
WRITTEN = (
    *("runs/tiny/experiment.json", "datasets/.partial/tactip_paired-*/00000.npz"),
    *(f"datasets/tactip_{name}/tiny/*/metadata.json" for name in ("paired", "pose")),
    *(f"runs/tiny/entangled/{name}.json" for name in ("model", "summary")),
    *(f"runs/tiny/disentangled/{name}.json" for name in ("model", "summary")),
    *(f"runs/tiny/posenet/{name}.json" for name in ("model", "summary")),
)


@pytest.mark.long
def test_killed_ten_times_ends_with_the_same_numbers(finished, tmp_path):
    """Kill it within a second after it wrote each of `WRITTEN`, however fast the machine is."""
    pauses = random.Random(0)
    nowhere = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    for pattern in WRITTEN:
        process = subprocess.Popen(run_command(tmp_path), **nowhere, start_new_session=True)
        while not any(tmp_path.glob(pattern)):
            assert process.poll() is None, f"it ended without {pattern}"
            time.sleep(0.02)
        time.sleep(pauses.uniform(0, 1))
        assert process.poll() is None, f"it ended less than a second after {pattern}"
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    last = subprocess.run(run_command(tmp_path), capture_output=True, text=True)
    assert last.returncode == 0, last.stderr
    assert select_results(results(tmp_path)) == select_results(results(finished))


def test_a_refusal_before_any_work_binds_nobody(tmp_path):
    """What was asked for, and the lock, are all that it leaves: another seed may follow."""
    for seed in (0, 7):
        asked = replace(SMALL, seed=seed)
        with pytest.raises(UserError, match="no data set"):
            run.run_stages(asked, ("posenet",), tmp_path, tmp_path / "nowhere", "none")
        left = sorted(path.name for path in (tmp_path / SMALL.name).iterdir())
        assert left == ["experiment.json", "run.lock"]


def test_data_that_another_process_makes_bind_nobody(tmp_path):
    def idle(calls):
        pytest.fail("work that another process does")

    folder = configs.get_unfinished_folder(SMALL.paired, SMALL.sensor, tmp_path)
    with hold_lock(folder / "lock", wait=False):  # as that process would
        for seed in (0, 7):
            asked = replace(SMALL, seed=seed)
            with pytest.raises(UserError, match="another process"):
                run.run_stages(asked, ("data",), tmp_path, tmp_path, "none", idle)


@pytest.mark.parametrize(("more", "kept"), [(0, True), (1, False)])
def test_the_time_of_making_other_data_is_forgotten(tmp_path, more, kept):
    other = replace(SMALL, paired=replace(SMALL.paired, poses=SMALL.paired.poses + more))
    times = tmp_path / SMALL.name / "times.json"
    for asked in (SMALL, other):
        with pytest.raises(UserError, match="no data set"):
            run.run_stages(asked, ("posenet",), tmp_path, tmp_path / "nowhere", "none")
        if asked is SMALL:
            write_json(times, {"data": 1.0})
    assert times.exists() == kept
