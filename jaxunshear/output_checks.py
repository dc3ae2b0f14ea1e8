"""Checks places for results before there is work to lose."""

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
    _check_above(path, option)
    if path.is_file() and path.stat().st_size and not _is_measurement(path):
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
    _check_above(path, option)


def _check_above(path: Path, option: str) -> None:
    """Refuse a place in a file, or in a link that leads to no folder."""
    nearest = next(folder for folder in path.absolute().parents if os.path.lexists(folder))
    if not nearest.is_dir():
        raise UserError(f"{option} {path}: {nearest} is a file: name another folder")


def check_not_among(recordings: Path, out: Path, option: str) -> None:
    """Refuse to write among the recordings, which the next run would read."""
    place, root = out.resolve(), recordings.resolve()
    if place == root.parent if recordings.is_file() else place.is_relative_to(root):
        raise UserError(
            f"{option} {out} lies among the recordings in {recordings}: name another folder"
        )
    check_new_folder(out, option)
