"""Arms `shim.c`, which is loaded before all else in the process of the campaign."""

import ctypes
import errno
import os
import subprocess
from pathlib import Path

SOURCE = Path(__file__).with_name("shim.c")


def build(folder: Path) -> Path:
    """Build the library; needs a C compiler ($CC, or cc)."""
    library = folder / "shim.so"
    compiler = [os.environ.get("CC", "cc"), "-O1", "-shared", "-fPIC"]
    subprocess.run([*compiler, "-o", str(library), str(SOURCE), "-ldl"], check=True)
    return library


def arm(under: Path, nth: int, error: str = "ENOSPC") -> None:
    """Let the `nth` write below `under` from now on, and all that follow, fail with an error.

    None fails if `nth` is 0.
    """
    ctypes.CDLL(None).fault_arm(str(under).encode(), ctypes.c_long(nth), getattr(errno, error))


def disarm() -> None:
    ctypes.CDLL(None).fault_arm(b"", ctypes.c_long(0), 0)


def count_writes() -> int:
    """Count the writes since it was armed."""
    return int(ctypes.CDLL(None).fault_seen())


def kill_at_write(under: Path, nth: int) -> dict[str, str]:
    """Return the environment of a process that dies, by SIGKILL, at its `nth` write below `under`."""
    faults = {"FAULT_UNDER": str(under), "FAULT_NTH": str(nth), "FAULT_ERRNO": "0"}
    return faults | {"LD_PRELOAD": os.environ["FAULTS"]}


def refuse_memory(nth: int) -> dict[str, str]:
    """Return the environment of a process that gets no large block of memory from its `nth` on."""
    return {"LD_PRELOAD": os.environ["FAULTS"], "FAULT_MEMORY": str(nth)}
