"""Protects the files of runs, sweeps, data sets and released weights from other commands."""

import os
from pathlib import Path

from jaxunshear.errors import UserError
from jaxunshear.files import read_object_if_sound

RUN, SWEEP, SET = "a run or weights", "a sweep", "a data set"
# file: whose it is, and a field that theirs has if others have files of that name, too
MARKER_FILES = {
    "experiment.json": (RUN, "unshear"),
    "sweep.json": (SWEEP, "cells"),
    "task.json": (SWEEP, "kind"),
    "shards.json": (SET, ""),
}


def find_owner(path: Path) -> tuple[Path, str] | None:
    """Find the nearest folder around `path` that has files of its own, and what it holds."""
    place = Path(os.path.realpath(path))
    for folder in (place, *place.parents):
        for name, (kind, field) in MARKER_FILES.items():
            if (folder / name).is_file():
                content = read_object_if_sound(folder / name)
                if content is None or not field or field in content:  # a damaged one may be theirs
                    return folder, kind
    return None


def check_outside(path: Path | None, option: str, home: Path | None = None) -> None:
    """Refuse a place for results in a folder that has files of its own.

    `home` is such a folder that this command is about to make.
    """
    if path is None:
        return
    if home is not None and Path(os.path.realpath(path)).is_relative_to(os.path.realpath(home)):
        raise UserError(
            f"{option} {path} lies in {home}, where this command keeps its own files: "
            "name a place elsewhere"
        )
    if owner := find_owner(path):
        folder, kind = owner
        raise UserError(
            f"{option} {path} lies in {folder}, which is {kind} with files of its own: "
            "name a place elsewhere"
        )
