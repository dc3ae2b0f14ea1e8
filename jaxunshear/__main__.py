"""Runs `jaxunshear` and `python -m jaxunshear`."""

import os
import sys
from importlib import import_module
from typing import TextIO

from jaxunshear.environment import prepare_process

STOPPED = 128  # and the number of the signal: exit codes of programs that one ended


def run(program: str = "jaxunshear.cli") -> int:
    """Run the `main` of a program and return its exit code."""
    prepare_process()
    try:
        main = import_module(program).main
    except MemoryError:
        print("jaxunshear: error: out of memory before there was anything to do", file=sys.stderr)
        return 2
    code = main()
    is_sound = all([_flush(sys.stdout), _flush(sys.stderr)])
    if code > STOPPED or not is_sound:
        # threads of readers and checkpoints may still work, and crash while Python shuts down;
        # a stream that cannot be written would replace the exit code
        os._exit(code)
    return code


def _flush(stream: TextIO) -> bool:
    try:
        stream.flush()
    except OSError:
        return False
    return True


if __name__ == "__main__":
    sys.exit(run())
