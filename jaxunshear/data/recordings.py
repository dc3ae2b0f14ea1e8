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
import io
import json
import os
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageOps

from jaxunshear.config.image import Preprocess
from jaxunshear.data.labels import (
    TABLES,
    UNKNOWN_ID,
    ImageLabels,
    Problem,
    make_unknown_labels,
    read_table,
    read_targets,
)
from jaxunshear.errors import UserError, get_first_line

if TYPE_CHECKING:
    from jaxunshear.perception.preprocess import View

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}
# Folders that hold a recording's images, the most processed first: only the first that has any is read.
IMAGE_FOLDERS = ("processed_images", "frames_bw", "images", "frames", "sensor_images")
PNG = b"\x89PNG\r\n\x1a\n"  # how its files start
PHOTOMETRIC, SAMPLE_FORMAT = (
    262,
    339,
)  # TIFF's tags: 0 for white at zero; 1 for numbers without a sign
PROBES = 20  # frames that a common crop is found from
MAX_FOLDER_DEPTH = 4  # folders below the given one that are searched


@dataclass(frozen=True)
class Recordings:
    """What lies at `path`: N images, in order, that `frames` loads one at a time.

    `poses` and `moves` (N, 6) in mm and degrees, NaN in rows that are not labelled, or None where nothing is. `pose_ids` (N,) int64,
    -1 where unknown, or None likewise. `notes` says in a line each what is wrong, by file and row (`Problem` where these are known);
    images that turn out to be unreadable, or unlike the others, are added while `frames` runs.
    """

    path: Path
    preprocess: Preprocess
    files: tuple[Path, ...]
    poses: np.ndarray | None
    moves: np.ndarray | None
    notes: list[str] = field(default_factory=list)
    pose_ids: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.files)

    @property
    def names(self) -> tuple[str, ...]:
        """The images' places below `path`, with slashes: unique. Bytes that are no UTF-8 as they are escaped in Python: names go to
        tables."""
        return tuple(map(self._name, self.files))

    def _name(self, file: Path) -> str:
        root = self.path.parent if file == self.path else self.path
        return os.fsencode(file.relative_to(root).as_posix()).decode("utf-8", "backslashreplace")

    def iterate_frames(self, view: View | None = None) -> Iterator[tuple[int, str, np.ndarray]]:
        """(row of `poses`, name, image (S, S) uint8 of {0, 255}), seen as `view`; what it does not give, as each folder's have in common.

        Raises UserError if not one image can be read.
        """
        from jaxunshear.perception.preprocess import View, prepare_frame

        problem = ""
        views: dict[Path, View] = {}
        sizes: dict[Path, dict[tuple[int, ...], list[str]]] = {}
        for index, file in enumerate(self.files):
            name, folder = self._name(file), file.parent
            if folder not in views:
                own = self.find_common_view(folder) if view is None or view.box is None else view
                views[folder], sizes[folder] = (
                    View(own.box, own.whites if view is None else view.whites),
                    {},
                )
            try:
                raw = read_image(file)
                image = prepare_frame(self.preprocess, raw, views[folder])
            except UserError as error:
                problem = f"{name}: {error}"
                self._note(Problem.from_line(file, f"left out {problem}"))
                continue
            sizes[folder].setdefault(raw.shape[:2], []).append(file.name)
            yield index, name, image
        if not any(sizes.values()):
            raise UserError(
                f"none of {len(self)} images in {self.path} can be read; the last: {problem}"
            )
        for folder, seen in sizes.items():
            if len(seen) > 1:
                self._note(
                    Problem.with_place(folder, f"images of {len(seen)} sizes: {_sizes(seen)}")
                )

    def _note(self, problem: str) -> None:
        if problem not in self.notes:  # frames may be asked for twice
            self.notes.append(problem)

    def find_common_view(self, folder: Path | None = None) -> View:
        """The crop and the whites that suit up to PROBES frames, of all or of one folder, evenly spaced: a crop that trembled would appear
        as motion. No crop where they differ in size."""
        from jaxunshear.perception.preprocess import View, combine_views, find_view

        files = [file for file in self.files if folder in (None, file.parent)]
        views, sizes = [], set[tuple[int, ...]]()
        for file in files[:: -(-len(files) // PROBES)]:
            with contextlib.suppress(UserError):  # `frames` will report it
                raw = read_image(file)
                sizes.add(raw.shape[:2])
                views.append(find_view(self.preprocess, raw))
        common = combine_views(views)
        return common if len(sizes) == 1 else View(None, common.whites)


def read_image(file: Path | bytes) -> np.ndarray:
    """An image file, or its bytes, as an array of its own depth and channels, turned as its orientation tag says. Raises UserError for
    what Pillow cannot read, and for several frames in one file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # of tags that are broken: the image is read without them
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            data = file if isinstance(file, bytes) else file.read_bytes()
            # Pillow passes over the checksums of a PNG's pixels: a damaged one may come out as another image
            if data.startswith(PNG):
                Image.open(io.BytesIO(data)).verify()
            with Image.open(io.BytesIO(data)) as opened:
                frames = getattr(opened, "n_frames", 1)
                if (
                    frames > 1 and opened.format != "MPO"
                ):  # a JPEG with a small copy of itself behind it
                    raise UserError(
                        f"it holds {frames} frames, of which one would be read: save each as a file of its own"
                    )
                tags = getattr(opened, "tag_v2", {})
                ImageOps.exif_transpose(opened, in_place=True)
                plain = opened.mode in (
                    "1",
                    "L",
                    "LA",
                    "RGB",
                    "RGBA",
                    "I",
                    "F",
                ) or opened.mode.startswith("I;16")
                raw = np.array(opened if plain else opened.convert("RGB"))
    except UserError:
        raise
    except Exception as error:  # decoders meet broken files with errors of every kind
        raise UserError(f"no readable image ({get_first_line(error)})") from None
    return _convert_unsigned(raw, tags)


def _convert_unsigned(raw: np.ndarray, tags: Mapping[int, object]) -> np.ndarray:
    """What Pillow leaves to do for a TIFF with these tags: 32 bits without a sign, and 16 bits of which 0 is white."""
    if tags and raw.dtype == np.int32 and tags.get(SAMPLE_FORMAT, 1) in (1, (1,)):
        return raw.view(np.uint32)
    return (
        np.iinfo(np.uint16).max - raw
        if raw.dtype == np.uint16 and tags.get(PHOTOMETRIC) == 0
        else raw
    )


def read_recordings(path: str | Path, preprocess: Preprocess) -> Recordings:
    """Finds the images and labels at `path`. Raises UserError if there is no such place or no image in it."""
    path = Path(path)
    if path.is_file():
        if path.suffix.lower() not in SUFFIXES:
            raise UserError(
                f"{path} is no image: give a folder, or one of {', '.join(sorted(SUFFIXES))}"
            )
        return Recordings(path, preprocess, (path,), None, None)
    if not path.is_dir():
        raise UserError(f"{path} does not exist: give a folder of recordings or an image")
    notes: list[str] = []
    files: list[Path] = []
    targets: list[ImageLabels] = []
    try:
        for folder, images in _recording_folders(path, MAX_FOLDER_DEPTH, notes):
            files += images
            _check_json(folder, notes)
            targets.append(_targets(folder, images, notes))
            if images[0].parent == folder and (hidden := _below(folder)) is not None:
                notes.append(
                    f"{folder} has images of its own, so those below it, such as in {hidden}, are not read"
                )
    except OSError as error:
        raise UserError(f"{path} cannot be searched: {get_first_line(error)}") from None
    if not files:
        raise UserError(
            f"{path} holds no images ({', '.join(sorted(SUFFIXES))}), nor a known layout of recordings"
        )
    poses, moves, ids = (np.concatenate(part) for part in zip(*targets, strict=True))
    return Recordings(
        path,
        preprocess,
        tuple(files),
        _drop_if_unknown(poses),
        _drop_if_unknown(moves),
        notes,
        ids if (ids != UNKNOWN_ID).any() else None,
    )


def _recording_folders(
    folder: Path, depth: int, notes: list[str], seen: frozenset[Path] = frozenset()
) -> Iterator[tuple[Path, list[Path]]]:
    """Every folder with images of its own or in a known subfolder, and these images. Links that lead back are not followed."""
    for place in (*(folder / name for name in IMAGE_FOLDERS), folder):
        images = _images(place)
        if images:
            yield folder, images
            return
    seen |= {folder.resolve()}
    for below in _folders(folder) if depth else ():
        if below.resolve() in seen:
            continue
        try:
            yield from _recording_folders(below, depth - 1, notes, seen)
        except OSError as error:
            notes.append(
                Problem.with_place(below, f"cannot be searched ({error.strerror or error})")
            )


def _below(folder: Path) -> Path | None:
    """A folder in `folder` where images would be found if it had none of its own."""
    found = (
        place
        for sub in _folders(folder)
        for place, _ in _recording_folders(sub, MAX_FOLDER_DEPTH - 1, [])
    )
    with contextlib.suppress(OSError):  # nobody asked for what lies there
        return next(found, None)
    return None


def _folders(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))


def _images(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    images = (
        p
        for p in folder.iterdir()
        if p.suffix.lower() in SUFFIXES and not p.name.startswith(".") and p.is_file()
    )
    return sorted(
        images,
        key=lambda p: [
            int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", p.name)
        ],
    )


def _check_json(folder: Path, notes: list[str]) -> None:
    """Nothing in these files is needed to unshear; a broken one is only reported."""
    for file in sorted(folder.glob("*.json")):
        try:
            json.loads(file.read_text(encoding="utf-8"))
        except (ValueError, OSError, RecursionError) as error:
            text = f"this JSON is broken ({get_first_line(error)}); it is not needed, so the reading goes on without it"
            notes.append(Problem.with_place(file, text))


def _targets(folder: Path, images: list[Path], notes: list[str]) -> ImageLabels:
    """What the folder's table says of its images."""
    for file in (folder / name for name in TABLES):
        if file.is_file():
            try:
                targets, problems = read_targets(read_table(file), [image.name for image in images])
            except UserError as error:
                notes.append(error.args[0])
                continue
            notes += problems
            return targets
    return make_unknown_labels(len(images))


def _drop_if_unknown(values: np.ndarray) -> np.ndarray | None:
    return values if np.isfinite(values).any() else None


def _sizes(names: dict[tuple[int, ...], list[str]]) -> str:
    """The usual size of images, and the first that has another."""
    usual, *others = sorted(names, key=lambda size: -len(names[size]))
    parts = [
        f"{len(names[size])} of {size[1]} x {size[0]} ({names[size][0]})" for size in others[:3]
    ]
    return ", ".join([f"{len(names[usual])} of {usual[1]} x {usual[0]}", *parts])
