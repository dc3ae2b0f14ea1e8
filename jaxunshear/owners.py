"""Whose a place is: nothing that one command writes replaces what a run, a sweep, a data set or released weights live on."""

import os
from pathlib import Path

from jaxunshear.errors import UserError
from jaxunshear.storage import read_object_if_sound

RUN, SWEEP, SET = "a run or weights", "a sweep", "a data set"
MARKS = {"experiment.json": RUN, "sweep.json": SWEEP, "task.json": SWEEP, "shards.json": SET}
FIELDS = {
    "experiment.json": "unshear",
    "sweep.json": "cells",
    "task.json": "kind",
}  # others have files of these names, too


def owner_of(path: Path) -> tuple[Path, str] | None:
    """The nearest folder that `path` is or lies in that holds a run, weights, a sweep or a data set, and which; None where none does."""
    place = Path(os.path.realpath(path))
    for folder in (place, *place.parents):
        for name, kind in MARKS.items():
            if (folder / name).is_file() and _is_ours(folder / name):
                return folder, kind
    return None


def check_apart(path: Path | None, option: str, home: Path | None = None) -> None:
    """Refuses, before there is work to lose, a place for results where a run, weights, a sweep or a data set keep their own files,
    and one in `home`, where this command is about to make such a folder."""
    if path is None:
        return
    if home is not None and Path(os.path.realpath(path)).is_relative_to(os.path.realpath(home)):
        raise UserError(
            f"{option} {path} lies in {home}, where this command keeps its own files: name a place elsewhere"
        )
    found = owner_of(path)
    if found is not None:
        folder, kind = found
        raise UserError(
            f"{option} {path} lies in {folder}, which is {kind} with files of its own: name a place elsewhere"
        )


def _is_ours(mark: Path) -> bool:
    """A damaged one may be."""
    held = read_object_if_sound(mark)
    return not isinstance(held, dict) or FIELDS.get(mark.name) in (None, *held)
