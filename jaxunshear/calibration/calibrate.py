"""Fit the sensor and the camera of the simulator to recordings, and report what changed.

    results = calibrate(Path("recordings/edge"), Path("runs/calibration"))
    results["preset"]  # {"sensor": {...}, "camera": {...}, "friction": 0.25}

Domes stay in the cache, so a second calibration of the same sensor takes a third of the time.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from jaxunshear.calibration.fit import FitResult, fit, fit_appearance, render_images
from jaxunshear.calibration.labels import make_paths
from jaxunshear.calibration.pin_statistics import (
    PinObservation,
    Summary,
    observe_pins,
    summarise_pins,
    summarise_slides,
)
from jaxunshear.calibration.prediction import (
    Calibration,
    SensorValues,
    SolvedContacts,
    make_values,
    solve_contacts,
)
from jaxunshear.calibration.problem import SURFACE, RecordedGroup
from jaxunshear.calibration.recorded_groups import RecordedImages, observe_groups, sample_folders
from jaxunshear.config.sensor import Camera, Sensor
from jaxunshear.config.stimuli import ABS_FRICTION
from jaxunshear.data.sensor_frame import match_sensor
from jaxunshear.errors import UserError
from jaxunshear.files import Json, write_bytes, write_json, write_text
from jaxunshear.perception.pin_detection import detect_pin_centres
from jaxunshear.progress import Progress
from jaxunshear.style import STYLE, encode_png
from jaxunshear.text_table import format_text_table

IMAGES = 200  # of all groups together; more do not narrow the intervals that matter
SEED = 0  # of the choice of images
FIRST_FIT_STRIDE = 3  # the first fit takes one of so many images
MAX_PIN_COUNT_ERROR = 0.1  # of a sensor's pins, by which a count may miss
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
MAX_TITLE = 30  # characters
STATISTICS = ("statistic", "unit", "recorded", "before", "after")
PARAMETERS = ("parameter", "unit", "before", "after", "95 % interval", "remark")


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
    _check_arguments(sensor, fixed)
    recorded, notes = sample_folders(Path(path), images, SEED)
    start = make_values(sensor or _find_sensor(recorded, path), camera or Camera(), ABS_FRICTION)
    groups = observe_groups(recorded, start, notes)
    fitted = _fit_in_two_stages(groups, start, fixed)
    before = SimulatedGroups.simulate(groups, replace(start, surface_mm=fitted.values.surface_mm))
    after = SimulatedGroups.simulate(groups, fitted.values)
    values = fit_appearance(groups, after.values, after.tips)
    after = replace(after, values=values)
    images_before, images_after = before.render(groups), after.render(groups)
    simulated = before.summarise(groups, images_before), after.summarise(groups, images_after)
    camera = values.camera(Camera().frame_px)
    results: Json = {
        "rows": build_rows(summarise_recordings(groups), *simulated),
        "parameters": _build_parameter_rows(start, values, fitted, fixed),
        "preset": Calibration("", values.sensor, camera, values.friction).preset,
        "ring_error_px": {"before": fitted.before_px, "after": fitted.after_px},
        "images": {group.name: len(group.contacts) for group in groups},
        "image_names": [name for part in recorded for name in part.names],
        "notes": notes + _build_notes(fitted, fixed, before, after),
    }
    pictures = {f"recorded: {part.name}": part.images[0] for part in recorded[:2]}
    pictures |= {"simulated, before": images_before[0][0], "simulated, after": images_after[0][0]}
    _report(results, pictures, out)
    return results


@dataclass(frozen=True)
class SimulatedGroups:
    """The contacts of all groups, simulated with one set of values."""

    values: SensorValues
    tips: list[SolvedContacts]  # of each group

    @classmethod
    def simulate(cls, groups: list[RecordedGroup], values: SensorValues) -> "SimulatedGroups":
        tips, sensor = [], values.sensor
        for group, surface_mm in zip(groups, values.surface_mm, strict=True):
            paths = make_paths(group.contacts, sensor, surface_mm, group.side, values.friction)
            tips.append(solve_contacts(sensor, paths))
        return cls(values, tips)

    def count_failures(self) -> int:
        return sum(int((~tips.converged).sum()) for tips in self.tips)

    def render(self, groups: list[RecordedGroup]) -> list[np.ndarray]:
        """Render the images (N, S, S) of each group."""
        images = []
        for group, tips in zip(groups, self.tips, strict=True):
            camera = self.values.camera(group.observation.size)
            images.append(render_images(camera, self.values.sensor, tips.tips))
        return images

    def summarise(self, groups: list[RecordedGroup], images: list[np.ndarray]) -> list[Summary]:
        """Summarise rendered images; contacts that did not converge are left out."""
        parts = []
        for group, tips, rendered in zip(groups, self.tips, images, strict=True):
            observation = observe_pins(rendered, self.values.sensor)
            parts.append(summarise_group(group, observation, tips.converged))
        return _merge_summaries(parts)


def _check_arguments(sensor: Sensor | None, fixed: Collection[str]) -> None:
    if wrong := [name for name in fixed if name not in UNITS]:
        raise UserError(f"'{wrong[0]}' cannot be held: name some of {', '.join(UNITS)}")
    if sensor is not None and sensor.is_flat:
        raise UserError(
            f"sensor '{sensor.name}' is a pad, and only domes are calibrated: name a dome"
        )


def _find_sensor(recorded: list[RecordedImages], path: Path) -> Sensor:
    counts = [len(detect_pin_centres(image)) for part in recorded for image in part.images[:5]]
    return match_sensor(counts, MAX_PIN_COUNT_ERROR, str(path))


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


def summarise_recordings(groups: list[RecordedGroup]) -> list[Summary]:
    """Summarise the recorded images of all groups."""
    return _merge_summaries([summarise_group(group, group.observation) for group in groups])


def summarise_group(
    group: RecordedGroup, observation: PinObservation, converged: np.ndarray | bool = True
) -> list[Summary]:
    """Summarise a group's images, recorded or simulated.

    NaN for images that are not `converged` (N,), or whose pins cannot be followed.
    """
    usable = converged & observation.identified
    observation = observation._replace(
        positions=np.where(usable[:, None, None], observation.positions, np.nan),
        diameter=np.where(usable[:, None], observation.diameter, np.nan),
    )
    rows = summarise_pins(observation) + summarise_slides(observation, group.contacts)
    return [row._replace(values=np.where(usable, row.values, np.nan)) for row in rows]


def _merge_summaries(parts: list[list[Summary]]) -> list[Summary]:
    merged = []
    for rows in zip(*parts, strict=True):
        merged.append(rows[0]._replace(values=np.concatenate([row.values for row in rows])))
    return merged


def build_rows(recorded: list[Summary], before: list[Summary], after: list[Summary]) -> list[Json]:
    """Build a row for each statistic: means over images, None if there are no images.

    `real_se` is the standard error of the recorded mean.
    """
    rows = []
    for real, old, new in zip(recorded, before, after, strict=True):
        count = int(np.isfinite(real.values).sum())
        rows.append(
            {
                "name": real.name,
                "unit": real.unit,
                "real": _compute_mean(real),
                "real_se": float(np.nanstd(real.values) / np.sqrt(count)) if count else None,
                "before": _compute_mean(old),
                "after": _compute_mean(new),
                "images": count,
            }
        )
    return rows


def _compute_mean(summary: Summary) -> float | None:
    return float(np.nanmean(summary.values)) if np.isfinite(summary.values).any() else None


def format_tables(rows: Sequence[Json], parameters: Sequence[Json]) -> str:
    """Format the rows of statistics and of parameters as text."""
    statistics = [
        row | {"statistic": row["name"], "recorded": f"{row['real']:.4g} +- {row['real_se']:.2g}"}
        for row in rows
        if row["images"]
    ]
    fitted = []
    for row in parameters:
        interval = f"{row['low']:.4g} to {row['high']:.4g}" if row["low"] is not None else None
        doubt = "held" if row["held"] else "not determined by these images"
        remark = "" if row["determined"] else doubt
        fitted.append(row | {"parameter": row["name"], "95 % interval": interval, "remark": remark})
    tables = format_text_table(statistics, STATISTICS), format_text_table(fitted, PARAMETERS)
    return "\n\n".join(tables)


def draw_images(pictures: dict[str, np.ndarray]) -> bytes:
    """Draw a PNG of images (S, S) beside each other, by title."""
    with rc_context(STYLE):
        figure = Figure(figsize=(3.6 * len(pictures), 4), layout="constrained", dpi=110)
        panels = figure.subplots(1, len(pictures), squeeze=False)[0]
        for axes, (title, image) in zip(panels, pictures.items(), strict=True):
            axes.axis("off")
            axes.imshow(image, cmap="gray", interpolation="nearest")
            axes.set_title(title if len(title) <= MAX_TITLE else f"...{title[3 - MAX_TITLE :]}")
        return encode_png(figure)
