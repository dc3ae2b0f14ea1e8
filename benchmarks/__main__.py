"""Runs `python -m benchmarks sim|train|infer|...`."""

import sys

from jaxunshear.__main__ import run

if __name__ == "__main__":
    sys.exit(run("benchmarks.commands"))
