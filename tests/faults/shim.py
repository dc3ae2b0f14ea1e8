"""Arms `shim.c`, which is loaded before all else in the process of the campaign."""

import contextlib
import ctypes
import errno
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

SOURCE = Path(__file__).with_name("shim.c")


def build(folder: Path) -> Path:
    """The library; needs a C compiler ($CC, or cc)."""
    library = folder / "shim.so"
    words = [
        os.environ.get("CC", "cc"),
        "-O1",
        "-shared",
        "-fPIC",
        "-o",
        str(library),
        str(SOURCE),
        "-ldl",
    ]
    subprocess.run(words, check=True)
    return library


def arm(under: Path, nth: int, error: str = "ENOSPC") -> None:
    """The `nth` write below `under` from now on fails with this error, and so do all that follow; none does where it is 0."""
    ctypes.CDLL(None).fault_arm(str(under).encode(), ctypes.c_long(nth), getattr(errno, error))


def disarm() -> None:
    ctypes.CDLL(None).fault_arm(b"", ctypes.c_long(0), 0)


def seen() -> int:
    """Writes since it was armed."""
    return int(ctypes.CDLL(None).fault_seen())


def killing(library: Path, under: Path, nth: int) -> dict[str, str]:
    """The environment of a process that is to die, by SIGKILL, at its `nth` write below `under`."""
    return {
        "LD_PRELOAD": str(library),
        "FAULT_UNDER": str(under),
        "FAULT_NTH": str(nth),
        "FAULT_ERRNO": "0",
    }


def starving(library: Path, nth: int) -> dict[str, str]:
    """The environment of a process that gets no large block of memory from its `nth` on."""
    return {"LD_PRELOAD": str(library), "FAULT_MEMORY": str(nth)}


@contextlib.contextmanager
def environment(name: str, value: str) -> Iterator[None]:
    """A variable of the environment, for a while."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        del os.environ[name]
        if before is not None:
            os.environ[name] = before
