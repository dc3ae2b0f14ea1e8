"""A sample of the images of a recording, folder by folder, at the size they have."""

import contextlib
from collections.abc import Collection
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

SIZES_PX = (128, 440)  # least and most; raw frames are made 256
ALIGNED_BY = 100  # images of a folder, at most
SHARE = 3  # of a folder's images at most one in so many aligns it


@dataclass(frozen=True)
class RecordedImages:
    """One folder's images, sampled."""

    name: str
    images: np.ndarray  # (N, S, S) uint8
    poses: np.ndarray | None
    moves: np.ndarray | None
    names: tuple[str, ...] = ()  # of the images, below the folder of all recordings

    @property
    def labelled_rows(self) -> np.ndarray:
        """(N,) bool: pose known, and the slide where the folder has any: one that cannot be read is no tap."""
        if self.poses is None:
            return np.zeros(len(self.images), bool)
        known = np.isfinite(self.poses).all(axis=-1)
        if self.moves is not None and np.isfinite(self.moves).any():
            known &= np.isfinite(self.moves).all(axis=-1)
        return known

    def observe(self, sensor: Sensor) -> PinObservation:
        """Its pins, with a line of progress."""
        with Progress(f"pins of {self.name}", len(self.images)) as progress:
            return observe_pins(self.images, sensor, progress)


def sample_folders(path: Path, images: int, seed: int) -> tuple[list[RecordedImages], list[str]]:
    """A sample of every folder's images at a size that costs them nothing, and notes on what cannot be read."""
    recordings, notes = open_recordings(path)
    folders = group_rows_by_folder(recordings)
    generator = np.random.default_rng(seed)
    count = max(1, images // len(folders))
    chosen = [_choose(recordings.moves, rows, count, generator) for rows in folders]
    parts, more = load_images(recordings, chosen)
    return parts, notes + more


class Parts(NamedTuple):
    """One folder's images: those that show how labels and images go together, and those compared."""

    align: RecordedImages
    scored: RecordedImages


def split_folders(
    path: Path, each: int | None, seed: int, used: Collection[str]
) -> tuple[list[Parts], list[str]]:
    """Split every folder of recordings at `path` in two parts, and give notes.

    `each`: images of a folder that are compared, at most; None: all. What `used` names (images as
    `Recorded.names` has them, or the end of such a name) is not compared; it aligns before others
    do. Raises `UserError` where nothing is left to compare.
    """
    recordings, notes = open_recordings(path)
    generator, spent = np.random.default_rng(seed), are_among(recordings.names, used)
    align, scored = [], []
    for rows in group_rows_by_folder(recordings):
        rows = generator.permutation(rows)
        seen = spent[rows]
        fresh, count = rows[~seen], min(ALIGNED_BY, -(-len(rows) // SHARE))
        if seen.any():
            folder = recordings.names[rows[0]].rpartition("/")[0] or path.name
            fitted = f"{int(seen.sum())} of {len(rows)} images, which the calibration was fitted to"
            notes.append(f"{folder}: {fitted}, are not compared")
        missing = max(0, count - int(seen.sum()))
        align.append(np.sort(np.concatenate([rows[seen][:count], fresh[:missing]])))
        scored.append(np.sort(fresh[missing:][:each]))
    if not any(len(rows) for rows in scored):
        raise UserError(
            f"{path}: the calibration was fitted to all its images: compare with others"
        )
    kept = [(a, s) for a, s in zip(align, scored, strict=True) if len(s)]
    first, more = load_images(recordings, [pair[0] for pair in kept])
    second, still = load_images(recordings, [pair[1] for pair in kept])
    by_name = {part.name: part for part in first}
    return [
        Parts(by_name[part.name], part) for part in second if part.name in by_name
    ], notes + more + still


def are_among(names: Collection[str], used: Collection[str]) -> np.ndarray:
    """Mark the names that are `used`, (N,) bool, wherever their folders were given from.

    Of two names of one image, given from higher up and from lower down, one ends with the other.
    """
    ends = tuple(f"/{name}" for name in used)
    return np.array(
        [
            f"/{name}".endswith(ends) or any(end.endswith(f"/{name}") for end in ends)
            for name in names
        ],
        bool,
    )


def open_recordings(path: Path) -> tuple[Recordings, list[str]]:
    """The recordings at a size that costs their images nothing, and notes on what cannot be read."""
    probe = read_recordings(path, Preprocess())
    first = to_grey(_first(probe))
    size = int(np.clip(min(first.shape), *SIZES_PX)) if is_binary(first) else 256
    return replace(probe, preprocess=Preprocess(size=size)), list(probe.notes)


def group_rows_by_folder(recordings: Recordings) -> list[np.ndarray]:
    """The rows of each folder of images."""
    folders = sorted({file.parent for file in recordings.files})
    return [
        np.array([i for i, file in enumerate(recordings.files) if file.parent == folder])
        for folder in folders
    ]


def load_images(
    recordings: Recordings, chosen: list[np.ndarray]
) -> tuple[list[RecordedImages], list[str]]:
    """The images of the rows chosen of each folder, and notes; a folder of which none can be read is left out. Raises `UserError`
    where none of any can be."""
    parts, notes = [], []
    problem: UserError | None = None
    path = recordings.path
    for rows in chosen:
        if not len(rows):
            continue
        sample = _take(recordings, rows)
        frames: list[tuple[int, str, np.ndarray]] = []
        try:
            frames += sample.iterate_frames()
        except UserError as error:  # not one of them can be read
            problem = error
        notes += sample.notes
        if not frames:
            continue
        kept = np.array([row for row, _, _ in frames])
        parts.append(
            RecordedImages(
                _name(path, sample.files[0].parent) if path.is_dir() else path.name,
                np.array([image for _, _, image in frames]),
                None if sample.poses is None else sample.poses[kept],
                None if sample.moves is None else sample.moves[kept],
                tuple(name for _, name, _ in frames),
            )
        )
    if problem is not None and not parts:
        raise problem
    return parts, notes


def _name(path: Path, folder: Path) -> str:
    """Of the recording whose images lie in `folder`; no two in `path` have the same."""
    recording = folder.parent if folder != path and folder.name in IMAGE_FOLDERS else folder
    return recording.relative_to(path.parent).as_posix()


def _first(recordings: Recordings) -> np.ndarray:
    """The first image that can be read."""
    for file in recordings.files[:-1]:
        with contextlib.suppress(UserError):  # `frames` will report it
            return read_image(file)
    return read_image(recordings.files[-1])


def _choose(
    moves: np.ndarray | None, rows: np.ndarray, count: int, generator: np.random.Generator
) -> np.ndarray:
    """At most `count` rows, with short slides as likely as long ones: they are rare, and say most about sticking."""
    rows = generator.permutation(rows)
    if moves is None or len(rows) <= count:
        return np.sort(rows[:count])
    length = np.nan_to_num(np.linalg.norm(moves[rows, :3], axis=-1))
    rank = np.zeros(len(rows))
    for bin in np.unique(np.floor(length)):
        here = np.floor(length) == bin
        rank[here] = np.arange(here.sum())
    return np.sort(rows[np.argsort(rank, kind="stable")[:count]])


def _take(recordings: Recordings, rows: np.ndarray) -> Recordings:
    return replace(
        recordings,
        files=tuple(recordings.files[row] for row in rows),
        poses=None if recordings.poses is None else recordings.poses[rows],
        moves=None if recordings.moves is None else recordings.moves[rows],
        notes=[],
    )
