"""A sweep of made-up networks, in this process or in one that can be killed."""

import importlib.util
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest

from jaxunshear.sweep.run import run_sweep


@pytest.fixture(scope="session")
def stand_in() -> ModuleType:
    """stand_in.py as a module."""
    path = Path(__file__).with_name("stand_in.py")
    spec = importlib.util.spec_from_file_location("stand_in", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["stand_in"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def swept(stand_in, tmp_path):
    """`swept(sweep)` runs it under tmp_path and returns its summary."""
    (tmp_path / "data").mkdir()

    def run(sweep, **more):
        return run_sweep(sweep, tmp_path, tmp_path / "data", "none", worker=stand_in.WORKER, **more)

    return run


@pytest.fixture
def steps(tmp_path):
    """How often each step of each training was done: Counter of (training, step)."""

    def count() -> Counter:
        path = tmp_path / "data" / "steps.txt"
        lines = path.read_text().splitlines() if path.exists() else ()
        return Counter(tuple(line.split()) for line in lines)

    return count
