"""Prepare recorded frames: binary images and pins by identity, in files of some hundred frames.

What all frames have in common (crop, lattice at rest, the usual motions that help with hard frames)
is found from training frames alone. All cores take part. A killed run continues where it stopped,
to the same bits.
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
from jaxunshear.config.sensor import Preprocess, Sensor
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import Chunk, load_chunk, pack_bits, unpack_bits, write_chunks
from jaxunshear.data.recorded_contacts import RecordedContacts
from jaxunshear.data.recorded_probes import LARGEST_PX, find_training_view, select_probes
from jaxunshear.data.recordings import Recordings, read_image
from jaxunshear.environment import count_cores
from jaxunshear.errors import UserError
from jaxunshear.files import write_npz
from jaxunshear.selection import select_evenly

if TYPE_CHECKING:
    from jaxunshear.perception.lattice import Lattice
    from jaxunshear.perception.pin_tracking import MotionPrior
    from jaxunshear.perception.preprocess import View

CHUNK = 250  # frames in a file
NO_IMAGE = np.zeros((0, 1), np.uint8)
MIN_FRAMES = 20  # contacts whose mean shows the rest positions
LIKE_REMEDY = (
    "name a folder of contacts of the same sensor and camera by --like (`like=` in Python)"
)
LATTICE_FRAMES = 60  # training frames that the rest positions are found from
MAX_PRIOR_FRAMES = 2000  # training frames that the usual motions are found from


class SensorFrame(NamedTuple):
    """What the frames of a sensor have in common: the crop, and the pins' rest positions."""

    view: "View"
    # (P, 2) px of the prepared image, as (column, row): the mean position over training taps
    rest: np.ndarray
    ring: np.ndarray  # (P,) 0 in the middle
    spacing_px: float
    radius_px: float  # of a pin
    size: int  # side of the prepared images, px
    pins_px: int  # side of the images that pins are detected in


def find_sensor_frame(
    contacts: RecordedContacts, settings: Recorded, sensor: Sensor
) -> SensorFrame:
    """Find what frames have in common from training frames, taps if there are any.

    Raises UserError if they do not show pins of this sensor.
    """
    view = find_training_view(contacts, settings.preprocess)
    size = min(LARGEST_PX, *read_image(contacts.files[select_probes(contacts)[0]]).shape[:2])
    train = np.flatnonzero(contacts.split == SPLITS.index("train"))
    taps = train[~contacts.is_slide[train]]
    files = [contacts.files[row] for row in (taps if len(taps) else train)]
    return _fit_sensor_frame(files, view, size, settings.preprocess, sensor)


def find_recordings_frame(
    recordings: Recordings, preprocess: Preprocess, sensor: Sensor
) -> SensorFrame:
    """Find what frames have in common from a folder of contacts without labels.

    Raises UserError if it holds too few images, or images of another sensor.
    """
    files = recordings.files
    if len(files) < MIN_FRAMES:
        raise UserError(
            f"{recordings.path} holds {len(files)} images; the mean over {MIN_FRAMES} contacts "
            f"or more shows where pins stand: {LIKE_REMEDY}"
        )
    view = recordings.find_common_view()
    if view.box is None:
        raise UserError(
            f"{recordings.path}: its images have no crop in common: name one folder of one camera"
        )
    size = min(LARGEST_PX, *_read_first_image(files).shape[:2])
    try:
        return _fit_sensor_frame(files, view, size, preprocess, sensor)
    except UserError:
        with suppress(UserError):  # dark pins in white
            return _fit_sensor_frame(files, view, size, preprocess, sensor, inverted=True)
        raise


def _read_first_image(files: Sequence[Path]) -> np.ndarray:
    for file in files:
        with suppress(UserError):
            return read_image(file)
    raise UserError(f"none of {len(files)} images, such as {files[0]}, can be read")


def _fit_sensor_frame(
    files: Sequence[Path],
    view: "View",
    size: int,
    preprocess: Preprocess,
    sensor: Sensor,
    inverted: bool = False,
) -> SensorFrame:
    """Fit what frames have in common to up to LATTICE_FRAMES of the files, evenly spaced.

    They are prepared at `size` px. `inverted`: pins are dark in white.
    """
    from jaxunshear.perception.lattice_fitting import fit_lattice, make_layout
    from jaxunshear.perception.pin_detection import detect_pins
    from jaxunshear.perception.preprocess import prepare_frame
    from jaxunshear.perception.sensor_check import invert_image

    detected = []
    for row in select_evenly(len(files), LATTICE_FRAMES):
        try:
            image = prepare_frame(replace(preprocess, size=size), read_image(files[row]), view)
        except UserError:
            continue  # reported once all frames are read
        detected.append(detect_pins(invert_image(image) if inverted else image))
    lattice = fit_lattice([each.pins for each in detected], make_layout(sensor))
    scale = preprocess.size / size
    return SensorFrame(
        view=view,
        rest=(lattice.rest + 0.5) * scale - 0.5,
        ring=lattice.ring,
        spacing_px=scale * lattice.spacing,
        radius_px=scale * float(np.median([each.radius for each in detected])),
        size=preprocess.size,
        pins_px=size,
    )


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

    def prepare(missing: list[int]) -> Iterator[Chunk]:
        jobs = []
        for i in missing:
            files = tuple(contacts.files[number] for number in numbers[i])
            jobs.append((files, numbers[i], settings.preprocess, frame))
        return _map_over_cores(_prepare_chunk, jobs)

    paths = write_chunks(folder, numbers, prepare, label)
    prior = _fit_motion_prior(contacts, paths, frame)
    hard = [path for path in paths if prior is not None and _has_hard_frames(path)]
    retries = _map_over_cores(_retry_chunk, [(path, frame, prior) for path in hard])
    for path, chunk in zip(hard, retries, strict=True):
        write_npz(path, chunk)
    return paths


Result = TypeVar("Result")


def _map_over_cores(function: Callable[..., Result], jobs: list[tuple]) -> Iterator[Result]:
    """Yield `function(*job)` of each job, in order: in processes if there are two jobs or more."""
    workers = min(count_cores(), len(jobs))
    if workers < 2:
        yield from (function(*job) for job in jobs)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(function, *zip(*jobs, strict=True))


def _prepare_chunk(
    files: tuple[Path, ...], number: np.ndarray, preprocess: Preprocess, frame: SensorFrame
) -> Chunk:
    from jaxunshear.perception.pin_detection import detect_pins
    from jaxunshear.perception.pin_tracking import track_pins
    from jaxunshear.perception.preprocess import prepare_frame

    lattice = _make_detection_lattice(frame)
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
        pins[i] = to_image_px(frame, lattice.rest + track.motion)
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


def _retry_chunk(path: Path, frame: SensorFrame, prior: "MotionPrior") -> Chunk:
    """Track the frames that were not identified once more, with the usual motions of training."""
    from jaxunshear.perception.pin_detection import detect_pins
    from jaxunshear.perception.pin_tracking import track_pins

    chunk = load_chunk(path)
    lattice = _make_detection_lattice(frame)
    rows = np.flatnonzero(chunk["usable"] & ~chunk["sure"])
    for row, image in zip(rows, unpack_bits(chunk["seen"], frame.pins_px), strict=True):
        track = track_pins(lattice, detect_pins(image), prior)
        if track.identified:
            chunk["sure"][row] = True
            chunk["pins"][row] = to_image_px(frame, lattice.rest + track.motion)
    return chunk | {"tried": np.array(True), "seen": NO_IMAGE}


def _fit_motion_prior(
    contacts: RecordedContacts, paths: list[Path], frame: SensorFrame
) -> "MotionPrior | None":
    """Fit the usual motions of pins to training frames; None if no frame needs it."""
    from jaxunshear.perception.pin_track import PinTrack
    from jaxunshear.perception.pin_tracking import fit_motion_prior

    if not any(map(_has_hard_frames, paths)):
        return None
    lattice = _make_detection_lattice(frame)
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


def _make_detection_lattice(frame: SensorFrame) -> "Lattice":
    from jaxunshear.perception.lattice import make_lattice

    return make_lattice(to_detection_px(frame, frame.rest), frame.ring)


def to_detection_px(frame: SensorFrame, pins: np.ndarray) -> np.ndarray:
    """Convert px of the prepared image to px of the one that pins are detected in."""
    return (pins + 0.5) * (frame.pins_px / frame.size) - 0.5


def to_image_px(frame: SensorFrame, pins: np.ndarray) -> np.ndarray:
    """Convert px of the image that pins are detected in to px of the prepared image."""
    return (pins + 0.5) * (frame.size / frame.pins_px) - 0.5
