"""`python -m benchmarks`: options of each command, refusals in one line, files of rows."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import commands

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("", "required: COMMAND; see `python -m benchmarks --help`"),
        ("nets", "invalid choice: 'nets'"),
        ("sim --batch 0", "--batch 0: use at least 1"),
        ("train --size 0", "--size 0: use at least 1"),
        ("pins --size 8", "--size 8: use 64 to 1024 px"),
        ("pins --seed -1", "--seed -1: use at least 0"),
        ("sim --size 128", "unrecognized arguments: --size 128"),
        ("stream --batch 8", "unrecognized arguments: --batch 8"),
        ("train --out .", "unrecognized arguments: --out ."),
        ("sim --out setup.cfg/a", "is a file: name another folder"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(benchmarks, monkeypatch, tmp_path, words, reason):
    monkeypatch.chdir(tmp_path)
    Path("setup.cfg").touch()
    answer = benchmarks(*words.split())
    assert (answer.code, answer.err.count("\n")) == (2, 1)
    assert reason in answer.err


def test_each_command_has_its_own_help(benchmarks):
    shown = benchmarks("--help").out
    for name, benchmark in commands.COMMANDS.items():
        text = benchmarks(name, "--help").out
        assert f"  {name}" in shown and "--json" in text
        assert ("--size" in text) == ("size" in benchmark.options)


def test_rows_are_written_with_the_command_and_the_rivals_versions(
    benchmarks, monkeypatch, tmp_path
):
    rows = [{"name": "one", "seconds": 1.0}]
    asked = []

    def list_versions(*more):
        asked.append(more)
        return {"python": "3"}

    monkeypatch.setattr("benchmarks.bench_networks.bench_train", lambda size, batch: rows)
    monkeypatch.setattr("benchmarks.bench_networks.format_table", lambda rows: "a table")
    monkeypatch.setattr("jaxunshear.results.provenance.list_versions", list_versions)
    file = tmp_path / "rows.json"
    answer = benchmarks("train", "--size", "64", "--json", file)
    written = json.loads(file.read_text())
    assert (answer.code, answer.out) == (0, "a table\n") and asked == [("torch",)]
    assert written["rows"] == rows
    assert written["command"] == f"python -m benchmarks train --size 64 --json {file}"


def test_it_is_run_as_a_module():
    words = [sys.executable, "-m", "benchmarks", "sim", "--batch", "0"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith("jaxunshear: error: --batch 0")
