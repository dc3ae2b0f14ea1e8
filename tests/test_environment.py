"""What a shell, a notebook or a container leaves in the environment changes no result, and what cannot work is said in one line."""

import os
import pwd
import subprocess
import sys
from pathlib import Path

import pytest

from jaxunshear.environment import settled
from jaxunshear.storage import cache_folder
from jaxunshear.sweep import tasks

ROOT = Path(__file__).resolve().parents[1]
DRAWN = "from jaxunshear.environment import settle; settle(); import jax; print(jax.random.uniform(jax.random.key(0), 9).tolist())"
BITS = {"JAX_ENABLE_X64": "1", "JAX_DEFAULT_PRNG_IMPL": "rbg", "JAX_THREEFRY_PARTITIONABLE": "0"}


def process(*words: object, **variables: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, *map(str, words)], cwd=ROOT, env=os.environ | variables, capture_output=True, text=True
    )


def test_what_decides_results_is_set_aside():
    kept = {"PATH": "/bin", "JAX_PLATFORMS": "cpu", "JAX_COMPILATION_CACHE_DIR": "/c", "JAXUNSHEAR_CACHE": "/d"}
    more = {"JAX_NUMPY_RANK_PROMOTION": "raise", "JAX_RANDOM_SEED_OFFSET": "1", "HOME": "", "MPLBACKEND": "module://x"}
    assert settled(kept | BITS | more) == kept | {"MPLBACKEND": "agg"}


def test_numbers_drawn_do_not_depend_on_it(tmp_path):
    """Where a program comes from the cache, XLA may say more, on some machines."""
    usual, other = (process("-c", DRAWN, JAX_COMPILATION_CACHE_DIR=str(tmp_path), **more) for more in ({}, BITS))
    assert usual.stdout == other.stdout != ""
    assert usual.stderr == "" and all(name in other.stderr for name in BITS)


def test_processes_of_a_sweep_are_spared_it_too(tmp_path, monkeypatch):
    """Those on other machines of a cluster take theirs from there."""
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    (tmp_path / "task.json").write_text('{"kind": "row"}')
    tasks.carry_out(
        tmp_path, "row", [sys.executable, "-c", "import os; raise SystemExit('JAX_ENABLE_X64' in os.environ)"]
    )
    assert "exit code 0" in (tmp_path / "row.json").read_text()


@pytest.mark.parametrize("name", ["module://matplotlib_inline.backend_inline", "nonsense"])
def test_a_notebooks_backend_draws_nothing_here(tmp_path, name):
    words = ("-m", "jaxunshear", "sensors", "draw", "tactip331", "--out", tmp_path / "a.png")
    answer = process(*words, MPLBACKEND=name)
    assert (answer.returncode, answer.stderr) == (0, "")


@pytest.mark.parametrize(
    ("name", "value"),
    [("JAX_PLATFORMS", "nowhere"), ("XLA_FLAGS", "--nonsense"), ("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")],
)
def test_devices_and_flags_that_cannot_be_are_reported_before_any_work(tmp_path, name, value):
    words = ("-m", "jaxunshear", "run", "experiments/tiny.py", "--out", tmp_path / "runs", "--data", tmp_path / "sets")
    answer = process(*words, **{name: value})
    assert (answer.returncode, answer.stdout, answer.stderr.count("\n")) == (2, "", 1), answer.stderr
    assert answer.stderr.startswith(f"jaxunshear: error: {name}") and value in answer.stderr
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


def test_caches_lie_in_the_users_folder_unless_named(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("JAXUNSHEAR_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    if sys.platform == "linux":
        assert cache_folder() == tmp_path / ".cache" / "jaxunshear"
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
        assert cache_folder() == tmp_path / "xdg" / "jaxunshear"
    monkeypatch.setenv("JAXUNSHEAR_CACHE", str(tmp_path / "ours"))
    assert cache_folder() == tmp_path / "ours"


@pytest.mark.parametrize(
    "words", [("run", "tiny.py", "--out", "a"), ("calibrate", "a/b"), ("calibrate", "b", "--json", "a/x")]
)
def test_a_loop_of_links_is_reported_in_one_line(command, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    Path("a").symlink_to("b")
    Path("b").symlink_to("a")
    answer = command(*words)
    assert (answer.code, answer.err.count("\n")) == (2, 1)
    assert "a link that leads back to itself" in answer.err
    assert sorted(os.listdir()) == ["a", "b"]
