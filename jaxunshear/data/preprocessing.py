"""Recorded frames -> binary images and pins by identity, in files of some hundred frames, on all cores.

What all frames have in common (crop, lattice of the untouched pins, the usual motions that help with hard frames) is found from
training frames alone. A killed run goes on where it stopped, to the same bits.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from jaxunshear.config.data import Recorded
from jaxunshear.config.image import Preprocess
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import load_chunk, pack_bits, unpack_bits
from jaxunshear.data.recorded_contacts import (
    LARGEST_PX,
    RecordedContacts,
    find_common_view,
    select_probes,
)
from jaxunshear.data.recordings import Recordings, read_image
from jaxunshear.environment import count_cores
from jaxunshear.errors import UserError
from jaxunshear.files import write_npz
from jaxunshear.progress import Progress
from jaxunshear.selection import select_evenly

if TYPE_CHECKING:
    from jaxunshear.perception.lattice import Lattice
    from jaxunshear.perception.pin_tracking import MotionPrior
    from jaxunshear.perception.preprocess import View

CHUNK = 250  # frames in a file
NO_IMAGE = np.zeros((0, 1), np.uint8)
MIN_FRAMES = 20  # contacts whose mean shows where pins stand
LIKE_REMEDY = (
    "name a folder of contacts of the same sensor and camera by --like (`like=` in Python)"
)
LATTICE_FRAMES = 60  # training frames that the untouched pins are found from


class SensorFrame(NamedTuple):
    """What the frames of a sensor have in common: how they are cropped, and where its pins stand untouched."""

    view: "View"
    rest: (
        np.ndarray
    )  # (P, 2) px of the prepared image, as (column, row): the mean place over training taps
    ring: np.ndarray  # (P,) 0 in the middle
    spacing_px: float
    radius_px: float  # of a pin
    size: int  # side of the prepared images, px
    pins_px: int  # side of the images that pins are found in


def find_sensor_frame(
    contacts: RecordedContacts, settings: Recorded, sensor: Sensor
) -> SensorFrame:
    """From training frames, taps if there are any. Raises UserError where they do not show pins of this sensor."""
    view = find_common_view(contacts, settings.preprocess)
    size = min(LARGEST_PX, *read_image(contacts.files[select_probes(contacts)[0]]).shape[:2])
    train = np.flatnonzero(contacts.split == SPLITS.index("train"))
    taps = train[~contacts.is_slide[train]]
    files = [contacts.files[row] for row in (taps if len(taps) else train)]
    return find_files_frame(files, view, size, settings.preprocess, sensor)


def find_recordings_frame(
    recordings: Recordings, preprocess: Preprocess, sensor: Sensor
) -> SensorFrame:
    """Of a folder whose contacts nothing is known of. Raises UserError where it holds too few images, or not of this sensor."""
    files = recordings.files
    if len(files) < MIN_FRAMES:
        raise UserError(
            f"{recordings.path} holds {len(files)} images; the mean over {MIN_FRAMES} contacts or more shows where pins stand: {LIKE_REMEDY}"
        )
    view = recordings.find_common_view()
    if view.box is None:
        raise UserError(
            f"{recordings.path}: its images have no crop in common: name one folder of one camera"
        )
    size = min(LARGEST_PX, *_first(files).shape[:2])
    try:
        return find_files_frame(files, view, size, preprocess, sensor)
    except UserError:
        with suppress(UserError):  # dark pins in white
            return find_files_frame(files, view, size, preprocess, sensor, turned=True)
        raise


def _first(files: Sequence[Path]) -> np.ndarray:
    """The first that can be read. Raises UserError."""
    for file in files:
        with suppress(UserError):
            return read_image(file)
    raise UserError(f"none of {len(files)} images, such as {files[0]}, can be read")


def find_files_frame(
    files: Sequence[Path],
    view: "View",
    size: int,
    preprocess: Preprocess,
    sensor: Sensor,
    turned: bool = False,
) -> SensorFrame:
    """From up to LATTICE_FRAMES of the files, evenly spaced, seen at `size` px; `turned` where pins are dark in white."""
    from jaxunshear.perception.lattice_fitting import fit_lattice, make_layout
    from jaxunshear.perception.pin_detection import detect_pins
    from jaxunshear.perception.preprocess import prepare_frame
    from jaxunshear.perception.sensor_check import invert_image

    rows = select_evenly(len(files), LATTICE_FRAMES)
    found = []
    for row in rows:
        try:
            image = prepare_frame(replace(preprocess, size=size), read_image(files[row]), view)
            found.append(detect_pins(invert_image(image) if turned else image))
        except UserError:
            continue  # reported once all frames are read
    lattice = fit_lattice([each.pins for each in found], make_layout(sensor))
    scale = preprocess.size / size
    place = (lattice.rest + 0.5) * scale - 0.5
    radius = scale * float(np.median([each.radius for each in found]))
    return SensorFrame(
        view, place, lattice.ring, scale * lattice.spacing, radius, preprocess.size, size
    )


def prepare_chunks(
    contacts: RecordedContacts,
    settings: Recorded,
    frame: SensorFrame,
    folder: Path,
    label: str = "read recordings",
) -> list[Path]:
    """Files in `folder`, each of CHUNK contacts: `number` (n,), `images` (n, bytes) at one bit a pixel, `pins` (n, P, 2) px of the
    image, NaN where one is not seen, `sure` and `usable` (n,), and `problem` (n,) of those that cannot be read."""
    count = len(contacts.files)
    numbers = [np.arange(start, min(start + CHUNK, count)) for start in range(0, count, CHUNK)]
    paths = [folder / f"{index:05d}.npz" for index in range(len(numbers))]
    left = [i for i, path in enumerate(paths) if not path.exists()]
    done = sum(len(numbers[i]) for i in range(len(paths)) if i not in left)
    with Progress(label, count, "frames", done=done) as progress:
        jobs = [
            (tuple(contacts.files[n] for n in numbers[i]), numbers[i], settings.preprocess, frame)
            for i in left
        ]
        for i, chunk in zip(left, _each(_first_pass, jobs), strict=True):
            write_npz(paths[i], chunk)
            progress.advance(len(numbers[i]))
    usual = _fit_motion_prior(contacts, paths, frame)
    hard = [path for path in paths if usual is not None and _hard(path)]
    for path, chunk in zip(
        hard, _each(_second_pass, [(path, frame, usual) for path in hard]), strict=True
    ):
        write_npz(path, chunk)
    return paths


Done = TypeVar("Done")


def _each(work: Callable[..., Done], jobs: list[tuple]) -> Iterator[Done]:
    """`work(*job)` of each job, in order: in processes of their own where there is work enough for two."""
    workers = min(count_cores(), len(jobs))
    if workers < 2:
        yield from (work(*job) for job in jobs)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(work, *zip(*jobs, strict=True))


def _first_pass(
    files: tuple[Path, ...], number: np.ndarray, preprocess: Preprocess, frame: SensorFrame
) -> dict:
    from jaxunshear.perception.pin_detection import detect_pins
    from jaxunshear.perception.pin_tracking import track_pins
    from jaxunshear.perception.preprocess import prepare_frame

    lattice = make_found_lattice(frame)
    size, large = preprocess.size, replace(preprocess, size=frame.pins_px)
    images = np.zeros((len(files), size, size), np.uint8)
    seen = np.zeros((len(files), frame.pins_px, frame.pins_px), np.uint8)
    pins = np.full((len(files), len(frame.rest), 2), np.nan, np.float32)
    sure, usable = np.zeros(len(files), bool), np.zeros(len(files), bool)
    problem = [""] * len(files)
    for i, file in enumerate(files):
        try:
            raw = read_image(file)
            seen[i] = prepare_frame(large, raw, frame.view)
            images[i] = (
                seen[i] if size == frame.pins_px else prepare_frame(preprocess, raw, frame.view)
            )
        except UserError as error:
            problem[i] = str(error)
            continue
        track = track_pins(lattice, detect_pins(seen[i]))
        usable[i], sure[i] = True, track.identified
        pins[i] = to_image_px(frame, lattice.rest + track.motion)
    return {
        "number": number,
        "images": pack_bits(images),
        "seen": pack_bits(seen[usable & ~sure])
        if (usable & ~sure).any()
        else NO_IMAGE,  # to be tried once more
        "pins": np.where(sure[:, None, None], pins, np.nan),
        "sure": sure,
        "usable": usable,
        "problem": np.array(problem),
        "tried": np.array(False),
    }


def _second_pass(path: Path, frame: SensorFrame, usual: "MotionPrior") -> dict:
    """The frames that were not sure once more, with the help of the motions that are usual in training."""
    from jaxunshear.perception.pin_detection import detect_pins
    from jaxunshear.perception.pin_tracking import track_pins

    chunk = load_chunk(path)
    lattice = make_found_lattice(frame)
    rows = np.flatnonzero(chunk["usable"] & ~chunk["sure"])
    for row, image in zip(rows, unpack_bits(chunk["seen"], frame.pins_px), strict=True):
        track = track_pins(lattice, detect_pins(image), usual)
        if track.identified:
            chunk["sure"][row] = True
            chunk["pins"][row] = to_image_px(frame, lattice.rest + track.motion)
    return chunk | {"tried": np.array(True), "seen": NO_IMAGE}


def _fit_motion_prior(
    contacts: RecordedContacts, paths: list[Path], frame: SensorFrame
) -> "MotionPrior | None":
    """How pins usually move, in training frames; None where no frame needs it."""
    from jaxunshear.perception.pin_track import PinTrack
    from jaxunshear.perception.pin_tracking import fit_motion_prior

    if not any(map(_hard, paths)):
        return None
    chunks = [load_chunk(path) for path in paths]
    lattice = make_found_lattice(frame)
    train = contacts.split == SPLITS.index("train")
    tracks = [
        PinTrack(to_detection_px(frame, pins) - lattice.rest, np.zeros(0, int), 0.0, 0, 0, True)
        for chunk in chunks
        for pins in chunk["pins"][chunk["sure"] & train[chunk["number"]]]
    ]
    step = -(-len(tracks) // 2000) or 1
    return fit_motion_prior(lattice, tracks[::step])


def _hard(path: Path) -> bool:
    chunk = load_chunk(path)
    return bool((chunk["usable"] & ~chunk["sure"]).any() and not chunk["tried"])


def make_found_lattice(frame: SensorFrame) -> "Lattice":
    """The untouched pins, px of the image that pins are found in."""
    from jaxunshear.perception.lattice import make_lattice

    return make_lattice(to_detection_px(frame, frame.rest), frame.ring)


def to_detection_px(frame: SensorFrame, pins: np.ndarray) -> np.ndarray:
    """From px of the prepared image to px of the one that pins are found in."""
    return (pins + 0.5) * (frame.pins_px / frame.size) - 0.5


def to_image_px(frame: SensorFrame, pins: np.ndarray) -> np.ndarray:
    return (pins + 0.5) * (frame.size / frame.pins_px) - 0.5
