"""What one command writes never replaces what a run, a sweep, a data set or weights live on."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxunshear.output_checks import check_outside, find_owner

ROOT = Path(__file__).resolve().parents[1]
WEIGHTS = ROOT / "jaxunshear" / "weights" / "standard"
ROWS = {"rows": [], "machine": {}, "versions": {}}


def place(folder: Path, mark: str, held: object) -> Path:
    folder.mkdir(parents=True)
    (folder / mark).write_text(json.dumps(held))
    return folder


@pytest.fixture
def run(tmp_path):
    return place(tmp_path / "runs" / "demo", "experiment.json", {"unshear": {}})


def test_owners_are_known_by_what_they_hold(tmp_path, run):
    sweep = place(tmp_path / "sweep", "sweep.json", {"cells": []})
    stored = place(tmp_path / "set" / "1.0.0", "shards.json", {})
    other = place(tmp_path / "other", "experiment.json", {"a": "stranger's"})
    (tmp_path / "link").symlink_to(run)
    for folder in (run, sweep, stored, WEIGHTS):
        assert find_owner(folder / "a" / "b.json")[0] == folder
    assert find_owner(tmp_path / "link" / "new.json")[0] == find_owner(run)[0] == run
    assert find_owner(other / "a.json") is find_owner(run.parent) is None
    check_outside(run.parent / "rows.json", "--json")


@pytest.mark.parametrize(
    "words",
    [
        ("evaluate", "RUN", "--json", "RUN/results.json"),
        ("stream", "RUN", "--lines", "RUN/times.json"),
        ("stream", "camera:9", "--images", "RUN"),
        ("unshear", "RUN", "--out", "RUN"),
        ("servo", "--out", "RUN"),
        ("sensors", "draw", "tactip331", "--out", "RUN/montage.png"),
        ("release", "RUN", "--out", "RUN/disentangled"),
        (*("run", "experiments/demo.py", "--out", "RUN/.."), "--json", "RUN/../demo/results.json"),
        (*("sweep", "experiments/frontier.py", "--out", "RUN/.."), "--json", "RUN/../frontier/a"),
    ],
)
def test_results_go_elsewhere(command, run, monkeypatch, words):
    monkeypatch.chdir(ROOT)
    (run / "times.json").write_text("")
    before = sorted(run.parent.rglob("*"))
    answer = command(*(word.replace("RUN", str(run)) for word in words))
    assert (answer.code, answer.err.count("\n")) == (2, 1), answer.err
    assert "files of its own" in answer.err or "its own files" in answer.err
    assert sorted(run.parent.rglob("*")) == before


def test_only_what_a_command_measured_is_written_anew(command, tmp_path):
    image, file = tmp_path / "image.png", tmp_path / "rows.json"
    Image.fromarray(np.eye(64, dtype=np.uint8) * 255).save(image)
    for held in ('{"name": "package"}', "{", "[1, 2]", "7"):
        file.write_text(held)
        answer = command("doctor", image, "--json", file)
        assert answer.code == 2 and "holds something else" in answer.err
        assert file.read_text() == held
    file.write_text(json.dumps(ROWS, indent=2))
    for _ in range(2):
        assert command("doctor", image, "--json", file).code == 0
    same = tmp_path / "a" / ".." / "rows.json"
    answer = command("validate", tmp_path, "--calibration", file, "--json", same)
    assert answer.code == 2 and "also what this command reads" in answer.err
