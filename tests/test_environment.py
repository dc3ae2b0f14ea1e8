"""Variables of the environment change no result; what cannot work is refused in one line."""

import os
import pwd
import subprocess
import sys
from pathlib import Path

import pytest

from jaxunshear.environment import check_variables, prepare_process
from jaxunshear.errors import UserError
from jaxunshear.files import cache_folder
from jaxunshear.sweep.tasks import TaskOrder
from jaxunshear.sweep.worker import run_order

ROOT = Path(__file__).resolve().parents[1]
BITS = ("JAX_ENABLE_X64", "JAX_DEFAULT_PRNG_IMPL", "JAX_THREEFRY_PARTITIONABLE")


def process(*words: object, **variables: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=ROOT,
        env=os.environ | variables,
        capture_output=True,
        text=True,
    )


def test_what_decides_results_is_refused(monkeypatch):
    for name in ("JAX_PLATFORMS", "JAX_COMPILATION_CACHE_DIR", "JAXUNSHEAR_CACHE"):
        monkeypatch.setenv(name, "cpu")
    check_variables()
    for name in BITS:
        monkeypatch.setenv(name, "1")
    refusal = r"^JAX_DEFAULT_PRNG_IMPL=1, JAX_ENABLE_X64=1, JAX_.*: would .* unset it$"
    with pytest.raises(UserError, match=refusal):
        check_variables()


def test_alarms_of_xla_are_not_shown_unless_asked_for(monkeypatch):
    for given, kept in ((None, "3"), ("0", "0")):
        monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL", raising=False)
        if given is not None:
            monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", given)
        prepare_process()
        assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == kept


def test_processes_of_a_sweep_refuse_it_too(monkeypatch, tmp_path):
    """Those on other machines of a cluster take theirs from there."""
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    outcome = run_order(TaskOrder(kind="row"), tmp_path)
    assert outcome.status == "failed" and "JAX_ENABLE_X64" in outcome.reason


def test_a_notebooks_backend_draws_nothing_here(tmp_path):
    words = ("-m", "jaxunshear", "sensors", "draw", "tactip331", "--out", tmp_path / "a.png")
    answer = process(*words, MPLBACKEND="module://matplotlib_inline.backend_inline")
    assert (answer.returncode, answer.stderr) == (0, "")


@pytest.mark.parametrize(
    ("name", "value", "line"),
    [
        ("XLA_FLAGS", "--xla_cpu_enable_fast_math=true", "fast_math=true: would give"),
        ("JAX_PLATFORMS", "nowhere", "'nowhere'"),
    ],
)
def test_what_cannot_be_is_reported_before_any_work(tmp_path, name, value, line):
    out = ("--out", tmp_path / "runs", "--data", tmp_path / "sets")
    answer = process("-m", "jaxunshear", "run", "experiments/tiny.py", *out, **{name: value})
    assert (answer.returncode, answer.stdout, answer.stderr.count("\n")) == (2, "", 1)
    assert name in answer.stderr and line in answer.stderr
    assert not list(tmp_path.iterdir())


def test_no_home_is_reported_in_one_line(command, monkeypatch):
    def nobody(uid):  # a user without a name, as in a container
        raise KeyError(uid)

    monkeypatch.setattr(pwd, "getpwuid", nobody)
    for name in ("JAXUNSHEAR_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    answer = command("run", ROOT / "experiments" / "tiny.py")
    assert (answer.code, answer.err.count("\n")) == (2, 1)
    assert "set HOME, or JAXUNSHEAR_CACHE" in answer.err
    monkeypatch.setenv("JAXUNSHEAR_CACHE", "/somewhere")
    assert cache_folder() == Path("/somewhere")


TWICE = """
import resource, jax
if {keep}:
    from jaxunshear.environment import keep_freed_memory
    keep_freed_memory()
import jax.numpy as jnp
@jax.jit
def work(x):
    between = jax.lax.optimization_barrier(jnp.sin(x))  # 50 MB
    return (between * between.T).sum()
x = jnp.ones((3600, 3600))
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    float(work(x))
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
# small blocks settle among the large ones, later if the machine is busy
print(min(faults() for _ in range(20)))
"""


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="of glibc")
def test_a_computation_finds_the_memory_of_the_last_one():
    def pages(keep):
        settings = {"JAX_PLATFORMS": "cpu", "GLIBC_TUNABLES": "glibc.malloc.hugetlb=0"}
        command = [sys.executable, "-c", TWICE.format(keep=keep)]
        return int(
            subprocess.run(
                command, env=os.environ | settings, check=True, capture_output=True
            ).stdout
        )

    without, kept = pages(False), pages(True)
    assert without > 1000 and kept < without / 20
