"""The process asks for large pages once, and only where it may; freed memory stays with it."""

import os
import subprocess
import sys

import pytest

PROBE = """
import os, sys
from jaxunshear.memory import restart_with_large_pages
{first}
print(os.environ.get("GLIBC_TUNABLES"), sys.orig_argv[1:3], sys.argv[1:], flush=True)
restart_with_large_pages()
print("at work", os.environ.get("GLIBC_TUNABLES"))
"""
SAME = "['-X', 'dev'] ['stimuli']"


def printed(first: str = "", **more: str) -> list[str]:
    """Lines of a process that asks for large pages after `first`."""
    variables = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"} | more
    words = [sys.executable, "-X", "dev", "-c", PROBE.format(first=first), "stimuli"]
    return subprocess.run(
        words, env=variables, check=True, capture_output=True, text=True, timeout=60
    ).stdout.splitlines()


def test_the_same_command_runs_once_more():
    assert printed() == [f"None {SAME}", f"glibc.malloc.hugetlb=1 {SAME}", "at work glibc.malloc.hugetlb=1"]


def test_a_setting_of_the_user_stays():
    own = "glibc.malloc.arena_max=1"
    assert printed(GLIBC_TUNABLES=own) == [f"{own} {SAME}", f"at work {own}"]


@pytest.mark.parametrize("elsewhere", ["sys.platform = 'darwin'", "sys.orig_argv = ['python']"])
def test_nothing_happens_elsewhere(elsewhere):
    before, after = printed(elsewhere)
    assert before.startswith("None") and after == "at work None"


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
