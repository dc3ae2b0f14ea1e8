"""`jaxunshear sweep`: what it passes on, prints, refuses and returns."""

import json
from pathlib import Path

import pytest

from jaxunshear import cluster
from jaxunshear.results.sweep import CellResult, Failure, SweepResult
from jaxunshear.sweep import run

ROOT = Path(__file__).resolve().parents[1]
LAMBDA, TINY = (ROOT / "experiments" / name for name in ("ablations/lambda_split.py", "tiny.py"))


@pytest.fixture
def calls(monkeypatch):
    """Return calls of `run_sweep`, which has one cell; a sweep's name says if that fails."""
    found = []

    def run_sweep(sweep, *words):
        found.append((sweep, *words))
        failures = [Failure(0, "killed by signal 9")] if sweep.name == "failing" else []
        cell = CellResult(label="base", point=None, seeds=[0], failures=failures)
        spread = {"over": "test poses of one training"}
        return SweepResult(sweep=sweep.name, cells=[cell], seeds=[0], spread=spread, reference=None)

    monkeypatch.setattr(run, "run_sweep", run_sweep)
    return found


def test_options_and_fields_arrive(calls, command, tmp_path):
    words = ["--seeds", "3,4", "--retry-failed", "--train.epochs", "2", "--data=sets"]
    places = ["--out", tmp_path, "--json", tmp_path / "found.json"]
    answer = command("sweep", LAMBDA, *words, *places)
    assert (answer.code, answer.err) == (0, "")
    assert answer.out.splitlines()[-1] == str(tmp_path / "lambda_split" / "sweep.json")
    ((sweep, out, data, typed, run_calls, retry),) = calls
    assert (sweep.seeds, sweep.base.train.epochs, len(sweep.grid)) == ((3, 4), 2.0, 2)
    assert (out, data, run_calls, retry) == (tmp_path, Path("sets"), cluster.run_locally, True)
    assert typed.startswith("jaxunshear sweep ") and "--retry-failed" in typed
    assert json.loads((tmp_path / "found.json").read_text())["cells"]


def test_an_ordinary_experiment_with_seeds(calls, command):
    assert command("sweep", TINY, "--seeds", "0,1,2").code == 0
    ((sweep, *_),) = calls
    assert (sweep.name, sweep.seeds, sweep.grid) == ("tiny", (0, 1, 2), ())


def test_a_failed_row_is_shown_and_is_exit_code_1(calls, command):
    answer = command("sweep", TINY, "--name", "failing")
    assert answer.code == 1 and "failed: base, seed 0: killed by signal 9" in answer.out


def test_ray_takes_its_address_and_cores(calls, command, monkeypatch):
    asked = []
    monkeypatch.setattr(
        cluster, "make_ray_runner", lambda *words: asked.append(words) or "a runner"
    )
    assert command("sweep", TINY, "--engine", "ray", "--ray-address", "a:1").code == 0
    assert command("sweep", TINY, "--engine", "ray", "--ray-cores", "4").code == 0
    assert asked == [("a:1", 2), (None, 4)] and calls[0][4] == "a runner"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("none.py", "none.py does not exist"),
        (f"{LAMBDA} --seeds 1,x", "--seeds takes integers"),
        (f"{LAMBDA} --train.epochs 0", "--train.epochs 0.0: must be above zero"),
        (f"{LAMBDA} --retry-failed yes", "unrecognized arguments: yes"),
        (f"{LAMBDA} --engine dask", "invalid choice"),
        (f"{LAMBDA} --ray-cores 2", "go with --engine ray"),
        (f"{LAMBDA} --engine ray --ray-cores 0", "use at least 1"),
        (f"{LAMBDA} --networks posenet", "needs the network 'disentangled'"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(command, tmp_path, words, line):
    answer = command("sweep", *words.split(), "--out", tmp_path / "out")
    assert answer.code == 2 and line in answer.err and answer.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_run_says_what_a_sweep_is_for(command):
    answer = command("run", LAMBDA)
    assert answer.code == 2 and "run it with `jaxunshear sweep" in answer.err
