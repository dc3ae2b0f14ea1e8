"""Freed memory stays with the process."""

import os
import subprocess
import sys

import pytest

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
