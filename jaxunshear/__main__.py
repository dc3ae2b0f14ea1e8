"""Runs `jaxunshear` and `python -m jaxunshear`."""

import os
import sys
from importlib import import_module

INTERRUPTED = 130


def run(program: str = "jaxunshear.cli") -> int:
    """Run the `main` of a program and return its exit code."""
    try:
        main = import_module(program).main
    except MemoryError:
        print("jaxunshear: error: out of memory before there was anything to do", file=sys.stderr)
        return 2
    code = main()
    if code == INTERRUPTED:
        # threads of readers and checkpoints may still work, and crash while Python shuts down
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)
    return code


if __name__ == "__main__":
    sys.exit(run())
