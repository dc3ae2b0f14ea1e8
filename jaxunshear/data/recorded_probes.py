"""Find what a camera's recorded frames have in common from a few of them: sensor, crop, whites.

sensor = identify_sensor(contacts, settings.preprocess)  # by the number of pins

Imports no JAX until images are read.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from jaxunshear.config.sensor import SENSORS, Preprocess, Sensor
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.recorded_contacts import RecordedContacts
from jaxunshear.data.recordings import find_common_view, read_image
from jaxunshear.errors import UserError
from jaxunshear.selection import select_evenly

if TYPE_CHECKING:
    from jaxunshear.perception.preprocess import View

LARGEST_PX = 256  # pins are detected at the frames' own size, at most this
PROBES = 20  # training frames that crop, sensor and lattice are found from
COUNTED_FRAMES = 5  # of them, whose pins are counted
MAX_PIN_COUNT_ERROR = 0.15  # of a sensor's pins, by which a count may miss


def identify_sensor(contacts: RecordedContacts, preprocess: Preprocess) -> Sensor:
    """Return the sensor with as many pins as some training frames show.

    Raises UserError if there is none.
    """
    from jaxunshear.perception.pin_detection import find_pins

    images = _prepare_probes(contacts, preprocess)[:COUNTED_FRAMES]
    pins = float(np.median([len(find_pins(image)) for image in images]))
    nearest = min(SENSORS.values(), key=lambda sensor: abs(sensor.pins - pins))
    if abs(nearest.pins - pins) > MAX_PIN_COUNT_ERROR * nearest.pins:
        numbers = ", ".join(dict.fromkeys(str(sensor.pins) for sensor in SENSORS.values()))
        raise UserError(
            f"{contacts.files[0].parent}: about {pins:.0f} pins are found in an image; "
            f"known are sensors of {numbers} pins"
        )
    return nearest


def select_probes(contacts: RecordedContacts) -> np.ndarray:
    """Select the rows of up to PROBES training contacts, evenly spaced.

    What a camera's frames have in common is found from these alone.
    """
    rows = np.flatnonzero(contacts.split == SPLITS.index("train"))
    return rows[select_evenly(len(rows), PROBES)]


def find_training_view(contacts: RecordedContacts, preprocess: Preprocess) -> "View":
    """Find the crop and whites of the training frames; no crop if these differ in size."""
    return find_common_view([contacts.files[row] for row in select_probes(contacts)], preprocess)


def _prepare_probes(contacts: RecordedContacts, preprocess: Preprocess) -> list[np.ndarray]:
    from jaxunshear.perception.preprocess import prepare_frame

    view, images, problem = find_training_view(contacts, preprocess), [], ""
    for row in select_probes(contacts):
        try:
            raw = read_image(contacts.files[row])
            size = min(LARGEST_PX, *raw.shape[:2])
            images.append(prepare_frame(replace(preprocess, size=size), raw, view))
        except UserError as error:
            problem = f"{contacts.names[row]}: {error}"
    if not images:
        raise UserError(
            f"none of {len(select_probes(contacts))} images of {contacts.files[0].parent} "
            f"can be read; the last: {problem}"
        )
    return images
