"""Samples of the images of a recording, folder by folder, at the size of the images."""

import contextlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.calibration.pin_statistics import PinObservation, observe_pins
from jaxunshear.config.image import Preprocess
from jaxunshear.config.sensor import Sensor
from jaxunshear.data.recordings import IMAGE_FOLDERS, Recordings, read_image, read_recordings
from jaxunshear.errors import UserError
from jaxunshear.perception.preprocess import is_binary, to_grey
from jaxunshear.progress import Progress

SIZES_PX = (128, 440)  # least and most for binary images; raw frames become 256
ALIGNED_BY = 100  # most images that align a folder
SHARE = 3  # at most one of so many images of a folder aligns it


@dataclass(frozen=True)
class RecordedImages:
    """Sampled images of one folder."""

    name: str
    images: np.ndarray  # (N, S, S) uint8
    poses: np.ndarray | None
    moves: np.ndarray | None
    names: tuple[str, ...] = ()  # of the images, below the folder of all recordings

    @property
    def labelled_rows(self) -> np.ndarray:
        """(N,) bool: the pose is known, and the slide if the folder has any.

        An image whose slide cannot be read is not a tap.
        """
        if self.poses is None:
            return np.zeros(len(self.images), bool)
        labelled = np.isfinite(self.poses).all(axis=-1)
        if self.moves is not None and np.isfinite(self.moves).any():
            labelled &= np.isfinite(self.moves).all(axis=-1)
        return labelled

    def observe(self, sensor: Sensor) -> PinObservation:
        """Observe the pins, and show the progress."""
        with Progress(f"pins of {self.name}", len(self.images)) as progress:
            return observe_pins(self.images, sensor, progress)


def sample_folders(path: Path, images: int, seed: int) -> tuple[list[RecordedImages], list[str]]:
    """Sample `images` images evenly over all folders; return notes on what cannot be read."""
    recordings, notes = open_recordings(path)
    folders = group_rows_by_folder(recordings)
    generator = np.random.default_rng(seed)
    count = max(1, images // len(folders))
    rows = [_choose_rows(recordings.moves, folder, count, generator) for folder in folders]
    parts, read_notes = load_images(recordings, rows)
    return parts, notes + read_notes


class FolderSplit(NamedTuple):
    """One folder's images: those that align labels with images, and those that are compared."""

    align: RecordedImages
    scored: RecordedImages


def split_folders(
    path: Path, each: int | None, seed: int, used: Collection[str]
) -> tuple[list[FolderSplit], list[str]]:
    """Split every folder of recordings at `path` in two parts, and give notes.

    Raises `UserError` if nothing is left to compare.

    Args:
        each: Most images of a folder that are compared; None for all.
        used: Images that are not compared, and align before others do: names as in
            `RecordedImages.names`, or the end of such a name.
    """
    recordings, notes = open_recordings(path)
    generator, is_used = np.random.default_rng(seed), are_among(recordings.names, used)
    align_rows, scored_rows = [], []
    for rows in group_rows_by_folder(recordings):
        rows = generator.permutation(rows)
        used_rows, fresh_rows = rows[is_used[rows]], rows[~is_used[rows]]
        if len(used_rows):
            folder = recordings.names[rows[0]].rpartition("/")[0] or path.name
            notes.append(
                f"{folder}: {len(used_rows)} of {len(rows)} images, "
                "which the calibration was fitted to, are not compared"
            )
        count = min(ALIGNED_BY, -(-len(rows) // SHARE))
        missing = max(0, count - len(used_rows))
        align = np.sort(np.concatenate([used_rows[:count], fresh_rows[:missing]]))
        scored = np.sort(fresh_rows[missing:][:each])
        if len(scored):
            align_rows.append(align)
            scored_rows.append(scored)
    if not scored_rows:
        raise UserError(
            f"{path}: the calibration was fitted to all its images: compare with others"
        )
    align_parts, align_notes = load_images(recordings, align_rows)
    scored_parts, scored_notes = load_images(recordings, scored_rows)
    align_by_name = {part.name: part for part in align_parts}
    splits = [
        FolderSplit(align_by_name[part.name], part)
        for part in scored_parts
        if part.name in align_by_name
    ]
    return splits, notes + align_notes + scored_notes


def are_among(names: Sequence[str], used: Collection[str]) -> np.ndarray:
    """Mark the names that are `used`, (N,) bool, from whichever folder they were named.

    Of two names of one image, from a higher and from a lower folder, one ends with the other.
    """
    ends = tuple(f"/{name}" for name in used)

    def is_among(name: str) -> bool:
        return f"/{name}".endswith(ends) or any(end.endswith(f"/{name}") for end in ends)

    return np.array([is_among(name) for name in names], bool)


def open_recordings(path: Path) -> tuple[Recordings, list[str]]:
    """Open recordings at the size of their images; return notes on what cannot be read."""
    probe = read_recordings(path, Preprocess())
    first = to_grey(_read_first(probe))
    size = int(np.clip(min(first.shape), *SIZES_PX)) if is_binary(first) else 256
    return replace(probe, preprocess=Preprocess(size=size)), list(probe.notes)


def group_rows_by_folder(recordings: Recordings) -> list[np.ndarray]:
    """Group the rows of the images by their folder, in the order of the folders' names."""
    rows: dict[Path, list[int]] = {}
    for row, file in enumerate(recordings.files):
        rows.setdefault(file.parent, []).append(row)
    return [np.array(rows[folder]) for folder in sorted(rows)]


def load_images(
    recordings: Recordings, chosen: list[np.ndarray]
) -> tuple[list[RecordedImages], list[str]]:
    """Load the images of the chosen rows of each folder, and give notes.

    A folder of which no image can be read is left out. Raises `UserError` if that is so for all.
    """
    parts, notes = [], []
    problem: UserError | None = None
    path = recordings.path
    for rows in chosen:
        if not len(rows):
            continue
        sample = _take(recordings, rows)
        readable, names, images = [], [], []
        try:
            for row, name, image in sample.iterate_frames():
                readable.append(row)
                names.append(name)
                images.append(image)
        except UserError as error:  # no image of the folder can be read
            problem = error
        notes += sample.notes
        if not images:
            continue
        parts.append(
            RecordedImages(
                _name_recording(path, sample.files[0].parent) if path.is_dir() else path.name,
                np.array(images),
                None if sample.poses is None else sample.poses[readable],
                None if sample.moves is None else sample.moves[readable],
                tuple(names),
            )
        )
    if problem is not None and not parts:
        raise problem
    return parts, notes


def _name_recording(path: Path, folder: Path) -> str:
    """Name the recording whose images lie in `folder`; no two in `path` have the same name."""
    recording = folder.parent if folder != path and folder.name in IMAGE_FOLDERS else folder
    return recording.relative_to(path.parent).as_posix()


def _read_first(recordings: Recordings) -> np.ndarray:
    for file in recordings.files[:-1]:
        with contextlib.suppress(UserError):  # `iterate_frames` will report it
            return read_image(file)
    return read_image(recordings.files[-1])


def _choose_rows(
    moves: np.ndarray | None, rows: np.ndarray, count: int, generator: np.random.Generator
) -> np.ndarray:
    """Choose at most `count` rows, with short slides as likely as long ones.

    Short slides are rare, and say most about sticking.
    """
    rows = generator.permutation(rows)
    if moves is None or len(rows) <= count:
        return np.sort(rows[:count])
    length = np.floor(np.nan_to_num(np.linalg.norm(moves[rows, :3], axis=-1)))
    rank = np.zeros(len(rows))
    for full_mm in np.unique(length):
        in_bin = length == full_mm
        rank[in_bin] = np.arange(in_bin.sum())
    return np.sort(rows[np.argsort(rank, kind="stable")[:count]])


def _take(recordings: Recordings, rows: np.ndarray) -> Recordings:
    return replace(
        recordings,
        files=tuple(recordings.files[row] for row in rows),
        poses=None if recordings.poses is None else recordings.poses[rows],
        moves=None if recordings.moves is None else recordings.moves[rows],
        notes=[],
    )
