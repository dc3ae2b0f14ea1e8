"""Prepare recorded frames: binary images and pins by identity, in files of some hundred frames.

All cores take part. A killed run continues where it stopped, to the same bits. Then the frames are
made examples of `tactip_recorded`, and counted.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import numpy as np

from jaxunshear.config.data import Recorded
from jaxunshear.config.sensor import Preprocess
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import (
    PNG_LEVEL,
    Chunk,
    count_by_split,
    join_field,
    load_chunk,
    pack_bits,
    unpack_bits,
    write_chunks,
)
from jaxunshear.data.reader import Batch, concatenate_batches
from jaxunshear.data.recorded_contacts import RecordedContacts
from jaxunshear.data.recordings import read_image
from jaxunshear.data.sensor_frame import SensorFrame, to_detection_px, to_image_px
from jaxunshear.environment import count_cores
from jaxunshear.errors import UserError
from jaxunshear.files import Json, write_npz
from jaxunshear.perception.drawing import encode_png
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_detection import detect_pins
from jaxunshear.perception.pin_track import PinTrack
from jaxunshear.perception.pin_tracking import MotionPrior, fit_motion_prior, track_pins
from jaxunshear.perception.preprocess import prepare_frame
from jaxunshear.perception.worn_dome import track_worn_pins

CHUNK = 250  # frames in a file
NO_IMAGE = np.zeros((0, 1), np.uint8)
MAX_PRIOR_FRAMES = 2000  # training frames that the usual motions are found from
MAX_NAMED = 20  # dropped frames that metadata name, at most


def prepare_chunks(
    contacts: RecordedContacts,
    settings: Recorded,
    frame: SensorFrame,
    folder: Path,
    label: str = "read recordings",
) -> list[Path]:
    """Prepare the contacts in files of CHUNK each in `folder`; files that exist are kept.

    A file holds `number` (n,), `images` (n, bytes) at one bit a pixel, `pins` (n, P, 2) px of the
    image, NaN for missing ones, `sure` (whether pins are identified) and `usable` (n,), and
    `problem` (n,) of those that cannot be read.
    """
    count = len(contacts.files)
    numbers = [np.arange(start, min(start + CHUNK, count)) for start in range(0, count, CHUNK)]

    def prepare(missing: list[int]) -> Iterator[tuple[int, Chunk]]:
        jobs = []
        for i in missing:
            files = tuple(contacts.files[number] for number in numbers[i])
            jobs.append((files, numbers[i], settings.preprocess, frame))
        return zip(missing, _map_over_cores(_prepare_chunk, jobs), strict=True)

    paths = write_chunks(folder, numbers, prepare, label)
    prior = _fit_motion_prior(contacts, paths, frame)
    hard = [path for path in paths if _has_hard_frames(path)]
    retries = _map_over_cores(_retry_chunk, [(path, frame, prior) for path in hard])
    for path, chunk in zip(hard, retries, strict=True):
        write_npz(path, chunk)
    return paths


Result = TypeVar("Result")


def _map_over_cores(function: Callable[..., Result], jobs: list[tuple]) -> Iterator[Result]:
    """Yield `function(*job)` of each job, in order: in processes if there are two jobs or more."""
    pool, workers = None, min(count_cores(), len(jobs))
    if workers > 1:
        with suppress(OSError):  # no shared memory, as in some containers
            pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"))
    if pool is None:
        yield from (function(*job) for job in jobs)
        return
    with pool:
        yield from pool.map(function, *zip(*jobs, strict=True))


def _prepare_chunk(
    files: tuple[Path, ...], number: np.ndarray, preprocess: Preprocess, frame: SensorFrame
) -> Chunk:
    lattice = frame.make_detection_lattice()
    size, large = preprocess.size, replace(preprocess, size=frame.pins_px)
    images = np.zeros((len(files), size, size), np.uint8)
    large_images = np.zeros((len(files), frame.pins_px, frame.pins_px), np.uint8)
    pins = np.full((len(files), len(frame.rest), 2), np.nan, np.float32)
    identified, usable = np.zeros(len(files), bool), np.zeros(len(files), bool)
    problem = [""] * len(files)
    for i, file in enumerate(files):
        try:
            raw = read_image(file)
            image = prepare_frame(large, raw, frame.view)
            large_images[i] = image
            if size != frame.pins_px:
                image = prepare_frame(preprocess, raw, frame.view)
            images[i] = image
        except UserError as error:
            problem[i] = str(error)
            continue
        track = track_pins(lattice, detect_pins(large_images[i]))
        usable[i], identified[i] = True, track.identified
        pins[i] = _place_pins(frame, lattice, track)
    hard = usable & ~identified
    return {
        "number": number,
        "images": pack_bits(images),
        "seen": pack_bits(large_images[hard]) if hard.any() else NO_IMAGE,  # for `_retry_chunk`
        "pins": np.where(identified[:, None, None], pins, np.nan),
        "sure": identified,
        "usable": usable,
        "problem": np.array(problem),
        "tried": np.array(False),
    }


def _place_pins(frame: SensorFrame, lattice: Lattice, track: PinTrack) -> np.ndarray:
    """Place pins (P, 2) px in the prepared image; those that are lost stand as their neighbours."""
    motion = lattice.fill_holes(track.motion) if lattice.lost else track.motion
    return to_image_px(frame, lattice.rest + motion)


def _retry_chunk(path: Path, frame: SensorFrame, prior: MotionPrior | None) -> Chunk:
    """Track the frames that were not identified once more, with the usual motions of training."""
    chunk = load_chunk(path)
    lattice = frame.make_detection_lattice()
    rows = np.flatnonzero(chunk["usable"] & ~chunk["sure"])
    for row, image in zip(rows, unpack_bits(chunk["seen"], frame.pins_px), strict=True):
        detected = detect_pins(image)
        track = track_worn_pins(lattice, detected, track_pins(lattice, detected, prior))
        if track.identified:
            chunk["sure"][row] = True
            chunk["pins"][row] = _place_pins(frame, lattice, track)
    return chunk | {"tried": np.array(True), "seen": NO_IMAGE}


def _fit_motion_prior(
    contacts: RecordedContacts, paths: list[Path], frame: SensorFrame
) -> MotionPrior | None:
    """Fit the usual motions of pins to training frames; None if no frame needs it."""
    if not any(map(_has_hard_frames, paths)):
        return None
    lattice = frame.make_detection_lattice()
    train = contacts.split == SPLITS.index("train")
    tracks = []
    for path in paths:
        chunk = load_chunk(path)
        for pins in chunk["pins"][chunk["sure"] & train[chunk["number"]]]:
            motion = to_detection_px(frame, pins) - lattice.rest
            tracks.append(PinTrack(motion, np.zeros(0, int), 0.0, 0, 0, True))
    step = -(-len(tracks) // MAX_PRIOR_FRAMES) or 1
    return fit_motion_prior(lattice, tracks[::step])


def _has_hard_frames(path: Path) -> bool:
    chunk = load_chunk(path)
    return bool((chunk["usable"] & ~chunk["sure"]).any() and not chunk["tried"])


def summarise_recordings(contacts: RecordedContacts, frame: Json, paths: list[Path]) -> Json:
    """Return counts, and what else a reader must know of the set, as plain JSON.

    `frame` is what `SensorFrame.describe` gives. Raises UserError if no frame can be read.
    """
    chunks = [load_chunk(path) for path in paths]
    usable, identified = join_field(chunks, "usable"), join_field(chunks, "sure")
    counts = count_contacts(contacts, usable, identified, join_field(chunks, "problem"))
    if not usable.any():
        raise UserError(f"no frame can be read; the first: {counts['dropped_frames'][:1]}")
    white_shares = [np.unpackbits(chunk["images"], axis=-1).mean(axis=-1) for chunk in chunks]
    white = np.concatenate(white_shares)
    is_full = np.isfinite(join_field(chunks, "pins")).all(axis=(1, 2))
    return {
        "counts": counts,
        "frame": frame,
        "pins": {
            "sure": round(float(identified[usable].mean()), 6),
            "all_seen": round(float(is_full[usable].mean()), 6),
            "white": [round(float(q), 6) for q in np.quantile(white[usable], (0.01, 0.5, 0.99))],
        },
        "notes": list(contacts.notes),
        "others": list(contacts.others),
    }


def count_contacts(
    contacts: RecordedContacts, usable: np.ndarray, identified: np.ndarray, problem: np.ndarray
) -> Json:
    """Count contacts (N,) by split, all of them and by kind, and list those with a `problem`."""
    dropped = [f"{contacts.names[row]}: {problem[row]}" for row in np.flatnonzero(problem != "")]
    return {
        "contacts": len(usable),
        "dropped": int((~usable).sum()),
        "unsure": int((usable & ~identified).sum()),
        "written": count_by_split(contacts.split, usable),
        "taps": count_by_split(contacts.split, usable & ~contacts.is_slide),
        "slides": count_by_split(contacts.split, usable & contacts.is_slide),
        "dropped_frames": dropped[:MAX_NAMED],
    }


def _collect_fields(contacts: RecordedContacts, chunk: Chunk, selected: np.ndarray) -> Batch:
    """Collect the fields of the usable frames of a chunk that are `selected` (n,) bool.

    Images are at one bit a pixel; `others` are the further columns of the tables, if any.
    """
    kept = chunk["usable"] & selected
    number = chunk["number"][kept]
    fields = {
        "image": chunk["images"][kept],
        "pins": chunk["pins"][kept].astype(np.float32),
        "sure": chunk["sure"][kept].astype(np.int32),
        "slid": contacts.is_slide[number].astype(np.int32),
        "pose": contacts.pose[number].astype(np.float32),
        "move": contacts.move[number].astype(np.float32),
        "pose_id": contacts.pose_id[number].astype(np.int32),
        "number": number.astype(np.int32),
    }
    columns = [values[number].astype(np.float32) for values in contacts.others.values()]
    return fields | ({"others": np.stack(columns, axis=1)} if columns else {})


def iterate_examples(
    settings: Recorded, contacts: RecordedContacts, paths: list[Path], split: str
) -> Iterator[tuple[str, dict]]:
    """Iterate over (key, example) of every readable frame of a split."""
    in_split, size = contacts.split == SPLITS.index(split), settings.preprocess.size
    for chunk in map(load_chunk, paths):
        fields = _collect_fields(contacts, chunk, in_split[chunk["number"]])
        for i, number in enumerate(fields["number"].tolist()):
            example = {name: values[i] for name, values in fields.items()}
            example["image"] = encode_png(unpack_bits(example["image"], size), PNG_LEVEL)
            yield f"{number:08d}", example


class UnstoredSet:
    """Holds chunks of prepared frames in the place of a stored set, all in its test split."""

    def __init__(self, contacts: RecordedContacts, paths: list[Path], frame: Json) -> None:
        self.metadata = summarise_recordings(contacts, frame, paths)
        parts = []
        for chunk in map(load_chunk, paths):
            parts.append(_collect_fields(contacts, chunk, np.ones(len(chunk["number"]), bool)))
        self._test = concatenate_batches(parts)

    def rows(self, split: str) -> Batch:
        """Return the rows of a split by field: none except for the test."""
        if split == "test":
            return self._test
        return {name: value[:0] for name, value in self._test.items()}
