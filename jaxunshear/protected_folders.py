"""Whose a place is: nothing that one command writes replaces what a run, a sweep, a data set or released weights live on."""

import os
from pathlib import Path

from jaxunshear.errors import UserError
from jaxunshear.files import read_object_if_sound

RUN, SWEEP, SET = "a run or weights", "a sweep", "a data set"
MARKER_FILES = {  # file: whose it is, and a field that theirs has, where others have files of that name, too
    "experiment.json": (RUN, "unshear"),
    "sweep.json": (SWEEP, "cells"),
    "task.json": (SWEEP, "kind"),
    "shards.json": (SET, None),
}


def find_owner(path: Path) -> tuple[Path, str] | None:
    """The nearest folder that `path` is or lies in that holds a run, weights, a sweep or a data set, and which; None where none does."""
    place = Path(os.path.realpath(path))
    for folder in (place, *place.parents):
        for name, (kind, field) in MARKER_FILES.items():
            if (folder / name).is_file() and _has(folder / name, field):
                return folder, kind
    return None


def check_outside(path: Path | None, option: str, home: Path | None = None) -> None:
    """Refuses, before there is work to lose, a place for results where a run, weights, a sweep or a data set keep their own files,
    and one in `home`, where this command is about to make such a folder."""
    if path is None:
        return
    if home is not None and Path(os.path.realpath(path)).is_relative_to(os.path.realpath(home)):
        raise UserError(
            f"{option} {path} lies in {home}, where this command keeps its own files: name a place elsewhere"
        )
    found = find_owner(path)
    if found is not None:
        folder, kind = found
        raise UserError(
            f"{option} {path} lies in {folder}, which is {kind} with files of its own: name a place elsewhere"
        )


def _has(mark: Path, field: str | None) -> bool:
    """A damaged one may have it."""
    held = read_object_if_sound(mark)
    return held is None or field is None or field in held
