"""`python -m verification`: refusals in one line, files of rows with command and machine."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from jaxunshear.cli.program import RESTART
from verification import commands

ROOT = Path(__file__).resolve().parents[2]


def test_values_that_begin_with_a_minus_are_values():
    words = commands.join_numbers(
        ["plan", "--pose", "-1,0,0,2", "--level", "auto", "--move", "-.5,-2"]
    )
    assert words == ["plan", "--pose=-1,0,0,2", "--level", "auto", "--move=-.5,-2"]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("plan --pose 1,2,3", "give 4 numbers"),
        ("plan --move a,b", "give 2 numbers"),
        ("plan --twist far", "invalid float value: 'far'"),
        ("plan --stimulus pyramid", "stimulus 'pyramid' is unknown"),
        ("plan --sensor finger", "sensor 'finger' is unknown"),
        ("plan --level best", "--level"),
        ("plan --pose nan,0,0,2", "not finite"),
        ("plan --friction -1", "friction -1"),
        ("plan --pose 0,0,0,15", "cannot be reached"),
        ("plan --scenes 0", "--scenes 0"),
        (
            "plan --scenes 10 --pose -1,0,0,3",
            "--pose: plan --scenes draws its own contacts; it takes --level, --sensor and --json",
        ),
        ("stability --only nothing_like_this", "no case's name"),
        ("", "required: COMMAND; see `python -m verification --help`"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(verification, words, reason):
    answer = verification(*words.split())
    assert (answer.code, answer.err.count("\n")) == (2, 1)
    assert reason in answer.err


def test_files_that_would_be_lost_are_refused_in_one_line(verification, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "experiment.json").write_text('{"unshear": {}}')
    (tmp_path / "a").symlink_to("a")
    for file, reason in (
        (".", "is a folder"),
        ("run/b", "files of its own"),
        ("a/b", "is a file"),
    ):
        answer = verification("verify", "--json", tmp_path / file)
        assert (answer.code, answer.err.count("\n")) == (2, 1)
        assert reason in answer.err


def test_an_interrupt_promises_nothing(monkeypatch, verification):
    def stop(progress):
        raise KeyboardInterrupt

    monkeypatch.setattr("verification.verify.run_verification", stop)
    answer = verification("verify")
    assert (answer.code, answer.err) == (130, f"stopped; {RESTART}\n")


@pytest.mark.long
def test_rows_are_written_with_command_and_machine(verification, tmp_path):
    file = tmp_path / "plan.json"
    pose, move = ("--pose", "-5,0,10,1.5"), ("--move", "0.5,0")
    answer = verification("plan", "--stimulus", "disk", *pose, *move, "--json", file)
    written = json.loads(file.read_text())
    assert answer.code == 0 and "nodes" in answer.out
    assert written["command"].startswith("python -m verification plan --stimulus disk")
    assert written["rows"] and written["machine"]["cores"] and "torch" not in written["versions"]


def test_it_is_run_as_a_module():
    words = [sys.executable, "-m", "verification", "stability", "--only", "nothing_like_this"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith("jaxunshear: error: ")
