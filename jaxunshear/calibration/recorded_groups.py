"""Recorded images as groups that a calibration is fitted to: their sensor, pins and contacts."""

import numpy as np

from jaxunshear.calibration.alignment import MIN_CORRELATION, read_labels
from jaxunshear.calibration.pin_statistics import PinObservation
from jaxunshear.calibration.prediction import SensorValues
from jaxunshear.calibration.problem import RecordedGroup
from jaxunshear.calibration.sampling import RecordedImages
from jaxunshear.config.sensor import SENSORS, Sensor
from jaxunshear.errors import UserError
from jaxunshear.perception.pin_detection import find_pins

MIN_LABELLED = 12  # contacts from which the reading of the labels can be found
MAX_FRAMING_DIFFERENCE = 0.05  # of the outermost ring's radius; two cameras differ by more


def choose_sensor(recorded: list[RecordedImages]) -> Sensor:
    """Choose the preset with as many pins as are detected.

    Raises `UserError` if there is none.
    """
    counts = [len(find_pins(image)) for part in recorded for image in part.images[:5]]
    pins = float(np.median(counts))
    nearest = min(SENSORS.values(), key=lambda sensor: abs(sensor.pins - pins))
    if abs(nearest.pins - pins) > 0.1 * nearest.pins:
        presets = ", ".join(f"{sensor.name} ({sensor.pins})" for sensor in SENSORS.values())
        raise UserError(
            f"about {pins:.0f} pins are found in an image, "
            f"which is none of the known sensors: {presets}"
        )
    return nearest


def observe_groups(
    recorded: list[RecordedImages], start: SensorValues, notes: list[str]
) -> list[RecordedGroup]:
    """Observe the pins of every folder, and read its contacts.

    Folders whose labels and images do not agree are left out with a note. Raises `UserError` if
    that is so for all, or if the folders are of several cameras.
    """
    groups = []
    framing: dict[str, float] = {}
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
            framing[part.name] = _measure_framing(observation)
    if not groups:
        raise UserError(f"no labelled contacts to fit the simulator to: {'; '.join(notes)}")
    widest = max(framing, key=framing.__getitem__)
    narrowest = min(framing, key=framing.__getitem__)
    if framing[widest] > (1 + MAX_FRAMING_DIFFERENCE) * framing[narrowest]:
        raise UserError(
            f"{widest} and {narrowest} are framed differently: calibrate one camera at a time"
        )
    return groups


def _measure_framing(observation: PinObservation) -> float:
    """Measure the outermost ring's radius as a share of the image size."""
    outermost = observation.rest[observation.lattice.ring == observation.lattice.ring.max()]
    return float(np.linalg.norm(outermost, axis=-1).mean() / observation.size)


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
