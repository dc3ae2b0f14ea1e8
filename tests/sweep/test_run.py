"""Sweeps of made-up networks in real processes: nothing is done twice, and nothing is lost."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxunshear.code_version import read_source
from jaxunshear.config.serialization import from_json
from jaxunshear.data.sources import open_source
from jaxunshear.errors import UserError
from jaxunshear.files import hold_lock, read_json, to_builtins, write_json
from jaxunshear.results.record_files import SCHEMA, convert_record
from jaxunshear.results.sweep import SweepResult
from jaxunshear.sweep import plan
from jaxunshear.sweep.grid import list_cells, list_rows
from jaxunshear.sweep.summary import format_table
from jaxunshear.sweep.tasks import LOCK, TASK
from tests.helpers.reproducible import select_sweep

WEIGHTS = Path(__file__).resolve().parents[2] / "jaxunshear" / "weights"
PATCHES = (("train.losses.patch", (0.0, 0.1)),)


def rows(tmp_path: Path) -> dict[str, dict]:
    found = (tmp_path / "small" / "rows").glob("*/row.json")
    return {path.parent.name: read_json(path) for path in found}


def count_trained(steps: Counter, network: str) -> int:
    """How many trainings of a network did a step."""
    return len({name for name, _ in steps if name.startswith(network)})


@pytest.fixture
def one_cell(stand_in):
    """A sweep of one cell and one seed."""
    return replace(stand_in.SWEEP, grid=(("train.losses.patch", (0.1,)),), seeds=(0,))


def test_every_row_is_done_once_and_what_rows_share_is_trained_once(
    stand_in, swept, steps, tmp_path
):
    summary = swept(stand_in.SWEEP)
    assert [len(cell.seeds) for cell in summary.cells] == [2, 2, 2, 2]
    stored = json.loads(json.dumps(to_builtins(summary)))
    assert read_json(tmp_path / "small" / "sweep.json") == {"schema": SCHEMA} | stored
    assert (tmp_path / "small" / "sweep.png").exists()
    assert {(found.version, found.date) for found in summary.sources} == {
        ("0", "2000-01-01"),  # that trained
        (read_source().version, read_source().date),
    }
    assert set(steps().values()) == {1}
    assert count_trained(steps(), "posenet") == 2  # a seed each
    assert count_trained(steps(), "disentangled") == 8
    found = rows(tmp_path)
    (name,) = [name for name in found if "patch-0.1" in name and "8-120_seed-1" in name]
    row = found[name]
    assert (row["status"], row["reason"], row["seed"]) == ("done", None, 1)
    assert row["label"] == "patch=0.1, pose_channels:shear_channels=8:120"
    assert row["settings"]["train"]["losses"]["patch"] == 0.1 and row["settings"]["seed"] == 1
    assert set(row["train_seconds"]) == set(row["images_per_second"]) == {"disentangled", "posenet"}
    assert row["results"]["metric"] and row["ablation"][0]["name"] == "DS(z_p,0)"
    assert row["wall_seconds"] > 0 and 1e6 < row["peak_memory_bytes"] < 1e11 and row["host"]


def test_a_second_time_nothing_is_done(stand_in, swept, steps, tmp_path):
    def list_times():
        found = (tmp_path / "small" / "rows").rglob("*")
        return {path: path.stat().st_mtime_ns for path in found}

    sweep = replace(stand_in.SWEEP, grid=PATCHES, seeds=(0,))
    first = swept(sweep)
    done, times = steps(), list_times()
    assert swept(sweep) == first and steps() == done and list_times() == times


def test_weights_that_may_know_the_test_are_refused_before_any_row(
    stand_in, swept, steps, tmp_path
):
    weights = WEIGHTS / "standard" / "disentangled"
    older = shutil.copytree(weights, tmp_path / "older" / "disentangled")
    model = read_json(older / "model.json")
    del model["data"]
    write_json(older / "model.json", model)
    axis = ("train.start", ("", str(older.parent)))
    with pytest.raises(UserError, match="older/disentangled learnt from unknown data"):
        swept(replace(stand_in.SWEEP, grid=(axis,), seeds=(0,)))
    assert not steps() and not rows(tmp_path)


@pytest.mark.long
def test_more_cells_seeds_and_other_labels_keep_the_rows_that_are_there(one_cell, swept, steps):
    swept(one_cell)  # trains its PoseNet in the row: no other needs it yet
    assert sum(steps().values()) == 20
    swept(replace(one_cell, grid=PATCHES))
    assert sum(steps().values()) == 30  # the new cell's disentangled network
    labelled = ((), (("train.batch", 8),))  # () is the base: 0.1 by another label
    swept(replace(one_cell, grid=(), rows=labelled, seeds=(0, 1)))
    assert set(steps().values()) == {1}
    assert sum(steps().values()) == 30 + 10 + (10 + 10) + 10


@pytest.mark.parametrize(
    "damaged",
    ["version", "{", *(pytest.param(damage, marks=pytest.mark.long) for damage in ("[]", None))],
)
def test_trainings_of_another_version_or_with_a_damaged_model_are_not_used_again(
    one_cell, swept, steps, tmp_path, damaged
):
    swept(one_cell)
    (path,) = (tmp_path / "small" / "rows").glob("*/posenet/model.json")
    if damaged == "version":
        write_json(path, {"origin": read_json(path)["origin"] | {"version": "0.9.0"}})
    elif damaged:
        path.write_text(damaged)
    else:
        path.unlink()
    before = steps()
    swept(replace(one_cell, grid=PATCHES))
    again = [name for name, _ in steps() - before]
    assert sum(name.startswith("posenet") for name in again) == 10


@pytest.mark.long
def test_a_training_that_lost_its_checkpoints_is_the_one_to_delete(one_cell, swept, tmp_path):
    more = replace(one_cell, grid=PATCHES)
    swept(one_cell)
    (lost,) = (tmp_path / "small" / "rows").glob("*/posenet/checkpoint.json")
    lost.unlink()
    (failed,) = (cell.failures[0].reason for cell in swept(more).cells if cell.failures)
    assert f"{lost.parent} has lost its checkpoints: delete that folder, then " in failed
    assert "then run the same command with --retry" in failed
    shutil.rmtree(lost.parent)
    assert not any(cell.failures for cell in swept(more, retry_failed=True).cells)


def test_a_teacher_that_rows_share_is_trained_once(stand_in, swept, steps):
    losses = {**stand_in.BASE.train.losses, "pose_tap": 0.1}
    taught = replace(stand_in.BASE, train=replace(stand_in.BASE.train, losses=losses))
    grid = (("networks", (("disentangled", "posenet"), ("disentangled",))),)
    swept(replace(stand_in.SWEEP, base=taught, grid=grid, seeds=(0,)))
    assert set(steps().values()) == {1}
    trained = sorted(name.partition("_seed")[0] for name, step in steps() if step == "0")
    assert trained == ["disentangled", "posenet", "posenet_teacher"]


@pytest.mark.long
def test_memory_is_that_of_the_trainings_too(stand_in, swept, tmp_path):
    sweep = replace(stand_in.SWEEP, grid=PATCHES, seeds=(0,))
    swept(sweep)
    (path,) = (tmp_path / "small" / "shared").glob("posenet*/training.json")
    write_json(path, read_json(path) | {"peak_memory_bytes": 10**15})
    for row in (tmp_path / "small" / "rows").glob("*"):
        shutil.rmtree(row)
    assert {cell.costs["0"].peak_memory_bytes for cell in swept(sweep).cells} == {10**15}


@pytest.mark.long
def test_a_picture_of_other_rows_does_not_stay(stand_in, swept, tmp_path):
    sweep = replace(stand_in.SWEEP, seeds=(0,))
    swept(sweep)
    assert (tmp_path / "small" / "sweep.png").exists()
    swept(replace(sweep, grid=(*sweep.grid, ("train.batch", (16,)))))
    assert not (tmp_path / "small" / "sweep.png").exists()


@pytest.mark.parametrize("contacts", [24, 22])
def test_seeds_that_were_tested_on_different_contacts_are_refused(
    stand_in, swept, tmp_path, contacts
):
    sweep = replace(stand_in.SWEEP, grid=())
    swept(sweep)
    path = next((tmp_path / "small" / "rows").glob("*seed-1*/scores.npz"))
    with np.load(path) as file:
        scores = {name: values[:contacts].copy() for name, values in file.items()}
    scores["pose_id"][0] += 1
    np.savez(path, **scores)
    with pytest.raises(UserError, match=r"tested on different contacts .*delete both"):
        swept(sweep)


def test_data_are_made_once_and_for_a_teacher_too(stand_in, tmp_path):
    grid = (("train.losses.pose_tap", (0.1, 1.0)),)
    sweep = replace(stand_in.SWEEP, grid=grid, seeds=(0,), networks=("disentangled",))
    order = list(list_rows(sweep, list_cells(sweep)).values())
    task = plan.make_data_task(tmp_path, order, tmp_path)
    (made,) = read_json(task.folder / TASK)["experiments"]
    assert set(open_source(from_json(made)).list_sets()) == {"tactip_paired", "tactip_pose"}


def test_a_shared_training_keeps_the_settings_that_it_began_with(stand_in, tmp_path):
    """The same sweep may go on with its rows in another order."""
    sweep = replace(stand_in.SWEEP, grid=PATCHES, seeds=(0,))
    order = list(list_rows(sweep, list_cells(sweep)).values())
    shared = []
    for each in (order, order[::-1]):
        (task, *_) = plan.plan_tasks(tmp_path, each, False, tmp_path, "none")
        shared.append((task.folder, read_json(task.folder / TASK)["experiment"]))
    assert shared[0] == shared[1] and shared[0][0].name.startswith("posenet_seed-0-")


def test_a_failed_row_is_reported_left_alone_and_tried_again_when_asked(
    stand_in, swept, steps, tmp_path
):
    rates = {
        0.5: "training disentangled stopped: supervised not finite at step 5",
        0.25: "killed by signal 9",
        0.125: "ZeroDivisionError: a bug of two lines",
    }
    sweep = replace(stand_in.SWEEP, grid=(("train.learning_rate", (0.001, *rates)),), seeds=(0,))
    summary = swept(sweep)
    assert [len(cell.failures) for cell in summary.cells] == [0, 1, 1, 1]
    for cell, reason in zip(summary.cells[1:], rates.values(), strict=True):
        assert cell.failures[0].reason.startswith(reason) and cell.metrics == {}
        assert f"failed: {cell.label}, seed 0: {reason}" in format_table(summary)
    assert {row["status"] for row in rows(tmp_path).values()} == {"done", "failed"}
    assert all(row["settings"]["seed"] == row["seed"] == 0 for row in rows(tmp_path).values())
    log = next((tmp_path / "small" / "rows").glob("learning_rate-0.125*")) / "log.txt"
    assert "ZeroDivisionError" in log.read_text()
    done = steps()
    assert swept(sweep) == summary and steps() == done
    assert swept(sweep, retry_failed=True).cells[1:] == summary.cells[1:]
    tried = steps() - done
    assert sum(tried.values()) == 3
    assert {step for _, step in tried} == {"5"}  # each from its checkpoint


@pytest.mark.parametrize("shared", [False, True])
def test_a_full_disk_stops_the_sweep_and_the_same_command_goes_on(
    stand_in, swept, steps, tmp_path, monkeypatch, shared
):
    base = replace(stand_in.BASE, train=replace(stand_in.BASE.train, learning_rate=1 / 16))
    grid = (("posenet.hidden", (8, 16) if shared else (8,)),)
    sweep = replace(stand_in.SWEEP, base=base, grid=grid, seeds=(0,))
    monkeypatch.setenv("STAND_IN_FULL", "1")
    with pytest.raises(UserError, match=r"the disk is full; .* run the same command$"):
        swept(sweep)
    assert rows(tmp_path) == {}
    monkeypatch.delenv("STAND_IN_FULL")
    assert not any(cell.failures for cell in swept(sweep).cells)
    assert steps().total() == 1 + 10 * (1 + len(sweep.grid[0][1]))  # goes on from its checkpoint


@pytest.mark.long
def test_a_shared_training_that_fails_fails_its_rows_with_its_reason(stand_in, swept, steps):
    base = replace(stand_in.BASE, train=replace(stand_in.BASE.train, learning_rate=0.5))
    sweep = replace(stand_in.SWEEP, base=base, grid=(("posenet.hidden", (8, 16)),), seeds=(0,))
    summary = swept(sweep)
    reasons = [cell.failures[0].reason for cell in summary.cells]
    reason = (
        "its disentangled, which other rows share, failed: training disentangled stopped: "
        "supervised not finite at step 5"
    )
    assert reasons == [reason] * 2
    assert sum(steps().values()) == 6
    swept(sweep, retry_failed=True)
    assert sum(steps().values()) == 7


@pytest.mark.long
def test_a_deleted_shared_training_is_made_again(stand_in, swept, tmp_path):
    sweep = replace(stand_in.SWEEP, grid=(("train.losses.patch", (0.0, 1.0)),), seeds=(0,))
    first = swept(sweep)
    folder = tmp_path / "small"
    for path in [*(folder / "rows").iterdir(), *(folder / "shared").glob("*/posenet")]:
        shutil.rmtree(path)
    assert select_sweep(swept(sweep)) == select_sweep(first)


def test_two_sweeps_in_one_folder_are_refused(stand_in, swept, tmp_path):
    with hold_lock(tmp_path / "small" / LOCK, wait=False) as free:
        assert free
        with pytest.raises(UserError, match="another sweep is at work"):
            swept(stand_in.SWEEP)


def test_a_worker_waits_for_the_one_before_it_and_does_nothing_twice(
    stand_in, swept, steps, tmp_path
):
    sweep = replace(stand_in.SWEEP, grid=(), seeds=(0,))
    swept(sweep)
    (folder,) = (tmp_path / "small" / "rows").iterdir()
    (folder / "row.json").rename(tmp_path / "kept.json")
    done = steps()
    with hold_lock(folder / LOCK, wait=False) as free:
        assert free
        process = subprocess.Popen([*stand_in.WORKER, str(folder), str(os.getpid())])
        time.sleep(1)
        assert process.poll() is None
        (tmp_path / "kept.json").rename(folder / "row.json")
    assert process.wait(timeout=20) == 0 and steps() == done


def test_a_worker_whose_sweep_has_ended_does_nothing(stand_in, tmp_path):
    done = subprocess.run([*stand_in.WORKER, str(tmp_path), "1"], capture_output=True, text=True)
    assert done.returncode != 0 and "the sweep has ended" in done.stderr


def test_data_sets_that_cannot_be_made_stop_the_sweep(stand_in, tmp_path):
    from jaxunshear.sweep.run import run_sweep

    bad = (
        "import sys\n"
        "from pathlib import Path\n"
        "from jaxunshear.errors import UserError\n"
        "from jaxunshear.sweep import worker\n"
        "def make(*_): raise UserError('no room')\n"
        "worker._make_data = make\n"
        "worker.main(Path(sys.argv[1]), int(sys.argv[2]))\n"
    )
    with pytest.raises(UserError, match="no room"):
        run_sweep(stand_in.SWEEP, tmp_path, tmp_path, "none", worker=(sys.executable, "-c", bad))
    assert rows(tmp_path) == {}


def test_scores_that_are_missing_or_damaged_are_one_line(stand_in, swept, tmp_path):
    sweep = replace(stand_in.SWEEP, grid=(), seeds=(0,))
    swept(sweep)
    (path,) = (tmp_path / "small" / "rows").glob("*/scores.npz")
    path.write_bytes(b"nonsense")
    with pytest.raises(UserError, match=r"scores\.npz is damaged"):
        swept(sweep)
    path.unlink()
    with pytest.raises(UserError, match=r"cannot read .*scores\.npz"):
        swept(sweep)


def workers_of(folder: Path) -> list[int]:
    """Processes whose command line names something in `folder`."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if str(folder).encode() in path.read_bytes():
                found.append(int(path.parent.name))
        except OSError:
            continue  # it has just ended
    return found


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for processes in /proc")
@pytest.mark.parametrize(
    ("kill", "times"),
    [
        (signal.SIGKILL, 2),
        pytest.param(signal.SIGKILL, 5, marks=pytest.mark.long),
        pytest.param(signal.SIGINT, 5, marks=pytest.mark.long),
    ],
)
def test_killed_again_and_again_it_ends_with_the_same_table(stand_in, tmp_path, kill, times):
    def start(folder: Path, pause: float) -> subprocess.Popen:
        words = [*stand_in.WORKER, "sweep", str(folder)]
        settings = os.environ | {"STAND_IN_PAUSE": str(pause)}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        return subprocess.Popen(words, env=settings, **pipes)

    undisturbed = start(tmp_path / "full", 0)
    entire, _ = undisturbed.communicate()
    assert undisturbed.returncode == 0
    moments = random.Random(int(kill))
    kills = 0
    while kills < times:
        process = start(tmp_path / "killed", 0.1)
        time.sleep(moments.uniform(1.0, 1.8))
        if process.poll() is not None:
            break
        process.send_signal(kill)
        process.communicate()
        kills += 1
        gone = time.monotonic() + 5
        while workers_of(tmp_path / "killed") and time.monotonic() < gone:
            time.sleep(0.02)
        assert workers_of(tmp_path / "killed") == []  # no row runs on by itself
    assert kills == times
    last = start(tmp_path / "killed", 0)
    killed, _ = last.communicate()
    assert last.returncode == 0
    ended = []
    for text in (killed, entire):
        record = convert_record(json.loads(text), SweepResult, "its output", "again")
        ended.append(select_sweep(record))
    assert ended[0] == ended[1]
    pictures = [tmp_path / name / "small" / "sweep.png" for name in ("killed", "full")]
    assert pictures[0].read_bytes() == pictures[1].read_bytes()
    lines = (tmp_path / "killed" / "data" / "steps.txt").read_text().splitlines()
    # at most the step that each kill interrupted is done again
    assert 0 <= len(lines) - len(set(lines)) <= kills


def test_figures_of_equal_settings_are_equal_numbers(stand_in, swept):
    """Bit for bit: with a shared training, with one reused from a row, or with its own."""
    sweep = replace(stand_in.SWEEP, grid=PATCHES, seeds=(0,))
    grid = swept(sweep)
    alone = swept(replace(sweep, name="alone", grid=(), rows=((("train.losses.patch", 0.0),),)))
    assert alone.cells[0].metrics == grid.cells[0].metrics
    assert np.isfinite(alone.cells[0].metrics["ms_ssim/disentangled"].mean)
