"""The process asks for large pages once, and only where it may; freed memory stays with it."""

import os
import subprocess
import sys

import pytest

from jaxunshear.memory import restart_with_large_pages


@pytest.fixture
def restarts(monkeypatch):
    made = []
    monkeypatch.setattr(os, "execv", lambda *call: made.append(call))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(sys, "orig_argv", ["python", "-X", "dev", "-m", "jaxunshear", "stimuli"])
    monkeypatch.setenv("GLIBC_TUNABLES", "")
    monkeypatch.delenv("GLIBC_TUNABLES")
    return made


def test_the_same_command_runs_once_more(restarts):
    restart_with_large_pages()
    assert restarts == [(sys.executable, [sys.executable, "-X", "dev", "-m", "jaxunshear", "stimuli"])]
    assert os.environ["GLIBC_TUNABLES"] == "glibc.malloc.hugetlb=1"
    restart_with_large_pages()
    assert len(restarts) == 1


def test_a_setting_of_the_user_stays(restarts, monkeypatch):
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.arena_max=1")
    restart_with_large_pages()
    assert not restarts and os.environ["GLIBC_TUNABLES"] == "glibc.malloc.arena_max=1"


@pytest.mark.parametrize(("name", "value"), [("platform", "darwin"), ("orig_argv", ["python"])])
def test_nothing_happens_elsewhere(restarts, monkeypatch, name, value):
    monkeypatch.setattr(sys, name, value)
    restart_with_large_pages()
    assert not restarts and "GLIBC_TUNABLES" not in os.environ


TWICE = """
import resource, jax
if {keep}:
    from jaxunshear.memory import keep_freed_memory
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
print(min(faults() for _ in range(20)))  # small blocks settle among the large ones, later where the machine is busy
"""


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="of glibc")
def test_a_computation_finds_the_memory_of_the_last_one():
    def pages(keep):
        settings = {"JAX_PLATFORMS": "cpu", "GLIBC_TUNABLES": "glibc.malloc.hugetlb=0"}
        command = [sys.executable, "-c", TWICE.format(keep=keep)]
        return int(subprocess.run(command, env=os.environ | settings, check=True, capture_output=True).stdout)

    without, kept = pages(False), pages(True)
    assert without > 1000 and kept < without / 20
