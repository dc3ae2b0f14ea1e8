"""Checks places for results before there is work to lose.

Files of runs, sweeps, data sets and released weights are protected from other commands.
"""

import contextlib
import json
import os
from pathlib import Path

from jaxunshear.errors import UserError
from jaxunshear.files import read_object_if_sound


def check_new_file(path: Path | None, option: str = "--json") -> None:
    """Refuse a file for JSON that is a folder, lies in a file, or holds what no command wrote."""
    if path is None:
        return
    if path.is_dir():
        raise UserError(f"{option} {path} is a folder: name a file")
    _check_place(path.parent, path, option)
    if path.is_file() and path.stat().st_size and not _is_measurement(path):
        raise UserError(
            f"{option} {path} holds something else, which would be lost: name another file"
        )


def check_new_picture(path: Path, software: str, option: str = "--out") -> None:
    """Refuse a file for a PNG that holds what `software` did not draw."""
    if path.suffix.lower() != ".png":
        raise UserError(f"{option} {path}: name a file that ends in .png")
    if path.is_dir():
        raise UserError(f"{option} {path} is a folder: name a file")
    _check_place(path.parent, path, option)
    if path.is_file() and path.stat().st_size:
        from PIL import Image, UnidentifiedImageError  # only for this: help must be quick

        drawn_by = None
        with contextlib.suppress(UnidentifiedImageError, OSError), Image.open(path) as image:
            drawn_by = image.info.get("Software")
        if drawn_by != software:
            raise UserError(
                f"{option} {path} holds something else, which would be lost: name another file"
            )


def _is_measurement(path: Path) -> bool:
    """Return whether a file is of `--json`, which names machines and versions, or of `--lines`."""
    with path.open("rb") as file:
        line = file.readline(2**20)
    with contextlib.suppress(ValueError, TypeError):
        if "frame" in json.loads(line):
            return True
    content = read_object_if_sound(path) or {}
    return "versions" in content and ("machine" in content or "machines" in content)


def check_new_folder(path: Path | None, option: str = "--out") -> None:
    """Refuse a folder for results that is a file or lies in one."""
    if path is None:
        return
    if path.exists() and not path.is_dir():
        raise UserError(f"{option} {path} is a file: name a folder")
    _check_place(path, path, option)


def _check_place(folder: Path, path: Path, option: str) -> None:
    """Refuse a folder in a file or behind a dead link, and one that may not be written."""
    folder = folder.absolute()
    nearest = next(place for place in (folder, *folder.parents) if os.path.lexists(place))
    if not nearest.is_dir():
        raise UserError(f"{option} {path}: {nearest} is a file: name another folder")
    is_stream = path.exists() and not (path.is_file() or path.is_dir())  # written into as it is
    if not is_stream and not os.access(nearest, os.W_OK | os.X_OK):
        raise UserError(f"{option} {path}: {nearest} may not be written: name another folder")


def check_not_among(recordings: Path, out: Path, option: str) -> None:
    """Refuse to write among the recordings, which the next run would read."""
    place, root = out.resolve(), recordings.resolve()
    if place == root.parent if recordings.is_file() else place.is_relative_to(root):
        raise UserError(
            f"{option} {out} lies among the recordings in {recordings}: name another folder"
        )
    check_new_folder(out, option)


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
