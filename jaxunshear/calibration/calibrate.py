"""Fit the sensor and the camera of the simulator to recordings, and report what changed.

    results = calibrate(Path("recordings/edge"), Path("runs/calibration"))
    results["preset"]  # {"sensor": {...}, "camera": {...}, "friction": 0.25}

Domes stay in the cache, so a second calibration of the same sensor takes a third of the time.
"""

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxunshear.calibration.calibration_result import Calibration
from jaxunshear.calibration.fit import FitResult, fit
from jaxunshear.calibration.labels import make_paths
from jaxunshear.calibration.prediction import SensorValues, make_values, solve_contacts
from jaxunshear.calibration.problem import SURFACE, RecordedGroup
from jaxunshear.calibration.recorded_groups import choose_sensor, observe_groups
from jaxunshear.calibration.rendering import fit_housing, fit_pin_radius
from jaxunshear.calibration.report import (
    SimulatedGroups,
    build_rows,
    draw_images,
    format_tables,
    summarise_recorded,
)
from jaxunshear.calibration.sampling import sample_folders
from jaxunshear.config.sensor import Camera, Sensor
from jaxunshear.config.stimuli import ABS_FRICTION
from jaxunshear.errors import UserError
from jaxunshear.files import Json, write_bytes, write_json, write_text
from jaxunshear.progress import Progress

IMAGES = 200  # of all groups together; more do not narrow the intervals that matter
SEED = 0  # of the choice of images
FIRST_FIT_STRIDE = 3  # the first fit takes one of so many images
SOLVES_PER_CONTACT = 40  # about so many simulations of each recorded contact
UNITS = {
    "mm_across": "mm",
    "distance_mm": "mm",
    "pin_spacing_mm": "mm",
    "friction": "1",
    "skin_to_gel": "1",
}
OVERALL_MODULUS = (
    "the moduli's overall size moves no pin: only skin over gel is fitted, "
    "with the skin's modulus kept"
)


def calibrate(
    path: Path,
    out: Path | None = None,
    sensor: Sensor | None = None,
    camera: Camera | None = None,
    fixed: Collection[str] = (),
    images: int = IMAGES,
) -> Json:
    """Fit camera, pins, friction and stiffness to the labelled recordings at `path`.

    See `docs/calibration.md` for what recordings can determine. Raises `UserError` if the
    recordings cannot be read, are not labelled, or do not show such pins.

    Args:
        out: The folder for calibration.json, calibration.txt and calibration.png, if any. The
            picture shows recorded images, so it is yours to keep or share.
        sensor: Where the fit starts; by default the preset with as many pins as are detected.
        camera: Where the fit starts.
        fixed: Names of UNITS that keep their start.
        images: How many images of all folders together are used.

    Returns:
        `rows` (statistics: recorded, before, after), `parameters`, `preset` and `notes`.
    """
    _check_names(fixed)
    recorded, notes = sample_folders(Path(path), images, SEED)
    start = make_values(sensor or choose_sensor(recorded), camera or Camera(), ABS_FRICTION)
    groups = observe_groups(recorded, start, notes)
    fitted = _fit_in_two_stages(groups, start, fixed)
    before = _simulate(groups, replace(start, surface_mm=fitted.values.surface_mm))
    after = _fit_appearance(groups, _simulate(groups, fitted.values))
    images_before, images_after = before.render(groups), after.render(groups)
    rows = build_rows(
        summarise_recorded(groups),
        before.summarise(groups, images_before),
        after.summarise(groups, images_after),
    )
    results: Json = {
        "rows": rows,
        "parameters": _build_parameter_rows(start, after.values, fitted, fixed),
        "preset": _make_preset(after.values),
        "ring_error_px": {"before": fitted.before_px, "after": fitted.after_px},
        "images": {group.name: len(group.contacts) for group in groups},
        "image_names": [name for part in recorded for name in part.names],
        "notes": notes + _build_notes(fitted, fixed, before, after),
    }
    pictures = {f"recorded: {part.name}": part.images[0] for part in recorded[:2]}
    pictures |= {"simulated, before": images_before[0][0], "simulated, after": images_after[0][0]}
    _report(results, pictures, out)
    return results


def _check_names(fixed: Collection[str]) -> None:
    if wrong := [name for name in fixed if name not in UNITS]:
        raise UserError(f"'{wrong[0]}' cannot be held: name some of {', '.join(UNITS)}")


def _report(results: Json, pictures: dict[str, np.ndarray], out: Path | None) -> None:
    text = format_tables(results["rows"], results["parameters"]) + "\n"
    text += "".join(f"\nnote: {note}" for note in results["notes"])
    print(text)
    if out is not None:
        write_json(Path(out) / "calibration.json", results)
        write_text(Path(out) / "calibration.txt", text + "\n")
        write_bytes(Path(out) / "calibration.png", draw_images(pictures))


def _fit_in_two_stages(
    groups: list[RecordedGroup], start: SensorValues, fixed: Collection[str]
) -> FitResult:
    """Fit to a part of the images first: most of the search needs no more."""
    start = replace(start, surface_mm=tuple(group.surface_mm for group in groups))
    count = sum(len(group.contacts) for group in groups)
    with Progress("fit", SOLVES_PER_CONTACT * count, unit="contacts") as progress:

        def advance(contacts: int) -> None:
            progress.advance(max(0, min(contacts, progress.total - 1 - progress.done)))

        some = [group.subsample(FIRST_FIT_STRIDE) for group in groups]
        rough = fit(some, start, fixed, advance)
        fitted = fit(groups, start, fixed, advance, begin=rough.values)
        progress.advance(progress.total - progress.done)
    return fitted


def _simulate(groups: list[RecordedGroup], values: SensorValues) -> SimulatedGroups:
    tips, sensor = [], values.sensor
    for group, surface_mm in zip(groups, values.surface_mm, strict=True):
        paths = make_paths(group.contacts, sensor, surface_mm, group.side, values.friction)
        tips.append(solve_contacts(sensor, paths))
    return SimulatedGroups(values, tips)


def _fit_appearance(groups: list[RecordedGroup], simulated: SimulatedGroups) -> SimulatedGroups:
    values = simulated.values
    solved = [
        each.tips[each.converged] if each.converged.any() else each.tips for each in simulated.tips
    ]
    radius = fit_pin_radius(groups, values, solved)
    values = replace(values, base=replace(values.base, pin_radius_mm=radius))
    values = replace(values, housing=fit_housing(groups, values, solved))
    return replace(simulated, values=values)


def _build_parameter_rows(
    start: SensorValues, after: SensorValues, fitted: FitResult, fixed: Collection[str]
) -> list[Json]:
    """Build a row for each parameter; `low` and `high` are None if it has no interval."""
    rows: list[Json] = []
    for name, unit in UNITS.items():
        interval = fitted.intervals.get(name)
        rows.append(
            {
                "name": name,
                "unit": unit,
                "before": getattr(start, name),
                "after": getattr(after, name),
                "low": interval and interval.low,
                "high": interval and interval.high,
                "determined": interval is not None and interval.determined,
                "held": name in fixed,
            }
        )
    unknown = {"low": None, "high": None, "determined": True, "held": False}
    radii = {"before": start.base.pin_radius_mm, "after": after.base.pin_radius_mm}
    return [*rows, {"name": "pin_radius_mm", "unit": "mm", **radii, **unknown}]


def _make_preset(values: SensorValues) -> Json:
    camera = values.camera(Camera().frame_px)
    return Calibration("", values.sensor, camera, values.friction).preset


def _build_notes(
    fitted: FitResult, fixed: Collection[str], before: SimulatedGroups, after: SimulatedGroups
) -> list[str]:
    """Say where contacts begin, what was not determined, and which contacts were not solved."""
    notes, open_names = [OVERALL_MODULUS], []
    for name, (low, high, determined) in fitted.intervals.items():
        kind, _, part = name.partition(" ")
        if kind == SURFACE:
            notes.append(
                f"{part}: contact begins at {low:.2f} to {high:.2f} mm "
                "of the labelled depth axis (95 %)"
            )
        elif not determined:
            open_names.append(name)
    if open_names:
        notes.append(
            f"not determined by these images, kept near the start: {', '.join(open_names)}"
        )
    if "friction" not in {*fitted.intervals, *fixed}:
        notes.append("not fitted, as no labelled slides determine it: friction")
    failures = {
        "the fit, where each counts for 3 px": fitted.dropped,
        "the images before, left out": before.count_failures(),
        "the images after, left out": after.count_failures(),
    }
    for stage, count in failures.items():
        if count:
            notes.append(
                f"{count} simulated contacts were out of reach or did not converge in {stage}"
            )
    return notes
