"""Recorded images of a calibration: sampled folder by folder, and read as groups of contacts."""

import contextlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.calibration.alignment import MIN_CORRELATION, read_labels
from jaxunshear.calibration.pin_statistics import PinObservation, observe_pins
from jaxunshear.calibration.prediction import SensorValues
from jaxunshear.calibration.problem import RecordedGroup
from jaxunshear.config.sensor import Preprocess, Sensor
from jaxunshear.data.recordings import (
    IMAGE_FOLDERS,
    RecordedFrame,
    Recordings,
    read_image,
    read_recordings,
)
from jaxunshear.errors import UserError
from jaxunshear.perception.grey import is_binary, to_grey
from jaxunshear.progress import Progress

SIZES_PX = (128, 440)  # least and most for binary images
RAW_PX = 256  # of raw frames
ALIGNED_BY = 100  # most images that align a folder
SHARE = 3  # at most one of so many images of a folder aligns it
MIN_LABELLED = 12  # contacts from which the reading of the labels can be found
MAX_FRAMING_DIFFERENCE = 0.05  # of the outermost ring's radius; two cameras differ by more


@dataclass(frozen=True)
class RecordedImages:
    """Sampled images of one folder."""

    name: str
    images: np.ndarray  # (N, S, S) uint8
    poses: np.ndarray  # (N, 6) mm and deg, NaN if unknown
    moves: np.ndarray  # (N, 6) mm and deg, NaN if unknown
    names: tuple[str, ...] = ()  # of the images, below the folder of all recordings

    @property
    def labelled_rows(self) -> np.ndarray:
        """(N,) bool: the pose is known, and the slide if the folder has any.

        An image whose slide cannot be read is not a tap.
        """
        labelled = np.isfinite(self.poses).all(axis=-1)
        if np.isfinite(self.moves).any():
            labelled &= np.isfinite(self.moves).all(axis=-1)
        return labelled

    def observe(self, sensor: Sensor) -> PinObservation:
        """Observe the pins, and show the progress."""
        with Progress(f"pins of {self.name}", len(self.images)) as progress:
            return observe_pins(self.images, sensor, progress)


def sample_folders(path: Path, images: int, seed: int) -> tuple[list[RecordedImages], list[str]]:
    """Sample `images` images evenly over all folders; return notes on what cannot be read."""
    recordings = _open_recordings(path)
    return _load_images(recordings, _sample_rows(recordings, images, seed)), recordings.notes


def list_sampled_images(
    path: Path, images: int, seed: int, folders: Collection[str]
) -> tuple[str, ...]:
    """List which images `sample_folders` samples from some folders, named as in `split_folders`."""
    recordings, names = _open_recordings(path), []
    for row in _sample_rows(recordings, images, seed):
        folder = _name_recording(path, recordings.files[row])
        if any(f"/{name}".endswith(f"/{folder}") for name in folders):
            names.append(recordings.names[row])
    return tuple(names)


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
    recordings = _open_recordings(path)
    generator, is_used = np.random.default_rng(seed), are_among(recordings.names, used)
    align, scored = [], []
    for rows in _group_rows_by_folder(recordings):
        rows = generator.permutation(rows)
        used_rows, fresh_rows = rows[is_used[rows]], rows[~is_used[rows]]
        if len(used_rows):
            folder = _name_recording(path, recordings.files[rows[0]])
            recordings.notes.append(
                f"{folder}: {len(used_rows)} of {len(rows)} images, "
                "which the calibration was fitted to, are not compared"
            )
        count = min(ALIGNED_BY, -(-len(rows) // SHARE))
        missing = max(0, count - len(used_rows))
        compared = np.sort(fresh_rows[missing:][:each])
        if len(compared):
            align.append(np.sort(np.concatenate([used_rows[:count], fresh_rows[:missing]])))
            scored.append(compared)
    if not scored:
        raise UserError(
            f"{path}: the calibration was fitted to all its images: compare with others"
        )
    by_name = {part.name: part for part in _load_images(recordings, np.concatenate(align))}
    compared_parts = _load_images(recordings, np.concatenate(scored))
    splits = [
        FolderSplit(by_name[part.name], part) for part in compared_parts if part.name in by_name
    ]
    return splits, recordings.notes


def are_among(names: Sequence[str], used: Collection[str]) -> np.ndarray:
    """Mark the names that are `used`, (N,) bool, from whichever folder they were named.

    Of two names of one image, from a higher and from a lower folder, one ends with the other.
    """
    ends = tuple(f"/{name}" for name in used)

    def is_among(name: str) -> bool:
        return f"/{name}".endswith(ends) or any(end.endswith(f"/{name}") for end in ends)

    return np.array([is_among(name) for name in names], bool)


def _open_recordings(path: Path) -> Recordings:
    """Open recordings at the size of their images."""
    recordings, size = read_recordings(path, Preprocess()), RAW_PX
    for file in recordings.files:
        with contextlib.suppress(UserError):  # `iterate_frames` will report it
            first = to_grey(read_image(file))
            if is_binary(first):
                size = int(np.clip(min(first.shape), *SIZES_PX))
            break
    return replace(recordings, preprocess=Preprocess(size=size))


def _group_rows_by_folder(recordings: Recordings) -> list[np.ndarray]:
    rows: dict[Path, list[int]] = {}
    for row, file in enumerate(recordings.files):
        rows.setdefault(file.parent, []).append(row)
    return [np.array(rows[folder]) for folder in sorted(rows)]


def _sample_rows(recordings: Recordings, images: int, seed: int) -> np.ndarray:
    folders, generator = _group_rows_by_folder(recordings), np.random.default_rng(seed)
    count = max(1, images // len(folders))
    chosen = [_choose_rows(recordings.moves, rows, count, generator) for rows in folders]
    return np.concatenate(chosen)


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


def _load_images(recordings: Recordings, rows: np.ndarray) -> list[RecordedImages]:
    """Load the images of rows by folder, and note in the recordings what cannot be read.

    Raises `UserError` if nothing can be read.
    """
    sample = replace(recordings, files=tuple(recordings.files[row] for row in rows))
    by_folder: dict[str, list[RecordedFrame]] = {}
    for frame in sample.iterate_frames():
        folder = _name_recording(recordings.path, sample.files[frame.row])
        by_folder.setdefault(folder, []).append(frame)
    unknown = np.full((len(recordings), 6), np.nan)
    poses = unknown if recordings.poses is None else recordings.poses
    moves = unknown if recordings.moves is None else recordings.moves
    parts = []
    for folder, frames in by_folder.items():
        own = rows[[frame.row for frame in frames]]
        images, names = np.array([frame.image for frame in frames]), [f.name for f in frames]
        parts.append(RecordedImages(folder, images, poses[own], moves[own], tuple(names)))
    return parts


def _name_recording(path: Path, image: Path) -> str:
    """Name the recording of an image; no two in `path` have the same name."""
    if image == path:
        return path.name
    folder = image.parent
    recording = folder.parent if folder != path and folder.name in IMAGE_FOLDERS else folder
    return recording.relative_to(path.parent).as_posix()


def observe_groups(
    recorded: list[RecordedImages], start: SensorValues, notes: list[str]
) -> list[RecordedGroup]:
    """Observe the pins of every folder, and read its contacts.

    Folders whose labels and images do not agree are left out with a note. Raises `UserError` if
    that is so for all, or if the folders are of several cameras.
    """
    groups = []
    framing: dict[str, float] = {}  # radius of the outermost ring, as a share of the image size
    for part in recorded:
        observation = part.observe(start.base)
        count, identified = len(observation.identified), int(observation.identified.sum())
        if identified < count:
            notes.append(
                f"{part.name}: {count - identified} of {count} images left out, "
                "their pins cannot be followed surely"
            )
        group = _read_group(part, observation, start, notes)
        if group is not None:
            groups.append(group)
            rest, ring = observation.rest, observation.lattice.ring
            outer = np.linalg.norm(rest[ring == ring.max()], axis=-1).mean()
            framing[part.name] = float(outer / observation.size)
    if not groups:
        raise UserError(f"no labelled contacts to fit the simulator to: {'; '.join(notes)}")
    widest = max(framing, key=framing.__getitem__)
    narrowest = min(framing, key=framing.__getitem__)
    if framing[widest] > (1 + MAX_FRAMING_DIFFERENCE) * framing[narrowest]:
        raise UserError(
            f"{widest} and {narrowest} are framed differently: calibrate one camera at a time"
        )
    return groups


def _read_group(
    part: RecordedImages, observation: PinObservation, start: SensorValues, notes: list[str]
) -> RecordedGroup | None:
    """Read a folder's labels, and say in the notes what they are."""
    rows = np.flatnonzero(observation.identified & part.labelled_rows)
    if len(rows) < MIN_LABELLED:
        notes.append(
            f"{part.name}: left out, {len(rows)} contacts are labelled and followed, "
            f"fewer than {MIN_LABELLED}"
        )
        return None
    reading = read_labels(observation.take(rows), part.poses[rows], part.moves[rows], start)
    if reading is None:
        notes.append(
            f"{part.name}: left out, simulated touches as labelled move pins otherwise than these "
            f"images show (correlation below {MIN_CORRELATION})"
        )
        return None
    edge = ""
    if reading.side:
        sign = "negative" if reading.side > 0 else "positive"
        edge = f", an edge with the object on the side of its {sign} labels"
    notes.append(
        f"{part.name}: labels read with a correlation of {reading.correlation:.2f}{edge}; "
        f"camera turned by {np.degrees(reading.angle):.0f} deg"
    )
    rotated = observation.take(rows).rotate(reading.mirrored, reading.angle)
    contacts = reading.read_contacts(part.poses[rows], part.moves[rows])
    return RecordedGroup(part.name, rotated, contacts, reading.side, reading.frame.surface_mm)
