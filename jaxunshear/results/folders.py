"""Where a run keeps what its networks were put to."""

from pathlib import Path

SHARED_FOLDERS = {"reconstruct": "servo"}  # it works on what `servo` left


def find_results_folder(run: Path, command: str) -> Path:
    return run / SHARED_FOLDERS.get(command, command)
