"""A sweep of the smallest real networks: killed, it ends with the table of a full one."""

import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from jaxunshear.results.record_files import read_record
from jaxunshear.results.sweep import SweepResult
from tests.helpers.reproducible import select_sweep

ROOT = Path(__file__).resolve().parents[2]
TEXT = f"""
from jaxunshear.config.load import load_experiment
from jaxunshear.config.sweep import Sweep

sweep = Sweep(
    name="small",
    claim="none",
    base=load_experiment({str(ROOT / "experiments" / "tiny.py")!r}),
    grid=(("train.losses.patch", (0.0, 0.1)),),
    networks=("disentangled", "posenet"),
    ablation=True,
)
"""


def start(folder: Path) -> subprocess.Popen:
    file, data = folder.parent / "small.py", folder.parent / "datasets"
    file.write_text(TEXT)
    words = [sys.executable, "-m", "jaxunshear", "sweep", file, "--out", folder, "--data", data]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL)


def summary(folder: Path) -> SweepResult:
    return read_record(folder / "small" / "sweep.json", SweepResult, "again")


@pytest.mark.long
def test_killed_at_any_time_it_ends_with_the_same_table(tmp_path):
    assert start(tmp_path / "full").wait() == 0
    full = summary(tmp_path / "full")
    assert [list(cell.seeds) for cell in full.cells[:2]] == [[0], [0]]
    assert full.reference == "patch=0.1"
    assert {"ms_ssim/disentangled", "pose/disentangled/edge_mm"} <= set(full.cells[0].difference)
    shared = tmp_path / "full" / "small" / "shared"
    assert len(list(shared.glob("posenet*/posenet/summary.json"))) == 1
    moments = random.Random(0)
    kills = 0
    while kills < 5:
        process = start(tmp_path / "killed")
        try:
            process.wait(timeout=moments.uniform(8, 30))
            break
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            kills += 1
    assert start(tmp_path / "killed").wait() == 0
    assert kills >= 2
    assert select_sweep(summary(tmp_path / "killed")) == select_sweep(full)
