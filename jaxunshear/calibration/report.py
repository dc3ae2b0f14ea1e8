"""What a calibration reports of recorded images and of simulated ones of the same contacts, before and after the fit:
rows, and one page of curves and example images.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxunshear.calibration.pin_statistics import (
    SLIDE_BINS_MM,
    PinObservation,
    Summary,
    observe_pins,
    summarise_pins,
)
from jaxunshear.calibration.prediction import SensorValues
from jaxunshear.calibration.problem import RecordedGroup
from jaxunshear.calibration.rendering import render_images
from jaxunshear.calibration.sampling import RecordedImages
from jaxunshear.config.sensor import Sensor
from jaxunshear.files import Json
from jaxunshear.style import encode_png

RECORDED, BEFORE, AFTER = "recorded", "simulated, before", "simulated, after"
COLOURS = {RECORDED: "#1c2330", BEFORE: "#d9822b", AFTER: "#1f6feb"}
LONGEST = 30  # characters of a title
Summaries = dict[str, list[Summary]]
ValuesByName = dict[str, dict[str, np.ndarray]]
Tips = list[
    tuple[np.ndarray, np.ndarray]
]  # of each group: pins' tips, and which contacts converged


def compared(
    recorded: list[RecordedImages],
    groups: list[RecordedGroup],
    before: tuple[Sensor, SensorValues, Tips],
    after: tuple[Sensor, SensorValues, Tips],
) -> tuple[Summaries, list[tuple[str, np.ndarray]]]:
    """Statistics of recorded images and of simulated ones before and after the fit, and pictures with their titles."""
    reported: Summaries = {
        RECORDED: _merged(
            [
                summaries_of(group, group.observation, group.observation.identified)
                for group in groups
            ]
        )
    }
    pictures = [(f"recorded: {part.name}", part.images[0]) for part in recorded[:2]]
    for kind, (sensor, values, tips) in ((BEFORE, before), (AFTER, after)):
        reported[kind], picture = _simulated(groups, sensor, values, tips)
        pictures.append((kind, picture))
    return reported, pictures


def _simulated(
    groups: list[RecordedGroup], sensor: Sensor, values: SensorValues, tips: Tips
) -> tuple[list[Summary], np.ndarray]:
    """Statistics of rendered images of the same contacts, and the first image. Left out are, as among the recorded ones, images whose
    pins cannot be followed, and contacts that did not converge."""
    parts: list[list[Summary]] = []
    pictures: list[np.ndarray] = []
    for group, (tip, converged) in zip(groups, tips, strict=True):
        images = render_images(values.camera(group.observation.size), sensor, tip)
        pictures = pictures or [images[0]]
        seen = observe_pins(images, sensor)
        parts.append(summaries_of(group, seen, converged & seen.identified))
    return _merged(parts), pictures[0]


def summaries_of(group: RecordedGroup, seen: PinObservation, kept: np.ndarray) -> list[Summary]:
    """Of a group's images, recorded or simulated; NaN where they are not `kept` (N,)."""
    contacts = group.contacts
    seen = seen._replace(
        positions=np.where(kept[:, None, None], seen.positions, np.nan),
        diameter=np.where(kept[:, None], seen.diameter, np.nan),
    )
    rows = summarise_pins(
        seen, contacts.slide if contacts else None, contacts.yaw if contacts else None
    )
    return [row._replace(values=np.where(kept, row.values, np.nan)) for row in rows]


def _merged(parts: list[list[Summary]]) -> list[Summary]:
    """The same statistics of several groups, image after image; those that only some have are theirs alone."""
    merged: dict[str, Summary] = {}
    for part in parts:
        for row in part:
            known = merged.get(row.name)
            merged[row.name] = (
                row
                if known is None
                else row._replace(values=np.concatenate([known.values, row.values]))
            )
    return list(merged.values())


def build_rows(summaries: Summaries) -> list[Json]:
    """A row for each statistic: means over images, and the recorded mean's standard error; None where there are no images."""
    rows = []
    for real, before, after in zip(
        *(summaries[kind] for kind in (RECORDED, BEFORE, AFTER)), strict=True
    ):
        count = int(np.isfinite(real.values).sum())
        rows.append(
            {
                "name": real.name,
                "unit": real.unit,
                "real": _mean(real),
                "real_se": float(np.nanstd(real.values) / np.sqrt(count)) if count else None,
                "before": _mean(before),
                "after": _mean(after),
                "images": count,
            }
        )
    return rows


def _mean(summary: Summary) -> float | None:
    return float(np.nanmean(summary.values)) if np.isfinite(summary.values).any() else None


def _mean_known(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def format_table(rows: Sequence[Json], parameters: Sequence[Json]) -> str:
    """The same for people, as text."""
    width = max(len(row["name"]) for row in (*rows, *parameters))
    lines = [f"{'':{width}}  {'recorded':>16}  {'before':>9}  {'after':>9}"]
    for row in rows:
        if row["images"]:
            real = f"{row['real']:.4g} +- {row['real_se']:.2g}"
            lines.append(
                f"{row['name']:{width}}  {real:>16}  {_number(row['before'])}  {_number(row['after'])}  {_unit(row)}"
            )
    lines += ["", f"{'':{width}}  {'before':>9}  {'after':>9}  95 % interval"]
    for row in parameters:
        interval = f"{row['low']:.4g} to {row['high']:.4g}" if row["low"] is not None else ""
        known = (
            ""
            if row["determined"]
            else "  held"
            if row["held"]
            else "  not determined by these images"
        )
        lines.append(
            f"{row['name']:{width}}  {_number(row['before'])}  {_number(row['after'])}  {interval}  {_unit(row)}{known}"
        )
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return f"{value:9.4g}" if value is not None else f"{'':9}"


def _unit(row: Json) -> str:
    return "" if row["unit"] == "1" else row["unit"]


def plot_curves(summaries: Summaries, pictures: Sequence[tuple[str, np.ndarray]]) -> bytes:
    """PNG: ring layout, spacing, pin size and motion over slide; below them names and images (S, S)."""
    by_name = {kind: {row.name: row.values for row in rows} for kind, rows in summaries.items()}
    with rc_context(
        {
            "font.size": 9,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "legend.frameon": False,
        }
    ):
        figure = Figure(figsize=(11, 7), layout="constrained", dpi=110)
        panels = figure.subplots(2, 4)
        _rings(panels[0, 0], by_name)
        _histogram(panels[0, 1], by_name, "pin spacing", "pin spacing, px of 128")
        _histogram(panels[0, 2], by_name, "pin diameter", "pin diameter, px of 128")
        _slides(panels[0, 3], by_name)
        for axes in panels[1]:
            axes.axis("off")
        for axes, (name, image) in zip(panels[1], pictures, strict=False):
            axes.imshow(image, cmap="gray", interpolation="nearest")
            axes.set_title(name if len(name) <= LONGEST else f"...{name[3 - LONGEST :]}")
        return encode_png(figure)


def _rings(axes: Axes, by_name: ValuesByName) -> None:
    names = [name for name in by_name[RECORDED] if name.startswith("ring ")]
    recorded = [_mean_known(by_name[RECORDED][name]) for name in names]
    for kind, values in by_name.items():
        rings = np.arange(1, len(names) + 1)
        off = np.array([_mean_known(values[name]) for name in names]) - recorded
        axes.plot(rings, off, "o-", markersize=3, color=COLOURS[kind], label=kind)
    axes.set(xlabel="ring", title="radius over outermost, less recorded")
    axes.legend()


def _histogram(axes: Axes, by_name: ValuesByName, name: str, title: str) -> None:
    every = np.concatenate([values[name] for values in by_name.values()])
    edges = np.linspace(np.nanmin(every) - 0.05, np.nanmax(every) + 0.05, 30).tolist()
    for kind, values in by_name.items():
        known = values[name][np.isfinite(values[name])]
        if len(known):
            axes.hist(known, edges, density=True, histtype="step", color=COLOURS[kind], label=kind)
    axes.set(title=title, yticks=[])


def _slides(axes: Axes, by_name: ValuesByName) -> None:
    for kind, values in by_name.items():
        for part, style in (("central pins left", "o-"), ("outermost ring left", "s:")):
            means = [values[name] for name in values if name.startswith(part)]
            known = [i for i, each in enumerate(means) if np.isfinite(each).any()]
            if known:
                middle = np.array(SLIDE_BINS_MM)[known] + 0.5
                axes.plot(
                    middle,
                    [np.nanmean(means[i]) for i in known],
                    style,
                    markersize=3,
                    color=COLOURS[kind],
                )
    axes.set(xlabel="slide, mm", title="pins left behind, px of 128\n(full: central, dotted: rim)")
