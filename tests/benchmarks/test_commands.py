"""`python -m benchmarks` and `python -m verification`: refusals in one line, files of rows."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import commands
from jaxunshear.cli.program import RESTART

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("program", "words", "reason"),
    [
        ("benchmarks", "", "required: COMMAND; see `python -m benchmarks --help`"),
        ("benchmarks", "nets", "invalid choice: 'nets'"),
        ("benchmarks", "sim --batch 0", "--batch 0: use at least 1"),
        ("benchmarks", "train --size 0", "--size 0: use at least 1"),
        ("benchmarks", "pins --size 8", "--size 8: use 64 to 1024 px"),
        ("benchmarks", "pins --seed -1", "--seed -1: use at least 0"),
        ("benchmarks", "sim --size 128", "unrecognized arguments: --size 128"),
        ("benchmarks", "frame --batch 8", "unrecognized arguments: --batch 8"),
        ("benchmarks", "train --out .", "unrecognized arguments: --out ."),
        ("benchmarks", "sim --out setup.cfg/a", "is a file: name another folder"),
        ("verification", "stability --only nothing_like_this", "no name contains this"),
        ("verification", "verify --json .", "is a folder"),
        ("verification", "", "required: COMMAND; see `python -m verification --help`"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    request, monkeypatch, tmp_path, program, words, reason
):
    monkeypatch.chdir(tmp_path)
    Path("setup.cfg").touch()
    answer = request.getfixturevalue(program)(*words.split())
    assert (answer.code, answer.err.count("\n")) == (2, 1)
    assert reason in answer.err


@pytest.mark.parametrize(
    ("words", "reason"), [("benchmarks sim --batch 0", "--batch 0"), ("verification", "")]
)
def test_they_are_run_as_modules(words, reason):
    command = [sys.executable, "-m", *words.split()]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith(f"jaxunshear: error: {reason}")


def test_an_interrupt_promises_nothing(monkeypatch, verification):
    def stop(progress):
        raise KeyboardInterrupt

    monkeypatch.setattr("verification.verify.run_verification", stop)
    answer = verification("verify")
    assert (answer.code, answer.err) == (130, f"stopped; {RESTART}\n")


def test_each_command_has_its_own_help(benchmarks):
    shown = benchmarks("--help").out
    for name, benchmark in commands.COMMANDS.items():
        text = benchmarks(name, "--help").out
        assert f"  {name}" in shown and "--json" in text
        assert ("--size" in text) == ("size" in benchmark.options)


def test_rows_are_written_with_the_command_and_the_rivals_versions(
    benchmarks, monkeypatch, tmp_path
):
    rows, asked, file = [{"name": "one", "seconds": 1.0}], [], tmp_path / "rows.json"
    monkeypatch.setattr("benchmarks.bench_networks.bench_train", lambda size, batch: rows)
    monkeypatch.setattr("benchmarks.bench_networks.format_table", lambda rows: "a table")
    monkeypatch.setattr(
        "jaxunshear.results.provenance.list_versions",
        lambda *more: asked.append(more) or {"python": "3"},
    )
    answer = benchmarks("train", "--size", "64", "--json", file)
    written = json.loads(file.read_text())
    assert (answer.code, answer.out) == (0, "a table\ndevice: cpu: cpu\n")
    assert asked == [("torch",)]
    assert written["rows"] == rows
    assert written["command"] == f"python -m benchmarks train --size 64 --json {file}"
