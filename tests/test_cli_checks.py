"""The commands that examine the simulator: names, refusals, and files of rows."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import jaxunshear
from jaxunshear.cli import checks, main


def test_values_that_begin_with_a_minus_are_values():
    words = checks.joined(["plan", "--pose", "-1,0,0,2", "--level", "auto", "--move", "-.5,-2"])
    assert words == ["plan", "--pose=-1,0,0,2", "--level", "auto", "--move=-.5,-2"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("check plan --pose 1,2,3", "give 4 numbers"),
        ("check plan --move a,b", "give 2 numbers"),
        ("check plan --twist far", "invalid float value: 'far'"),
        ("check plan --stimulus pyramid", "stimulus 'pyramid' is unknown"),
        ("check plan --sensor finger", "sensor 'finger' is unknown"),
        ("check plan --level best", "--level"),
        ("check plan --pose nan,0,0,2", "not finite"),
        ("check plan --friction -1", "friction -1"),
        ("check plan --pose 0,0,0,15", "cannot be reached"),
        ("check plan --scenes 0", "--scenes 0"),
        (
            "check plan --scenes 10 --pose -1,0,0,3",
            "--pose: plan --scenes draws its own contacts; it takes --level, --sensor and --json",
        ),
        ("check bench", "what"),
        ("check bench sim --batch 0", "--batch 0"),
        ("check bench sim --size 128", "--size: bench sim has no use for it"),
        ("check bench stream --batch 8", "--batch: bench stream has no use for it; it takes --size and --json"),
        ("check bench train --out .", "--out: bench train has no use for it"),
        ("check stability --only nothing_like_this", "no case's name"),
        ("calibrate nowhere", "nowhere"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(words, said, capsys):
    assert main(words.split()) == 2
    line = capsys.readouterr().err.strip()
    assert said in line and "\n" not in line


@pytest.mark.long
def test_rows_are_written_with_command_and_machine(tmp_path, capsys):
    file = tmp_path / "plan.json"
    assert (
        main(["check", "plan", "--stimulus", "disk", "--pose", "-5,0,10,1.5", "--move", "0.5,0", "--json", str(file)])
        == 0
    )
    written = json.loads(file.read_text())
    assert written["command"].startswith("jaxunshear check plan") and written["rows"] and written["machine"]["cores"]
    assert "nodes" in capsys.readouterr().out


def test_a_calibration_writes_statistics_and_parameters(tmp_path, monkeypatch):
    rows = {"rows": [{"name": "pin spacing"}], "parameters": [{"name": "friction"}]}
    monkeypatch.setattr("jaxunshear.calibration.calibrate.calibrate", lambda recordings, out: rows)
    file = tmp_path / "calibration.json"
    assert main(["calibrate", "recordings", "--json", str(file)]) == 0
    assert json.loads(file.read_text())["rows"] == rows["rows"] + rows["parameters"]


def test_a_folder_cannot_be_the_file_of_rows(tmp_path, capsys):
    assert main(["check", "verify", "--json", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err
    (tmp_path / "file").touch()
    assert main(["check", "verify", "--json", str(tmp_path / "file" / "deeper" / "rows.json")]) == 2
    assert f"{tmp_path / 'file'} is a file" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", "recordings"),
        ("check", "identify"),
        ("check", "bench", "sim"),
        ("run", "experiments/tiny.py"),
        ("servo",),
    ],
)
def test_a_file_cannot_be_the_folder_of_results(tmp_path, capsys, words):
    (tmp_path / "file").touch()
    assert main([*words, "--out", str(tmp_path / "file")]) == 2
    assert f"--out {tmp_path / 'file'} is a file: name a folder" in capsys.readouterr().err
    assert main([*words, "--out", str(tmp_path / "file" / "deeper")]) == 2
    assert f"{tmp_path / 'file'} is a file: name another folder" in capsys.readouterr().err


def test_a_wheel_says_where_the_benchmarks_are(tmp_path):
    """A package that lacks what the wheel lacks."""
    package = tmp_path / "jaxunshear"
    package.mkdir()
    for part in Path(jaxunshear.__file__).parent.iterdir():
        if part.name != "benchmarks":
            (package / part.name).symlink_to(part)
    command = [sys.executable, "-m", "jaxunshear", "check", "bench", "data"]
    variables = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=variables, capture_output=True, text=True)
    assert done.returncode == 2 and "benchmarks come with a checkout alone" in done.stderr
    assert "Traceback" not in done.stderr
