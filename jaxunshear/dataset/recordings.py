"""Real recordings, read as they lie on disk and prepared like simulated frames. Imports no JAX until a frame is prepared.

Understood: one image; a folder of images; the older layout (`images/`, `targets.csv`, `meta.json`), its variant (`frames_bw/`),
and the newer one (`{train,val,test}/processed_images/`, `targets.csv`, four JSON files); and folders of these. What is broken and
not needed is noted, not fatal.

    recordings = read_recordings("recordings/edge", Preprocess(size=128))
    for index, name, image in recordings.frames():   # image (S, S) uint8 of {0, 255}
        pose = recordings.poses[index]               # x y z mm, Rx Ry Rz deg; NaN where unknown
"""

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from jaxunshear.errors import UserError
from jaxunshear.image.settings import Preprocess

if TYPE_CHECKING:
    from jaxunshear.image.preprocess import View

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}
# Folders that hold a recording's images, the most processed first: only the first that has any is read.
IMAGE_FOLDERS = ("processed_images", "frames_bw", "images", "frames", "sensor_images")
IMAGE_COLUMNS = ("sensor_image", "image_name")
POSE_COLUMNS = tuple(f"pose_{i}" for i in range(1, 7)), tuple(f"pose_{i}" for i in ("x", "y", "z", "Rx", "Ry", "Rz"))
MOVE_COLUMNS = tuple(f"move_{i}" for i in range(1, 7)), tuple(f"shear_{i}" for i in ("x", "y", "z", "Rx", "Ry", "Rz"))
PROBES = 20  # frames that a common crop is found from
DEPTH = 4  # folders below the given one that are searched
UNREADABLE = (OSError, SyntaxError, ValueError, EOFError, struct.error, Image.DecompressionBombError)


@dataclass(frozen=True)
class Recordings:
    """What lies at `path`: N images, in order, that `frames` loads one at a time.

    `poses` and `moves` (N, 6) in mm and degrees, NaN in rows that are not labelled, or None where nothing is. `notes` says what was
    left out, by name; images that turn out to be unreadable are added while `frames` runs.
    """

    path: Path
    preprocess: Preprocess
    files: tuple[Path, ...]
    poses: np.ndarray | None
    moves: np.ndarray | None
    notes: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.files)

    @property
    def names(self) -> tuple[str, ...]:
        """The images' places below `path`, with slashes: unique. Bytes that are no UTF-8 as they are escaped in Python: names go to
        tables."""
        root = self.path if self.path.is_dir() else self.path.parent
        names = (os.fsencode(file.relative_to(root).as_posix()) for file in self.files)
        return tuple(name.decode("utf-8", "backslashreplace") for name in names)

    def frames(self, view: View | None = None) -> Iterator[tuple[int, str, np.ndarray]]:
        """(row of `poses`, name, image (S, S) uint8 of {0, 255}), seen as `view`; what it does not tell, as each folder's have in common.

        Raises UserError if not one image can be read.
        """
        from jaxunshear.image.preprocess import View, prepare_frame

        read, problem = 0, ""
        views: dict[Path, View] = {}
        for index, (file, name) in enumerate(zip(self.files, self.names, strict=True)):
            if file.parent not in views:
                own = self.common_view(file.parent) if view is None or view.box is None else view
                views[file.parent] = View(own.box, own.whites if view is None else view.whites)
            try:
                image = prepare_frame(self.preprocess, read_image(file), views[file.parent])
            except UserError as error:
                problem = f"{name}: {error}"
                self.notes.append(f"left out {problem}")
                continue
            read += 1
            yield index, name, image
        if not read:
            raise UserError(f"none of {len(self)} images in {self.path} can be read; the last: {problem}")

    def common_view(self, folder: Path | None = None) -> View:
        """The crop and the whites that suit up to PROBES frames, of all or of one folder, evenly spaced: a crop that trembled would look
        like motion. No crop where they differ in size."""
        from jaxunshear.image.preprocess import View, common_view, own_view

        files = [file for file in self.files if folder in (None, file.parent)]
        views, sizes = [], set[tuple[int, ...]]()
        for file in files[:: -(-len(files) // PROBES)]:
            with contextlib.suppress(UserError):  # `frames` will tell
                raw = read_image(file)
                sizes.add(raw.shape[:2])
                views.append(own_view(self.preprocess, raw))
        common = common_view(views)
        return common if len(sizes) == 1 else View(None, common.whites)


def read_image(file: Path) -> np.ndarray:
    """An image file as an array of its own depth and channels. Raises UserError for what Pillow cannot read."""
    try:
        with Image.open(file) as opened:
            opened.load()
            plain = opened.mode in ("1", "L", "LA", "RGB", "RGBA", "I", "F") or opened.mode.startswith("I;16")
            return np.array(opened if plain else opened.convert("RGB"))
    except UNREADABLE as error:
        raise UserError(f"no readable image ({_one_line(error)})") from None


def read_recordings(path: str | Path, preprocess: Preprocess) -> Recordings:
    """Finds the images and labels at `path`. Raises UserError if there is no such place or no image in it."""
    path = Path(path)
    if path.is_file():
        if path.suffix.lower() not in SUFFIXES:
            raise UserError(f"{path} is no image: give a folder, or one of {', '.join(sorted(SUFFIXES))}")
        return Recordings(path, preprocess, (path,), None, None)
    if not path.is_dir():
        raise UserError(f"{path} does not exist: give a folder of recordings or an image")
    notes: list[str] = []
    files: list[Path] = []
    poses: list[np.ndarray] = []
    moves: list[np.ndarray] = []
    try:
        for folder, images in _recording_folders(path, DEPTH):
            files += images
            _check_json(folder, notes)
            pose, move = _labels(folder, images, notes)
            poses.append(pose)
            moves.append(move)
            if images[0].parent == folder and (hidden := _below(folder)) is not None:
                notes.append(f"{folder} has images of its own, so those below it, such as in {hidden}, are not read")
    except OSError as error:
        raise UserError(f"{path} cannot be searched: {_one_line(error)}") from None
    if not files:
        raise UserError(f"{path} holds no images ({', '.join(sorted(SUFFIXES))}), nor a known layout of recordings")
    return Recordings(path, preprocess, tuple(files), _known(poses), _known(moves), notes)


def _recording_folders(folder: Path, depth: int) -> Iterator[tuple[Path, list[Path]]]:
    """Every folder with images of its own or in a known subfolder, and these images."""
    for place in (*(folder / name for name in IMAGE_FOLDERS), folder):
        images = _images(place)
        if images:
            yield folder, images
            return
    if depth:
        for below in _folders(folder):
            yield from _recording_folders(below, depth - 1)


def _below(folder: Path) -> Path | None:
    """A folder in `folder` where images would be found if it had none of its own."""
    found = (place for sub in _folders(folder) for place, _ in _recording_folders(sub, DEPTH - 1))
    with contextlib.suppress(OSError):  # nobody asked for what lies there
        return next(found, None)
    return None


def _folders(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))


def _images(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    images = (
        p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".") and p.is_file()
    )
    return sorted(
        images, key=lambda p: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", p.name)]
    )


def _check_json(folder: Path, notes: list[str]) -> None:
    """Nothing in these files is needed to unshear; a broken one is only told of."""
    for file in sorted(folder.glob("*.json")):
        try:
            json.loads(file.read_text(encoding="utf-8"))
        except (ValueError, OSError) as error:
            notes.append(f"{file} is broken ({_one_line(error)}); it is not needed, so the reading goes on without it")


def _labels(folder: Path, images: list[Path], notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Poses and moves (N, 6) of the images, NaN where the folder's csv does not tell."""
    unknown = np.full((len(images), 6), np.nan)
    for file in (folder / "targets.csv", folder / "targets_images.csv"):
        if not file.is_file():
            continue
        try:
            with open(file, newline="", encoding="utf-8-sig") as stream:
                rows = list(csv.DictReader(stream))
        except (OSError, ValueError, csv.Error) as error:
            notes.append(f"{file} cannot be read ({_one_line(error)})")
            continue
        columns = set(rows[0]) if rows else set()
        image_column = next((name for name in IMAGE_COLUMNS if name in columns), None)
        if image_column is None:
            notes.append(f"{file} has no rows with a column {' or '.join(IMAGE_COLUMNS)}: its poses are not used")
            continue
        by_name = {re.split(r"[/\\]", row[image_column] or "")[-1]: row for row in rows}
        missing = [image.name for image in images if image.name not in by_name]
        if missing:
            notes.append(
                f"{file} has no row for {len(missing)} of {len(images)} images, the first {missing[0]}: poses unknown"
            )
        found = [by_name.get(image.name, {}) for image in images]
        return (
            _six(file, found, columns, POSE_COLUMNS, "poses", notes),
            _six(file, found, columns, MOVE_COLUMNS, "slides", notes),
        )
    return unknown, unknown.copy()


def _six(file: Path, rows: list[dict], columns: set[str], choices, what: str, notes: list[str]) -> np.ndarray:
    """The six columns of whichever naming the file uses, (N, 6) float."""
    values = np.full((len(rows), 6), np.nan)
    names = max(choices, key=lambda choice: len(columns.intersection(choice)))
    lacking = [name for name in names if name not in columns]
    if lacking:
        notes.append(f"{file} has no column {', '.join(lacking)}: {what} are not known")
        return values
    bad = 0
    for i, row in enumerate(rows):
        try:
            values[i] = [float(row[name]) for name in names] if row else np.nan
        except (TypeError, ValueError):
            bad += 1
    if bad:
        notes.append(f"{file} has {bad} rows whose {what} are no numbers")
    return values


def _known(parts: list[np.ndarray]) -> np.ndarray | None:
    values = np.concatenate(parts) if parts else np.zeros((0, 6))
    return values if np.isfinite(values).any() else None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
