"""What all tests share. Real recordings are third-party and lie beside the checkout, if at all."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

os.environ.setdefault("MPLBACKEND", "Agg")

REAL = Path(__file__).resolve().parents[1].parent / "shared" / "real"


@pytest.fixture(scope="session")
def real_recordings() -> Path:
    """Folder of real recordings; skips where it is absent."""
    if not REAL.is_dir():
        pytest.skip(f"needs the real recordings in {REAL}, which no clone has")
    return REAL


class Answer(NamedTuple):
    code: int
    out: str
    err: str


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """`command("run", "x.py")` calls the command line in this process."""
    from jaxunshear.cli import main

    def call(*argv: object) -> Answer:
        capsys.readouterr()
        code = main([str(word) for word in argv])
        return Answer(code, *capsys.readouterr())

    return call
