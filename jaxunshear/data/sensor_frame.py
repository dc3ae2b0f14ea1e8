"""What a camera's recorded frames have in common: sensor, crop, whites, and the pins at rest.

sensor = identify_sensor(contacts, settings.preprocess)  # by the number of pins
frame = find_sensor_frame(contacts, settings, sensor)

All of it is found from training frames alone. Imports no JAX until images are read.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxunshear.config.data import Recorded
from jaxunshear.config.sensor import SENSORS, Preprocess, Sensor
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.recorded_contacts import RecordedContacts
from jaxunshear.data.recordings import (
    Recordings,
    find_common_view,
    read_first_image,
    read_image,
    read_recordings,
)
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.selection import select_evenly

if TYPE_CHECKING:
    from jaxunshear.perception.lattice import Lattice
    from jaxunshear.perception.preprocess import View

LARGEST_PX = 256  # pins are detected at the frames' own size, at most this
PROBES = 20  # training frames that crop, sensor and lattice are found from
COUNTED_FRAMES = 5  # of them, whose pins are counted
MAX_PIN_COUNT_ERROR = 0.15  # of a sensor's pins, by which a count may miss
MIN_FRAMES = 20  # contacts whose mean shows the rest positions
LIKE_REMEDY = (
    "name a folder of contacts of the same sensor and camera by --like (`like=` in Python)"
)
LATTICE_FRAMES = 60  # training frames that the rest positions are found from


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
    lost: tuple[int, ...] = ()  # pins that no frame shows

    def make_detection_lattice(self) -> "Lattice":
        """Make the lattice, px of the images that pins are detected in."""
        from jaxunshear.perception.lattice import make_lattice

        return make_lattice(to_detection_px(self, self.rest), self.ring, self.lost)

    def describe(self) -> Json:
        """Describe the frame as metadata keep it; `parse_frame` reads it."""
        return {
            "box": self.view.box,
            "whites": self.view.whites,
            "frame_px": self.view.frame_px,
            "dark": self.view.dark,
            "place_px": np.round(self.rest, 4).tolist(),
            "shell": self.ring.tolist(),
            "spacing_px": round(self.spacing_px, 4),
            "radius_px": round(self.radius_px, 4),
            "size": self.size,
            "pins_px": self.pins_px,
            "lost": self.lost,
        }


def parse_frame(stored: Json) -> SensorFrame:
    """Parse what metadata keep of a sensor's frames."""
    from jaxunshear.perception.preprocess import Box, View

    whites = tuple((kind, white) for kind, white in stored["whites"])
    box = Box(*stored["box"]) if stored["box"] else None
    height, width = stored.get("frame_px") or (0, 0)  # frames of before are not scaled
    return SensorFrame(
        view=View(box, whites, (height, width) if height else None, stored.get("dark", False)),
        rest=np.array(stored["place_px"]),
        ring=np.array(stored["shell"]),
        spacing_px=stored["spacing_px"],
        radius_px=stored["radius_px"],
        size=stored["size"],
        pins_px=stored["pins_px"],
        lost=tuple(stored.get("lost", ())),  # sets of before this field have none
    )


def identify_sensor(contacts: RecordedContacts, preprocess: Preprocess) -> Sensor:
    """Return the sensor with as many pins as some training frames show.

    Raises UserError if there is none, or no frame can be read.
    """
    from jaxunshear.perception.pin_detection import detect_pin_centres
    from jaxunshear.perception.preprocess import prepare_frame

    view, counts, problem = find_training_view(contacts, preprocess), list[int](), ""
    probes = select_probes(contacts)
    for row in probes:
        try:
            raw = read_image(contacts.files[row])
            size = min(LARGEST_PX, *raw.shape[:2])
            image = prepare_frame(replace(preprocess, size=size), raw, view)
        except UserError as error:
            problem = f"{contacts.names[row]}: {error}"
            continue
        counts.append(len(detect_pin_centres(image)))
        if len(counts) == COUNTED_FRAMES:
            break
    folder = contacts.files[0].parent
    if not counts:
        raise UserError(
            f"none of {len(probes)} images of {folder} can be read; the last: {problem}"
        )
    try:
        return match_sensor(counts, MAX_PIN_COUNT_ERROR, str(folder))
    except UserError as error:
        raise explain_failure(error, contacts.files[probes[0]]) from error


def explain_failure(error: UserError, file: Path) -> UserError:
    """Return the error for frames whose pins are not understood, by the light and focus of one."""
    from jaxunshear.perception.grey import explain_exposure, to_grey

    try:
        exposure = explain_exposure(to_grey(read_image(file)))
    except UserError:
        return error
    return UserError(f"{file.parent}: {exposure}") if exposure else error


def match_sensor(pin_counts: Sequence[int], max_error: float, place: str) -> Sensor:
    """Return the dome whose number of pins is nearest to the median of those in some images.

    Raises UserError if it misses by more than `max_error` of the sensor's pins.
    """
    pins = float(np.median(pin_counts))
    domes = [sensor for sensor in SENSORS.values() if not sensor.is_flat]
    nearest = min(domes, key=lambda sensor: abs(sensor.pins - pins))
    if abs(nearest.pins - pins) > max_error * nearest.pins:
        presets = ", ".join(f"{sensor.name} ({sensor.pins})" for sensor in domes)
        raise UserError(
            f"{place}: about {pins:.0f} pins are found in an image, "
            f"which is none of the known domes: {presets}; for another sensor make a file by "
            "`jaxunshear layout`, and name it by --layout"
        )
    return nearest


def select_probes(contacts: RecordedContacts) -> np.ndarray:
    """Select the rows of up to PROBES training contacts, evenly spaced.

    What a camera's frames have in common is found from these alone.
    """
    rows = np.flatnonzero(contacts.split == SPLITS.index("train"))
    return rows[select_evenly(len(rows), PROBES)]


def find_training_view(
    contacts: RecordedContacts, preprocess: Preprocess, dark: bool = False
) -> "View":
    """Find the crop and whites of the training frames; no crop if these differ in size.

    `dark`: markers are dark on a light ground.
    """
    files = [contacts.files[row] for row in select_probes(contacts)]
    return find_common_view(files, preprocess, dark)


def find_sensor_frame(
    contacts: RecordedContacts, settings: Recorded, sensor: Sensor
) -> SensorFrame:
    """Find what frames have in common from training frames, taps if there are any.

    Raises UserError if they do not show pins of this sensor.
    """
    view = find_training_view(contacts, settings.preprocess, sensor.is_dark)
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
    first = read_first_image(files)
    assert first is not None  # it has a crop
    size = min(LARGEST_PX, *first.shape[:2])
    try:
        return _fit_sensor_frame(files, view, size, preprocess, sensor)
    except UserError:
        with suppress(UserError):  # dark pins in white
            return _fit_sensor_frame(files, view, size, preprocess, sensor, inverted=True)
        raise


def read_frames(path: Path, preprocess: Preprocess, view: "View | None") -> np.ndarray:
    """Read up to LATTICE_FRAMES frames as binary images (N, S, S), evenly spaced.

    Raises UserError if there are none.
    """
    recordings = read_recordings(path, preprocess)
    rows = select_evenly(len(recordings), LATTICE_FRAMES)
    some = replace(recordings, files=tuple(recordings.files[row] for row in rows))
    return np.stack([frame.image for frame in some.iterate_frames(view)])


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
    try:
        lattice = fit_lattice([each.pins for each in detected], make_layout(sensor))
    except UserError as error:
        raise explain_failure(error, files[0]) from error
    scale = preprocess.size / size
    return SensorFrame(
        view=view,
        rest=(lattice.rest + 0.5) * scale - 0.5,
        ring=lattice.ring,
        spacing_px=scale * lattice.spacing,
        radius_px=scale * float(np.median([each.radius for each in detected])),
        size=preprocess.size,
        pins_px=size,
        lost=lattice.lost,
    )


def to_detection_px(frame: SensorFrame, pins: np.ndarray) -> np.ndarray:
    """Convert px of the prepared image to px of the one that pins are detected in."""
    return (pins + 0.5) * (frame.pins_px / frame.size) - 0.5


def to_image_px(frame: SensorFrame, pins: np.ndarray) -> np.ndarray:
    """Convert px of the image that pins are detected in to px of the prepared image."""
    return (pins + 0.5) * (frame.size / frame.pins_px) - 0.5
