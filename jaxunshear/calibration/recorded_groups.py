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
    recorded: list[RecordedImages], sensor: Sensor, start: SensorValues, notes: list[str]
) -> tuple[list[RecordedGroup], tuple[float, ...]]:
    """Observe every folder's pins, with its contacts if labels and images agree.

    Also returns the height of each object's top in its labels, in mm. Raises `UserError` if the
    pins cannot be followed, or if the folders are of several cameras.
    """
    groups, surfaces, framing = [], [], []
    for part in recorded:
        observation = part.observe(sensor)
        framing.append(_measure_framing(observation, sensor))
        count, usable = len(observation.identified), int(observation.identified.sum())
        if not usable:
            raise UserError(
                f"{part.name}: in none of {len(part.images)} images the pins can be followed "
                "from rim to middle"
            )
        if usable < count:
            notes.append(
                f"{part.name}: {count - usable} of {count} images left out, "
                "their pins cannot be followed surely"
            )
        group, surface_mm = _read_group(part, observation, sensor, start, notes)
        groups.append(group)
        surfaces.append(surface_mm)
    if max(framing) > (1 + MAX_FRAMING_DIFFERENCE) * min(framing):
        widest, narrowest = recorded[int(np.argmax(framing))], recorded[int(np.argmin(framing))]
        raise UserError(
            f"{widest.name} and {narrowest.name} are framed differently: "
            "calibrate one camera at a time"
        )
    return groups, tuple(surfaces)


def _measure_framing(observation: PinObservation, sensor: Sensor) -> float:
    """Measure the outermost ring's radius as a share of the image size."""
    lattice = observation.lattice
    outermost = lattice.rest[lattice.ring == sensor.rings] - lattice.centre
    return float(np.linalg.norm(outermost, axis=-1).mean() / observation.size)


def _read_group(
    part: RecordedImages,
    observation: PinObservation,
    sensor: Sensor,
    start: SensorValues,
    notes: list[str],
) -> tuple[RecordedGroup, float]:
    """Read a folder's labels; return its group, and the height of its top in mm.

    Without a reading the group has no contacts, and the height is 0.
    """
    identified = observation.take(np.flatnonzero(observation.identified))
    unlabelled = RecordedGroup(part.name, identified), 0.0
    rows = np.flatnonzero(observation.identified & part.labelled_rows)
    if part.poses is None or len(rows) < MIN_LABELLED:
        notes.append(
            f"{part.name}: fewer than {MIN_LABELLED} labelled poses, "
            "so it determines framing and pin size only"
        )
        return unlabelled
    moves = None if part.moves is None else part.moves[rows]
    reading = read_labels(observation.take(rows), part.poses[rows], moves, start, sensor)
    if reading is None:
        notes.append(
            f"{part.name}: simulated touches as labelled move pins otherwise than these images "
            f"show (correlation below {MIN_CORRELATION}), "
            "so it determines framing and pin size only"
        )
        return unlabelled
    edge = ""
    if reading.side:
        sign = "negative" if reading.side > 0 else "positive"
        edge = f", an edge with the object on the side of its {sign} labels"
    notes.append(
        f"{part.name}: labels read with a correlation of {reading.correlation:.2f}{edge}; "
        f"camera turned by {np.degrees(reading.angle):.0f} deg"
    )
    rotated = observation.take(rows).rotate(reading.mirrored, reading.angle)
    group = RecordedGroup(part.name, rotated, reading.contacts, reading.side)
    return group, reading.surface_mm
