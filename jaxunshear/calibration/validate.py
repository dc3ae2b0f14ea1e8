"""Recordings in, how far the simulated pins follow the recorded ones out; see `validation` for what is compared.

results = validate(Path("recordings/edge"))
results["rows"]  # [{"name": "r2.tap", "unit": "1", "value": 0.71, "contacts": 398}, ...]
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxunshear.calibration.alignment import STEPS, Matter, find_frame
from jaxunshear.calibration.calibrate import IMAGES, LEAST_LABELLED
from jaxunshear.calibration.ceiling import told_by_labels
from jaxunshear.calibration.held_out import Parts, held_out
from jaxunshear.calibration.labels import Frame, Motions, framed, motions, to_paths
from jaxunshear.calibration.matching import read_labels
from jaxunshear.calibration.prediction import Values, displacements, skin_to_gel
from jaxunshear.calibration.sampling import Recorded, sample
from jaxunshear.calibration.statistics import Seen, observe
from jaxunshear.calibration.validation import Compared, centred, mm_per_px, rows_of, settled
from jaxunshear.errors import UserError
from jaxunshear.image.settings import FITTED_CAMERA, Camera
from jaxunshear.progress import Progress
from jaxunshear.scene.paths import DEPTH, X
from jaxunshear.scene.sensor import FITTED_FRICTION, TACTIP_331_FITTED, Sensor, check_sensor
from jaxunshear.storage import read_json, write_bytes, write_text

EACH = 400  # contacts of a folder
CHUNK = 50  # contacts between two steps of the progress
FITTED_TO = (
    "edge_2d/shear/csv_train",
    "edge_2d/tap/csv_train",
)  # what the shipped preset was fitted to, of IMAGES and seed 0

Log = Callable[[str], None]


@dataclass(frozen=True)
class Calibrated:
    """What is validated; `used` names the images that it was fitted to, as `Recorded.names` has them; None: those of the preset."""

    name: str
    sensor: Sensor
    camera: Camera
    friction: float
    used: tuple[str, ...] | None = None

    @property
    def values(self) -> Values:
        camera = self.camera
        ratio = skin_to_gel(self.sensor)
        return Values(
            camera.mm_across, camera.distance_mm, self.sensor.pin_spacing_mm, self.friction, ratio, (), camera.housing
        )


class Aligned(NamedTuple):
    """What labels do not tell of a folder, read off images that are not compared."""

    side: int
    frame: Frame
    sign: int  # of the moves
    mirrored: bool
    angle: float
    images: int

    @property
    def note(self) -> str:
        frame = self.frame
        edge = f", edge {frame.across_mm:+.2f} mm from the labels' zero" if self.side else ""
        return (
            f"aligned by {self.images} other contacts: surface at {frame.surface_mm:.2f} mm of the depth axis, tilted by "
            f"{frame.tilt_x_deg:+.2f} and {frame.tilt_y_deg:+.2f} deg{edge}; camera turned by {np.degrees(self.angle):.1f} deg"
        )


SHIPPED = Calibrated(f"preset {TACTIP_331_FITTED.name}", TACTIP_331_FITTED, FITTED_CAMERA, FITTED_FRICTION)


def read_calibration(file: Path) -> Calibrated:
    """A `calibration.json` of `jaxunshear calibrate`. Raises `UserError` where it is none."""
    found = read_json(file)
    try:
        preset = found["preset"]
        sensor, camera = Sensor(**preset["sensor"]), Camera(**preset["camera"])
        friction, used = float(preset["friction"]), tuple(str(name) for name in found.get("image_names", ()))
        check_sensor(sensor)
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"--calibration {file}: {type(error).__name__} {error}: give a calibration.json of `jaxunshear calibrate --out`"
        ) from None
    return Calibrated(f"calibration {file.name}", sensor, camera, friction, used)


def validate(
    path: Path,
    calibrated: Calibrated = SHIPPED,
    each: int | None = EACH,
    seed: int = 0,
    out: Path | None = None,
    log: Log = print,
    told: bool = False,
) -> dict[str, Any]:
    """Compares `each` contacts of every folder at `path` (None: all), drawn at random, that the calibration has not seen. `told`: with
    edge and tilt of the object where the labels have them.

    Returns `rows` (name, unit, value, contacts), `notes`, and `left_out` (image, why). With `out`, writes validate.txt and
    validate.png there, which show no recorded image. Raises `UserError` where nothing can be compared.
    """
    path = Path(path)
    notes: list[str] = [f"{calibrated.name}; contacts drawn with seed {seed}"]
    used = _used(path, calibrated, notes)
    split, more = held_out(path, each, seed, used)
    notes += more
    compared, left_out = [], []
    for parts in split:
        one, lost = _compared(parts, calibrated, told, notes)
        left_out += lost
        compared += [] if one is None else [one]
    if not compared:
        raise UserError(f"{path}: no folder has labelled contacts that can be compared: {notes[-1]}")
    for why in sorted({lost["why"] for lost in left_out}):
        names = [lost["image"] for lost in left_out if lost["why"] == why]
        notes.append(f"{len(names)} left out, {why}: {', '.join(names[:5])}{' ...' if len(names) > 5 else ''}")
    notes.append(
        "ceiling: a regression from the labels of these contacts, which more of them raise: from few it may lie below"
    )
    rows = rows_of(compared)
    text = table(rows) + "\n" + "".join(f"\nnote: {note}" for note in notes)
    log(text)
    if out is not None:
        from jaxunshear.report.validate_figure import validate_figure

        write_text(Path(out) / "validate.txt", text + "\n")
        write_bytes(Path(out) / "validate.png", validate_figure(compared))
    return {"rows": rows, "notes": notes, "left_out": left_out}


def table(rows: list[dict[str, Any]]) -> str:
    """A line for taps, slides and each part of them."""
    from jaxunshear.applications.table import plain_table

    lines: dict[str, dict[str, Any]] = {}
    for row in rows:
        measure, _, part = row["name"].partition(".")
        lines.setdefault(part, {"contacts of": part, "contacts": row["contacts"]})[measure] = row["value"]
    columns = ("contacts of", "contacts", "r2", "ceiling_r2", "residual_px", "residual_mm", "motion_px")
    return plain_table(list(lines.values()), columns)


def _used(path: Path, calibrated: Calibrated, notes: list[str]) -> tuple[str, ...]:
    """Names of the images that a calibration was fitted to."""
    if calibrated.used is not None:
        if not calibrated.used:
            notes.append("the calibration does not name its images: some of them may be compared")
        return calibrated.used
    parts, _ = sample(path, IMAGES, 0)
    fitted = [part for part in parts if any(f"/{known}".endswith(f"/{part.name}") for known in FITTED_TO)]
    return tuple(name for part in fitted for name in part.names)


def _compared(
    parts: Parts, calibrated: Calibrated, told: bool, notes: list[str]
) -> tuple[Compared | None, list[dict[str, str]]]:
    """One folder's contacts, and those left out. None, with a note, where its labels do not go with its images."""
    name, scored = parts.scored.name, parts.scored
    aligned = align(parts.align, calibrated, told)
    if isinstance(aligned, str):
        notes.append(f"{name}: {aligned}")
        return None, []
    notes.append(f"{name}: {aligned.note}")
    seen = _observed(scored, calibrated.sensor).turned(aligned.mirrored, aligned.angle)
    labelled = _labelled(scored)
    left_out = [{"image": scored.names[i], "why": "its label cannot be read"} for i in np.flatnonzero(~labelled)]
    unsure = labelled & ~seen.sure
    left_out += [{"image": scored.names[i], "why": "its pins cannot be followed"} for i in np.flatnonzero(unsure)]
    rows = np.flatnonzero(labelled & seen.sure)
    if len(rows) < LEAST_LABELLED:
        notes.append(f"{name}: {len(rows)} contacts are labelled and followed, fewer than {LEAST_LABELLED}")
        return None, left_out
    contacts = framed(_read(scored, rows, aligned.sign), aligned.frame)
    moved, converged = _solved(name, contacts, aligned, calibrated)
    left_out += [
        {"image": scored.names[rows[i]], "why": "out of the simulator's reach, or not converged"}
        for i in np.flatnonzero(~converged)
    ]
    kept = np.flatnonzero(converged)
    if len(kept) < LEAST_LABELLED:
        notes.append(f"{name}: {len(kept)} contacts converged, fewer than {LEAST_LABELLED}")
        return None, left_out
    return _result(name, seen.take(rows[kept]), contacts.take(kept), moved[kept], aligned, calibrated), left_out


def _result(
    name: str, seen: Seen, contacts: Motions, moved: np.ndarray, aligned: Aligned, calibrated: Calibrated
) -> Compared:
    sensor, values = calibrated.sensor, calibrated.values
    flat, place = settled(values, sensor, seen.size, seen.place, moved)
    recorded, simulated = centred(seen.place * (128 / seen.size), place * (128 / seen.size))
    end = to_paths(contacts, sensor, 0.0, aligned.side, values.friction).points[:, -1]
    return Compared(
        name,
        recorded,
        simulated,
        told_by_labels(contacts, recorded),
        seen.lattice.shell,
        np.nanmean(seen.place, axis=0) * (128 / seen.size),
        mm_per_px(values, sensor, 128, flat),
        np.linalg.norm(contacts.tip[:, 1] - contacts.tip[:, 0], axis=-1),
        end[:, DEPTH],
        end[:, X] if aligned.side else np.full(len(end), np.nan),
    )


def align(part: Recorded, calibrated: Calibrated, told: bool = False) -> Aligned | str:
    """How a folder's labels and images go together, from its images `part`; or why that cannot be told.

    `told`: edge and tilt are where the labels have them, and only the height of the surface is found.
    """
    sensor, values = calibrated.sensor, calibrated.values
    seen = _observed(part, sensor)
    rows = np.flatnonzero(_labelled(part) & seen.sure)
    if len(rows) < LEAST_LABELLED:
        return f"{len(rows)} images to align by are labelled and followed, fewer than {LEAST_LABELLED}"
    assert part.poses is not None  # else none would be labelled
    moves = None if part.moves is None else part.moves[rows]
    reading = read_labels(seen.take(rows), part.poses[rows], moves, values, sensor)
    if reading is None:
        return "its labels do not go with its images"
    turned = seen.take(rows).turned(reading.mirrored, reading.angle)
    matter = Matter(turned, reading.contacts, reading.side, values, sensor)
    names = ("surface_mm",) if told else tuple(STEPS)
    frame = find_frame(matter, Frame(reading.surface_mm), names)
    more = matter.turn(frame)
    sign = 1 if moves is None or np.allclose(_read(part, rows, 1).tip, reading.contacts.tip) else -1
    return Aligned(reading.side, frame, sign, reading.mirrored, reading.angle - more, len(rows))


def _observed(part: Recorded, sensor: Sensor) -> Seen:
    with Progress(f"pins of {part.name}", len(part.images)) as progress:

        def counted():
            for image in part.images:
                yield image
                progress.advance()

        return observe(counted(), sensor)


def _labelled(part: Recorded) -> np.ndarray:
    """(N,) bool: pose known, and the slide where the folder has any."""
    if part.poses is None:
        return np.zeros(len(part.images), bool)
    known = np.isfinite(part.poses).all(axis=-1)
    if part.moves is not None and np.isfinite(part.moves).any():
        known &= np.isfinite(part.moves).all(axis=-1)
    return known


def _read(part: Recorded, rows: np.ndarray, sign: int) -> Motions:
    assert part.poses is not None  # else none would be labelled
    return motions(part.poses[rows], None if part.moves is None else sign * part.moves[rows])


def _solved(name: str, contacts: Motions, aligned: Aligned, calibrated: Calibrated) -> tuple[np.ndarray, np.ndarray]:
    """As `displacements`, some contacts at a time."""
    values, parts = calibrated.values, []
    with Progress(f"contacts of {name}", len(contacts), unit="contacts") as progress:
        for begin in range(0, len(contacts), CHUNK):
            some = contacts.take(np.arange(begin, min(begin + CHUNK, len(contacts))))
            parts.append(displacements(calibrated.sensor, some, aligned.side, values.friction, 0.0, values.skin_to_gel))
            progress.advance(len(some))
    return np.concatenate([moved for moved, _ in parts]), np.concatenate([fine for _, fine in parts])
