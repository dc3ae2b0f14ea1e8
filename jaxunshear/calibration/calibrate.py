"""Recordings in, a calibrated sensor and camera out, with what changed.

    results = calibrate(Path("recordings/edge"), Path("runs/calibration"))
    results["preset"]  # {"sensor": {...}, "camera": {...}, "friction": 0.25}

Domes are kept in the cache, so that a second calibration of the same sensor takes a third of the time.
"""

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxunshear.calibration.alignment import MIN_CORRELATION, read_labels
from jaxunshear.calibration.calibration_result import Calibration
from jaxunshear.calibration.fit import FitResult, fit
from jaxunshear.calibration.pin_statistics import PinObservation
from jaxunshear.calibration.prediction import SensorValues, compute_modulus_ratio
from jaxunshear.calibration.problem import RecordedGroup
from jaxunshear.calibration.rendering import fit_housing, fit_pin_radius, simulate_tips
from jaxunshear.calibration.report import build_rows, compared, format_table, plot_curves
from jaxunshear.calibration.sampling import RecordedImages, sample_folders
from jaxunshear.config.image import Camera
from jaxunshear.config.sensor import SENSORS, Sensor
from jaxunshear.config.stimuli import ABS_FRICTION
from jaxunshear.errors import UserError
from jaxunshear.files import Json, write_bytes, write_json, write_text
from jaxunshear.perception.pin_detection import find_pins
from jaxunshear.progress import Progress

IMAGES = 200  # of all groups together: enough that more do not narrow the intervals that matter
FIRST_FIT_STRIDE = 3  # images, of which the first fit takes one
SOLVES_PER_CONTACT = 40  # solved for each recorded one, about
MIN_LABELLED = 12  # contacts from which the labels' reading can be determined
MAX_FRAMING_DIFFERENCE = (
    0.05  # of the outermost ring's radius: two that differ by more are two cameras
)
UNITS = {
    "mm_across": "mm",
    "distance_mm": "mm",
    "pin_spacing_mm": "mm",
    "friction": "1",
    "skin_to_gel": "1",
    "pin_radius_mm": "mm",
}
OVERALL_MODULUS = "the moduli's overall size moves no pin: only skin over gel is fitted, with the skin's modulus kept"

Log = Callable[[str], None]


def calibrate(
    path: Path,
    out: Path | None = None,
    sensor: Sensor | None = None,
    camera: Camera | None = None,
    fixed: Collection[str] = (),
    images: int = IMAGES,
    seed: int = 0,
    log: Log = print,
) -> Json:
    """Fits camera, pins, friction and stiffness to the recordings at `path`; see `docs/calibration.md` for what they can determine.

    With `out`, writes calibration.json, calibration.txt and calibration.png there; the picture shows recorded images, so it is
    yours to keep or share. Returns `rows` (statistics: recorded, before, after), `parameters`, `preset` and `notes`. `sensor` and
    `camera` are where the fit starts: by default the preset with as many pins as are found. Raises `UserError` where the
    recordings cannot be read or show no such pins. What `fixed` names (of UNITS, but for the pin radius) keeps its start.
    """
    path = Path(path)
    _check_held(fixed)
    recorded, notes = sample_folders(path, images, seed)
    sensor = sensor or _sensor_for(recorded)
    camera = camera or Camera()
    start = SensorValues(
        camera.mm_across,
        camera.distance_mm,
        sensor.pin_spacing_mm,
        ABS_FRICTION,
        compute_modulus_ratio(sensor),
    )
    groups, surfaces = _groups(recorded, sensor, start, notes)
    start = replace(start, surface_mm=surfaces)
    fitted = _fit(groups, sensor, start, fixed)
    before = replace(start, surface_mm=fitted.values.surface_mm)
    tips_before = [simulate_tips(group, sensor, before, i) for i, group in enumerate(groups)]
    after_sensor = fitted.values.sensor(sensor)
    tips_after = [
        simulate_tips(group, after_sensor, fitted.values, i) for i, group in enumerate(groups)
    ]
    solved = [tips[converged] if converged.any() else tips for tips, converged in tips_after]
    radius = _with_scale(fit_pin_radius(groups, after_sensor, fitted.values, solved), fitted)
    after_sensor = replace(after_sensor, pin_radius_mm=radius[0])
    after = replace(fitted.values, housing=fit_housing(groups, after_sensor, fitted.values, solved))
    reported, pictures = compared(
        recorded, groups, (sensor, before, tips_before), (after_sensor, after, tips_after)
    )
    parameters = _parameters(start, fitted, sensor, radius, fixed)
    lost = {"the fit, where each counts for 3 px": fitted.dropped}
    for where, tips in (
        ("the images before, left out", tips_before),
        ("the images after, left out", tips_after),
    ):
        lost[where] = sum(int((~converged).sum()) for _, converged in tips)
    notes += _build_notes(fixed, fitted, lost)
    results: Json = {
        "rows": build_rows(reported),
        "parameters": parameters,
        "preset": Calibration(
            "", after_sensor, after.camera(Camera().frame_px), after.friction
        ).preset,
        "ring_error_px": {"before": fitted.before_px, "after": fitted.after_px},
        "images": {group.name: len(group.observation.pin_counts) for group in groups},
        "image_names": [name for part in recorded for name in part.names],
        "notes": notes,
    }
    text = (
        format_table(results["rows"], parameters)
        + "\n"
        + "".join(f"\nnote: {note}" for note in notes)
    )
    log(text)
    if out is not None:
        write_json(Path(out) / "calibration.json", results)
        write_text(Path(out) / "calibration.txt", text + "\n")
        write_bytes(Path(out) / "calibration.png", plot_curves(reported, pictures))
    return results


def _check_held(held: Collection[str]) -> None:
    known = [name for name in UNITS if name != "pin_radius_mm"]
    wrong = [name for name in held if name not in known]
    if wrong:
        raise UserError(f"'{wrong[0]}' cannot be held: name some of {', '.join(known)}")


def _fit(
    groups: list[RecordedGroup], sensor: Sensor, start: SensorValues, held: Collection[str]
) -> FitResult:
    """On some images first: most of the way needs no more."""
    count = sum(len(group.observation.pin_counts) for group in groups if group.contacts is not None)
    with Progress("fit", SOLVES_PER_CONTACT * count, unit="contacts") as progress:

        def advance(contacts: int) -> None:
            progress.advance(max(0, min(contacts, progress.total - 1 - progress.done)))

        rough = fit(
            [group.subsample(FIRST_FIT_STRIDE) for group in groups], sensor, start, held, advance
        )
        fitted = fit(groups, sensor, start, held, advance, begin=rough.values)
        progress.advance(progress.total - progress.done)
    return fitted


def _sensor_for(recorded: list[RecordedImages]) -> Sensor:
    counts = [len(find_pins(image)) for part in recorded for image in part.images[:5]]
    pins = float(np.median(counts))
    nearest = min(SENSORS.values(), key=lambda sensor: abs(sensor.pins - pins))
    if abs(nearest.pins - pins) > 0.1 * nearest.pins:
        known = ", ".join(f"{sensor.name} ({sensor.pins})" for sensor in SENSORS.values())
        raise UserError(
            f"about {pins:.0f} pins are found in an image, which is none of the known sensors: {known}"
        )
    return nearest


def _groups(
    recorded: list[RecordedImages], sensor: Sensor, start: SensorValues, notes: list[str]
) -> tuple[list[RecordedGroup], tuple[float, ...]]:
    """Every folder's pins, with its contacts where the labels go with the images."""
    groups, surfaces, framing = [], [], []
    for part in recorded:
        seen = part.observe(sensor)
        framing.append(
            np.linalg.norm(
                seen.lattice.rest[seen.lattice.ring == sensor.rings] - seen.lattice.centre,
                axis=-1,
            ).mean()
            / seen.size
        )
        if not seen.identified.any():
            raise UserError(
                f"{part.name}: in none of {len(part.images)} images the pins can be followed from rim to middle"
            )
        if not seen.identified.all():
            notes.append(
                f"{part.name}: {int((~seen.identified).sum())} of {len(seen.identified)} images left out, their pins cannot be followed surely"
            )
        group, surface = _read_labelled_group(part, seen, sensor, start, notes)
        groups.append(group)
        surfaces.append(surface)
    if max(framing) > (1 + MAX_FRAMING_DIFFERENCE) * min(framing):
        worst = recorded[int(np.argmax(framing))].name, recorded[int(np.argmin(framing))].name
        raise UserError(
            f"{worst[0]} and {worst[1]} are framed differently: calibrate one camera at a time"
        )
    return groups, tuple(surfaces)


def _read_labelled_group(
    part: RecordedImages,
    seen: PinObservation,
    sensor: Sensor,
    start: SensorValues,
    notes: list[str],
) -> tuple[RecordedGroup, float]:
    unread = RecordedGroup(part.name, seen.take(np.flatnonzero(seen.identified))), 0.0
    rows = np.flatnonzero(seen.identified & part.labelled_rows)
    if part.poses is None or len(rows) < MIN_LABELLED:
        notes.append(
            f"{part.name}: fewer than {MIN_LABELLED} labelled poses, so it determines framing and pin size only"
        )
        return unread
    moves = None if part.moves is None else part.moves[rows]
    reading = read_labels(seen.take(rows), part.poses[rows], moves, start, sensor)
    if reading is None:
        notes.append(
            f"{part.name}: simulated touches as labelled move pins otherwise than these images show "
            f"(correlation below {MIN_CORRELATION}), so it determines framing and pin size only"
        )
        return unread
    edge = ""
    if reading.side:
        edge = f", an edge with the object on the side of its {'negative' if reading.side > 0 else 'positive'} labels"
    notes.append(
        f"{part.name}: labels read with a correlation of {reading.correlation:.2f}{edge}; camera turned by {np.degrees(reading.angle):.0f} deg"
    )
    turned = seen.take(rows).rotate(reading.mirrored, reading.angle)
    return RecordedGroup(part.name, turned, reading.contacts, reading.side), reading.surface_mm


def _parameters(
    start: SensorValues,
    fitted: FitResult,
    sensor: Sensor,
    radius: tuple[float, float, float],
    held: Collection[str],
) -> list[Json]:
    """Rows; `low` and `high` are None for what was not fitted, `determined` says whether the images determine it."""
    rows = []
    low: float | None
    high: float | None
    for name, unit in UNITS.items():
        if name == "pin_radius_mm":
            before, after, low, high, determined = sensor.pin_radius_mm, *radius, True
        else:
            before, after = getattr(start, name), getattr(fitted.values, name)
            low, high, determined = (
                fitted.low.get(name),
                fitted.high.get(name),
                fitted.determined.get(name, False),
            )
        known = {
            "before": before,
            "after": after,
            "low": low,
            "high": high,
            "determined": determined,
        }
        rows.append({"name": name, "unit": unit, **known, "held": name in held})
    return rows


def _with_scale(
    radius: tuple[float, float, float], fitted: FitResult
) -> tuple[float, float, float]:
    """A pin radius (mm, low, high) at the fitted scale of the camera, with what is not known of that scale."""
    best, low, high = radius
    scale = 0.0
    if "mm_across" in fitted.low:
        scale = (
            best
            * (fitted.high["mm_across"] - fitted.low["mm_across"])
            / 2
            / fitted.values.mm_across
        )
    half = float(np.hypot((high - low) / 2, scale))
    return best, best - half, best + half


def _build_notes(held: Collection[str], fitted: FitResult, lost: dict[str, int]) -> list[str]:
    notes = [OVERALL_MODULUS]
    for name, low in fitted.low.items():
        if name.startswith("surface_mm"):
            most, part = fitted.high[name], name.removeprefix("surface_mm ")
            notes.append(
                f"{part}: contact begins at {low:.2f} to {most:.2f} mm of the labelled depth axis (95 %)"
            )
    unknown = [
        name
        for name, known in fitted.determined.items()
        if not known and not name.startswith("surface_mm")
    ]
    if unknown:
        notes.append(f"not determined by these images, kept near the start: {', '.join(unknown)}")
    fittable = [name for name in ("friction", "skin_to_gel", "pin_spacing_mm") if name not in held]
    missing = [name for name in fittable if name not in fitted.determined]
    if missing:
        notes.append(
            f"not fitted, as no labelled {'slides' if missing == ['friction'] else 'contacts'} determine them: {', '.join(missing)}"
        )
    notes += [
        f"{count} simulated contacts were out of reach or did not converge in {where}"
        for where, count in lost.items()
        if count
    ]
    return notes
