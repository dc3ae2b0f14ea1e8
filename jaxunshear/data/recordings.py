"""Read real recordings as they lie on disk, and prepare their frames like simulated ones.

These layouts can be read: one image, or video; a folder of either; the older layout (`images/`,
`targets.csv`), its variant (`frames_bw/`), and the newer ones
(`{train,val,test}/processed_images/`, `targets.csv`; `tactile_images/`); and folders of these. JSON
beside them is not read. What is broken and not needed is noted, not fatal. Imports no JAX until a
frame is prepared.

    recordings = read_recordings("recordings/edge", Preprocess(size=128))
    for row, name, image in recordings.iterate_frames():  # image (S, S) uint8 of {0, 255}
        pose = recordings.poses[row]  # x y z mm, Rx Ry Rz deg; NaN where unknown
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from PIL import Image, ImageOps

from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.labels import UNKNOWN_ID, ImageLabels, read_targets
from jaxunshear.data.tables import LabelProblem, list_files, list_tables, read_table
from jaxunshear.data.videos import (
    VIDEOS,
    find_videos,
    is_video,
    list_video_frames,
    read_video_frame,
)
from jaxunshear.errors import UserError, get_first_line
from jaxunshear.files import explain_no_content

if TYPE_CHECKING:
    from jaxunshear.perception.preprocess import View

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}
# Folders that hold a recording's images, the most processed first: the first with any is read.
IMAGE_FOLDERS = (
    *("processed_images", "frames_bw", "images", "frames"),
    *("sensor_images", "tactile_images"),
)
PNG = b"\x89PNG\r\n\x1a\n"  # how its files start
# TIFF's tags: 0 for white at zero; 1 for numbers without a sign
PHOTOMETRIC, SAMPLE_FORMAT = 262, 339
PLAIN_MODES = ("1", "L", "LA", "RGB", "RGBA", "I", "F")  # Pillow's, besides those of 16 bits
PROBES = 20  # frames that a common crop is found from
MAX_FOLDER_DEPTH = 4  # folders below the named one that are searched
MAX_SIZES_NAMED = 3


class RecordedFrame(NamedTuple):
    """One frame of a recording."""

    row: int  # of `Recordings.poses`
    name: str
    image: np.ndarray  # (S, S) uint8 of {0, 255}


@dataclass(frozen=True)
class Recordings:
    """What lies at `path`: N images, in order, that `iterate_frames` loads one at a time.

    `poses` and `moves` (N, 6) in mm and degrees, NaN in rows that are not labelled, or None if no
    row is. `pose_ids` (N,) int64, -1 where unknown, or None likewise. `others` are further columns
    (N,) of numbers by name, as forces, NaN where unknown. `notes` says in a line each
    what is wrong, by file and row (`LabelProblem` where these are known); images that turn out to
    be unreadable, or unlike the others, are added while `iterate_frames` runs.
    """

    path: Path
    preprocess: Preprocess
    files: tuple[Path, ...]
    poses: np.ndarray | None
    moves: np.ndarray | None
    notes: list[str] = field(default_factory=list)
    pose_ids: np.ndarray | None = None
    others: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.files)

    @property
    def names(self) -> tuple[str, ...]:
        """The images' paths below `path`, with slashes: unique.

        Names go to tables, so bytes that are no UTF-8 are escaped as in Python.
        """
        return tuple(map(self._name, self.files))

    def _name(self, file: Path) -> str:
        root = self.path.parent if file == self.path else self.path
        return os.fsencode(file.relative_to(root).as_posix()).decode("utf-8", "backslashreplace")

    def iterate_frames(self, view: View | None = None) -> Iterator[RecordedFrame]:
        """Prepare the frames one by one, those that can be read.

        A crop or whites that `view` does not give are those that each folder's frames have in
        common. Raises UserError if not one image can be read.
        """
        from jaxunshear.perception.preprocess import prepare_frame

        problem, is_dark = "", view is not None and view.dark
        views: dict[Path, View] = {}
        names_by_size: dict[Path, dict[tuple[int, ...], list[str]]] = {}
        for row, file in enumerate(self.files):
            name, folder = self._name(file), file.parent
            if folder not in views:
                common = view if view and view.box else self.find_common_view(folder, is_dark)
                views[folder] = common._replace(whites=view.whites) if view else common
                names_by_size[folder] = {}
            try:
                raw = read_image(file)
                image = prepare_frame(self.preprocess, raw, views[folder])
            except UserError as error:
                problem = f"{name}: {error}"
                self._note(LabelProblem.from_line(file, f"left out {problem}"))
                continue
            names_by_size[folder].setdefault(raw.shape[:2], []).append(file.name)
            yield RecordedFrame(row, name, image)
        if not any(names_by_size.values()):
            raise UserError(
                f"none of {len(self)} images in {self.path} can be read; the last: {problem}"
            )
        for folder, sizes in names_by_size.items():
            if len(sizes) > 1:
                text = f"images of {len(sizes)} sizes: {_format_sizes(sizes)}"
                self._note(LabelProblem.with_place(folder, text))

    def _note(self, problem: str) -> None:
        if problem not in self.notes:  # frames may be asked for twice
            self.notes.append(problem)

    def find_common_view(self, folder: Path | None = None, dark: bool = False) -> View:
        """Find the crop and the whites that suit up to PROBES frames, of all or of one folder.

        `dark`: markers are dark on a light ground.

        The crop is one for all, as a crop that trembled would appear as motion. There is none if
        the frames differ in size.
        """
        files = [file for file in self.files if folder in (None, file.parent)]
        return find_common_view(files[:: -(-len(files) // PROBES)], self.preprocess, dark)


def find_common_view(files: Sequence[Path], preprocess: Preprocess, dark: bool = False) -> View:
    """Find the crop and whites of frames; no crop if these differ in size."""
    from jaxunshear.perception.preprocess import combine_views, find_view

    views, sizes = [], set[tuple[int, ...]]()
    for file in files:
        with contextlib.suppress(UserError):  # whoever reads all frames reports it
            raw = read_image(file)
            views.append(find_view(preprocess, raw, dark))
            sizes.add(raw.shape[:2])
    common = combine_views(views)
    return common if len(sizes) == 1 else common._replace(box=None, frame_px=None)


def read_image(file: Path | bytes) -> np.ndarray:
    """Read an image file, its bytes, or a frame of a video, as an array of its own depth.

    It is turned as its orientation tag says. Raises UserError for what Pillow cannot read, and for
    several frames in one file.
    """
    if isinstance(file, Path) and is_video(file.parent):
        return read_video_frame(file).pixels
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of broken tags: the image is read without them
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            data = file if isinstance(file, bytes) else file.read_bytes()
            if reason := explain_no_content(data):
                raise UserError(reason)
            return _decode_image(data)
    except UserError:
        raise
    except Exception as error:  # decoders meet broken files with errors of every kind
        raise UserError(f"no readable image ({get_first_line(error)})") from None


def read_first_image(files: Sequence[Path]) -> np.ndarray | None:
    """Read the first image that can be read; None if there is none."""
    for file in files:
        with contextlib.suppress(UserError):
            return read_image(file)
    return None


def _decode_image(data: bytes) -> np.ndarray:
    # Pillow passes over the checksums of a PNG's pixels: a damaged file may give another image.
    if data.startswith(PNG):
        Image.open(io.BytesIO(data)).verify()
    with Image.open(io.BytesIO(data)) as opened:
        frames = getattr(opened, "n_frames", 1)
        # an MPO is a JPEG with a small copy of itself behind it
        if frames > 1 and opened.format != "MPO":
            raise UserError(
                f"it holds {frames} frames, of which one would be read: "
                "save each as a file of its own"
            )
        tags = getattr(opened, "tag_v2", {})
        ImageOps.exif_transpose(opened, in_place=True)
        is_plain = opened.mode in PLAIN_MODES or opened.mode.startswith("I;16")
        raw = np.array(opened if is_plain else opened.convert("RGB"))
    # what Pillow leaves out for a TIFF: 32 bits without a sign, and 16 bits with white at 0
    if tags and raw.dtype == np.int32 and tags.get(SAMPLE_FORMAT, 1) in (1, (1,)):
        return raw.view(np.uint32)
    if raw.dtype == np.uint16 and tags.get(PHOTOMETRIC) == 0:
        return np.iinfo(np.uint16).max - raw
    return raw


def read_recordings(path: str | Path, preprocess: Preprocess) -> Recordings:
    """Find the images and labels at `path`. Raises UserError if there is no path or no image."""
    path = Path(path)
    if is_video(path):
        return Recordings(path, preprocess, list_video_frames(path), None, None)
    if path.is_file():
        if path.suffix.lower() not in SUFFIXES:
            raise UserError(
                f"{path} is no image and no video: give a folder, or one of "
                f"{', '.join(sorted(SUFFIXES | VIDEOS))}"
            )
        return Recordings(path, preprocess, (path,), None, None)
    if not path.is_dir():
        raise UserError(f"{path} does not exist: give a folder of recordings or an image")
    notes: list[str] = []
    files: list[Path] = []
    labels: list[ImageLabels] = []
    try:
        for folder, images in _find_image_folders(path, MAX_FOLDER_DEPTH, notes):
            files += images
            labels.append(_read_labels(folder, images, notes))
            is_own = images[0].parent == folder and folder.is_dir()
            hidden = _find_hidden_folder(folder) if is_own else None
            if hidden is not None:
                notes.append(
                    f"{folder} has images of its own, so those below it, "
                    f"such as in {hidden}, are not read"
                )
    except OSError as error:
        raise UserError(f"{path} cannot be searched: {get_first_line(error)}") from None
    if not files:
        raise UserError(
            f"{path} holds no images ({', '.join(sorted(SUFFIXES))}), "
            "nor a known layout of recordings"
        )
    joined = ImageLabels.join(labels)
    return Recordings(
        path,
        preprocess,
        tuple(files),
        joined.poses if np.isfinite(joined.poses).any() else None,
        joined.moves if np.isfinite(joined.moves).any() else None,
        notes,
        joined.pose_ids if (joined.pose_ids != UNKNOWN_ID).any() else None,
        joined.others,
    )


class _ImageFolder(NamedTuple):
    folder: Path
    images: list[Path]  # its own, or those of a known subfolder


def _find_image_folders(
    folder: Path, depth: int, notes: list[str], parents: frozenset[Path] = frozenset()
) -> Iterator[_ImageFolder]:
    """Find every folder with images. Links that lead back to one of `parents` are not followed."""
    for place in (*(folder / name for name in IMAGE_FOLDERS), folder):
        images = _list_images(place)
        if images:
            yield _ImageFolder(folder, images)
            return
    for video in find_videos(folder, notes):  # each as a folder of its frames
        yield _ImageFolder(video, list(list_video_frames(video)))
    parents |= {folder.resolve()}
    notes += _list_unread_tables(folder)
    for subfolder in _list_folders(folder) if depth else ():
        if subfolder.resolve() in parents:
            continue
        try:
            yield from _find_image_folders(subfolder, depth - 1, notes, parents)
        except OSError as error:
            text = f"cannot be searched ({error.strerror or error})"
            notes.append(LabelProblem.with_place(subfolder, text))


def _find_hidden_folder(folder: Path) -> Path | None:
    """Find a folder in `folder` whose images are not read since `folder` has its own."""
    subfolders = _list_folders(folder)
    with contextlib.suppress(OSError):  # nobody named what lies there
        for subfolder in subfolders:
            for hidden, _ in _find_image_folders(subfolder, MAX_FOLDER_DEPTH - 1, []):
                return hidden
    return None


def _list_folders(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))


def _list_images(folder: Path) -> list[Path]:
    """List the images of a folder by name, numbers by their value."""
    if not folder.is_dir():
        return []

    def split_at_numbers(path: Path) -> list[int | str]:
        parts = re.split(r"(\d+)", path.name)
        return [int(part) if part.isdecimal() else part for part in parts]

    images = [path for path in list_files(folder) if path.suffix.lower() in SUFFIXES]
    return sorted(images, key=split_at_numbers)


def _read_labels(folder: Path, images: list[Path], notes: list[str]) -> ImageLabels:
    """Read the labels of a folder's images from its table, the first that has any."""
    names = [image.name for image in images]
    places = dict.fromkeys((folder, images[0].parent))
    # a video has its frames, but no tables, in it
    for file in (file for place in places if place.is_dir() for file in list_tables(place)):
        try:
            labels, problems = read_targets(read_table(file), names)
        except UserError as error:
            notes.append(error.args[0])
            continue
        notes += problems
        if labels.are_known:
            return labels
    return ImageLabels.make_unknown(len(images))


def _list_unread_tables(folder: Path) -> list[str]:
    """List in a note each the tables in a folder without images, but for tables of pairs."""
    notes: list[str] = []
    for file in list_tables(folder):
        with contextlib.suppress(UserError):  # whatever it is, it is not read
            if {"slide", "tap"} <= set(read_table(file).columns):
                continue
        text = (
            "is not read: a table lies beside its images, or beside the folder of its images if "
            f"that is called {', '.join(IMAGE_FOLDERS[:-1])} or {IMAGE_FOLDERS[-1]}"
        )
        notes.append(LabelProblem.with_place(file, text))
    return notes


def _format_sizes(names: dict[tuple[int, ...], list[str]]) -> str:
    usual, *others = sorted(names, key=lambda size: -len(names[size]))
    parts = [f"{len(names[usual])} of {usual[1]} x {usual[0]}"]
    for size in others[:MAX_SIZES_NAMED]:
        parts.append(f"{len(names[size])} of {size[1]} x {size[0]} ({names[size][0]})")
    return ", ".join(parts)
