"""Where a run keeps what its networks were put to."""

from pathlib import Path

SHARED = {"reconstruct": "servo"}  # it works on what `servo` left


def results_folder(run: Path, command: str) -> Path:
    return run / SHARED.get(command, command)
