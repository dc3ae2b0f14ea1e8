"""Fit the sensor and the camera of the simulator to recordings, and report what changed.

    results = calibrate(Path("recordings/edge"), Path("runs/calibration"))
    results["preset"]  # {"sensor": {...}, "camera": {...}, "friction": 0.25}

Domes stay in the cache, so a second calibration of the same sensor takes a third of the time.
"""

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxunshear.calibration.calibration_result import Calibration
from jaxunshear.calibration.fit import FitResult, fit
from jaxunshear.calibration.prediction import SensorValues, compute_modulus_ratio
from jaxunshear.calibration.problem import RecordedGroup
from jaxunshear.calibration.recorded_groups import choose_sensor, observe_groups
from jaxunshear.calibration.rendering import (
    PinRadius,
    SimulatedTips,
    fit_housing,
    fit_pin_radius,
    simulate_tips,
)
from jaxunshear.calibration.report import (
    SimulatedGroups,
    build_rows,
    format_table,
    plot_curves,
    summarise_images,
)
from jaxunshear.calibration.sampling import sample_folders
from jaxunshear.config.image import Camera
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.stimuli import ABS_FRICTION
from jaxunshear.errors import UserError
from jaxunshear.files import Json, write_bytes, write_json, write_text
from jaxunshear.progress import Progress

IMAGES = 200  # of all groups together; more do not narrow the intervals that matter
SEED = 0  # of the choice of images
FIRST_FIT_STRIDE = 3  # the first fit takes one of so many images
SOLVES_PER_CONTACT = 40  # about so many simulations of each recorded contact
PIN_RADIUS = "pin_radius_mm"
UNITS = {
    "mm_across": "mm",
    "distance_mm": "mm",
    "pin_spacing_mm": "mm",
    "friction": "1",
    "skin_to_gel": "1",
    PIN_RADIUS: "mm",
}
OVERALL_MODULUS = (
    "the moduli's overall size moves no pin: only skin over gel is fitted, "
    "with the skin's modulus kept"
)

Log = Callable[[str], None]


def calibrate(
    path: Path,
    out: Path | None = None,
    sensor: Sensor | None = None,
    camera: Camera | None = None,
    fixed: Collection[str] = (),
    images: int = IMAGES,
    log: Log = print,
) -> Json:
    """Fit camera, pins, friction and stiffness to the recordings at `path`.

    See `docs/calibration.md` for what recordings can determine. Raises `UserError` if the
    recordings cannot be read or do not show such pins.

    Args:
        out: The folder for calibration.json, calibration.txt and calibration.png, if any. The
            picture shows recorded images, so it is yours to keep or share.
        sensor: Where the fit starts; by default the preset with as many pins as are detected.
        camera: Where the fit starts.
        fixed: Names of UNITS, except the pin radius, that keep their start.
        images: How many images of all folders together are used.

    Returns:
        `rows` (statistics: recorded, before, after), `parameters`, `preset` and `notes`.
    """
    path = Path(path)
    _check_fixed_names(fixed)
    recorded, notes = sample_folders(path, images, SEED)
    sensor = sensor or choose_sensor(recorded)
    start = _make_start(sensor, camera or Camera())
    groups, surfaces = observe_groups(recorded, sensor, start, notes)
    start = replace(start, surface_mm=surfaces)
    fitted = _fit_in_two_stages(groups, sensor, start, fixed)
    before = _simulate(groups, sensor, replace(start, surface_mm=fitted.values.surface_mm))
    after, radius = _fit_appearance(
        groups, _simulate(groups, fitted.values.sensor(sensor), fitted.values), fitted
    )
    summaries, pictures = summarise_images(recorded, groups, before, after)
    parameters = _build_parameter_rows(start, fitted, sensor, radius, fixed)
    notes += _build_fit_notes(fixed, fitted)
    notes += _build_failure_notes(fitted, before, after)
    results: Json = {
        "rows": build_rows(summaries),
        "parameters": parameters,
        "preset": _make_preset(after),
        "ring_error_px": {"before": fitted.before_px, "after": fitted.after_px},
        "images": {group.name: len(group.observation.pin_counts) for group in groups},
        "image_names": [name for part in recorded for name in part.names],
        "notes": notes,
    }
    text = format_table(results["rows"], parameters)
    text += "\n" + "".join(f"\nnote: {note}" for note in notes)
    log(text)
    if out is not None:
        write_json(Path(out) / "calibration.json", results)
        write_text(Path(out) / "calibration.txt", text + "\n")
        write_bytes(Path(out) / "calibration.png", plot_curves(summaries, pictures))
    return results


def _check_fixed_names(fixed: Collection[str]) -> None:
    allowed = [name for name in UNITS if name != PIN_RADIUS]
    wrong = [name for name in fixed if name not in allowed]
    if wrong:
        raise UserError(f"'{wrong[0]}' cannot be held: name some of {', '.join(allowed)}")


def _make_start(sensor: Sensor, camera: Camera) -> SensorValues:
    return SensorValues(
        camera.mm_across,
        camera.distance_mm,
        sensor.pin_spacing_mm,
        ABS_FRICTION,
        compute_modulus_ratio(sensor),
    )


def _fit_in_two_stages(
    groups: list[RecordedGroup], sensor: Sensor, start: SensorValues, fixed: Collection[str]
) -> FitResult:
    """Fit to a part of the images first: most of the search needs no more."""
    count = sum(len(group.observation.pin_counts) for group in groups if group.contacts is not None)
    with Progress("fit", SOLVES_PER_CONTACT * count, unit="contacts") as progress:

        def advance(contacts: int) -> None:
            progress.advance(max(0, min(contacts, progress.total - 1 - progress.done)))

        some = [group.subsample(FIRST_FIT_STRIDE) for group in groups]
        rough = fit(some, sensor, start, fixed, advance)
        fitted = fit(groups, sensor, start, fixed, advance, begin=rough.values)
        progress.advance(progress.total - progress.done)
    return fitted


def _simulate(groups: list[RecordedGroup], sensor: Sensor, values: SensorValues) -> SimulatedGroups:
    tips = [simulate_tips(group, sensor, values, i) for i, group in enumerate(groups)]
    return SimulatedGroups(sensor, values, tips)


def _fit_appearance(
    groups: list[RecordedGroup], simulated: SimulatedGroups, fitted: FitResult
) -> tuple[SimulatedGroups, PinRadius]:
    """Fit pin radius and housing to images of the simulated contacts."""
    sensor, values, tips_by_group = simulated
    solved = [tips[converged] if converged.any() else tips for tips, converged in tips_by_group]
    radius = _add_scale_error(fit_pin_radius(groups, sensor, values, solved), fitted)
    sensor = replace(sensor, pin_radius_mm=radius.best)
    values = replace(values, housing=fit_housing(groups, sensor, values, solved))
    return SimulatedGroups(sensor, values, tips_by_group), radius


def _add_scale_error(radius: PinRadius, fitted: FitResult) -> PinRadius:
    """Widen the interval of a pin radius by the uncertainty of the camera's scale."""
    scale_error = 0.0
    if "mm_across" in fitted.low:
        width = fitted.high["mm_across"] - fitted.low["mm_across"]
        scale_error = radius.best * width / 2 / fitted.values.mm_across
    half = float(np.hypot((radius.high - radius.low) / 2, scale_error))
    return PinRadius(radius.best, radius.best - half, radius.best + half)


def _build_parameter_rows(
    start: SensorValues,
    fitted: FitResult,
    sensor: Sensor,
    radius: PinRadius,
    fixed: Collection[str],
) -> list[Json]:
    """Build a row for each parameter.

    `low` and `high` are None if it was not fitted; `determined` says whether the images determine
    it.
    """
    rows = []
    for name, unit in UNITS.items():
        if name == PIN_RADIUS:
            values: Json = {
                "before": sensor.pin_radius_mm,
                "after": radius.best,
                "low": radius.low,
                "high": radius.high,
                "determined": True,
            }
        else:
            values = {
                "before": getattr(start, name),
                "after": getattr(fitted.values, name),
                "low": fitted.low.get(name),
                "high": fitted.high.get(name),
                "determined": fitted.determined.get(name, False),
            }
        rows.append({"name": name, "unit": unit, **values, "held": name in fixed})
    return rows


def _make_preset(simulated: SimulatedGroups) -> Json:
    camera = simulated.values.camera(Camera().frame_px)
    return Calibration("", simulated.sensor, camera, simulated.values.friction).preset


def _build_fit_notes(fixed: Collection[str], fitted: FitResult) -> list[str]:
    notes = [OVERALL_MODULUS]
    for name, low in fitted.low.items():
        if name.startswith("surface_mm"):
            high, part = fitted.high[name], name.removeprefix("surface_mm ")
            notes.append(
                f"{part}: contact begins at {low:.2f} to {high:.2f} mm "
                "of the labelled depth axis (95 %)"
            )
    undetermined = [
        name
        for name, determined in fitted.determined.items()
        if not determined and not name.startswith("surface_mm")
    ]
    if undetermined:
        notes.append(
            f"not determined by these images, kept near the start: {', '.join(undetermined)}"
        )
    fittable = [name for name in ("friction", "skin_to_gel", "pin_spacing_mm") if name not in fixed]
    missing = [name for name in fittable if name not in fitted.determined]
    if missing:
        contacts = "slides" if missing == ["friction"] else "contacts"
        notes.append(f"not fitted, as no labelled {contacts} determine them: {', '.join(missing)}")
    return notes


def _build_failure_notes(
    fitted: FitResult, before: SimulatedGroups, after: SimulatedGroups
) -> list[str]:
    failures = {
        "the fit, where each counts for 3 px": fitted.dropped,
        "the images before, left out": _count_failures(before.tips),
        "the images after, left out": _count_failures(after.tips),
    }
    return [
        f"{count} simulated contacts were out of reach or did not converge in {stage}"
        for stage, count in failures.items()
        if count
    ]


def _count_failures(tips_by_group: list[SimulatedTips]) -> int:
    return sum(int((~tips.converged).sum()) for tips in tips_by_group)
