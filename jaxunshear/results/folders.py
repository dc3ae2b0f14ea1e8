"""Folders of a run with the results of commands that use its networks."""

from pathlib import Path

SHARED_FOLDERS = {"reconstruct": "servo"}  # it continues from the results of `servo`


def find_results_folder(run: Path, command: str) -> Path:
    """Find the folder of a run in which `command` writes its results."""
    return run / SHARED_FOLDERS.get(command, command)
