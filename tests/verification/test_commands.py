"""`python -m verification`: refusals in one line, exit codes, and that it runs as a module."""

import subprocess
import sys
from pathlib import Path

import pytest

from jaxunshear.cli.program import RESTART

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("stability --only nothing_like_this", "no case's name"),
        ("verify --json .", "is a folder"),
        ("", "required: COMMAND; see `python -m verification --help`"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(verification, words, reason):
    answer = verification(*words.split())
    assert (answer.code, answer.err.count("\n")) == (2, 1)
    assert reason in answer.err


def test_an_interrupt_promises_nothing(monkeypatch, verification):
    def stop(progress):
        raise KeyboardInterrupt

    monkeypatch.setattr("verification.verify.run_verification", stop)
    answer = verification("verify")
    assert (answer.code, answer.err) == (130, f"stopped; {RESTART}\n")


def test_it_is_run_as_a_module():
    words = [sys.executable, "-m", "verification"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith("jaxunshear: error: ")
