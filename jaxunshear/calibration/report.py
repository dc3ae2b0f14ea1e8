"""Report a calibration: recorded images, and simulated ones before and after the fit.

A report has rows of statistics, and one page of curves and example images.
"""

from collections.abc import Sequence
from typing import NamedTuple

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
from jaxunshear.calibration.rendering import SimulatedTips, render_images
from jaxunshear.calibration.sampling import RecordedImages
from jaxunshear.config.sensor import Sensor
from jaxunshear.files import Json
from jaxunshear.style import encode_png

RECORDED, BEFORE, AFTER = "recorded", "simulated, before", "simulated, after"
COLOURS = {RECORDED: "#1c2330", BEFORE: "#d9822b", AFTER: "#1f6feb"}
MAX_TITLE = 30  # characters
Summaries = dict[str, list[Summary]]
ValuesByName = dict[str, dict[str, np.ndarray]]
Picture = tuple[str, np.ndarray]  # title, image (S, S)


class SimulatedGroups(NamedTuple):
    """The contacts of all groups, simulated with one set of values."""

    sensor: Sensor
    values: SensorValues
    tips: list[SimulatedTips]  # of each group


def summarise_images(
    recorded: list[RecordedImages],
    groups: list[RecordedGroup],
    before: SimulatedGroups,
    after: SimulatedGroups,
) -> tuple[Summaries, list[Picture]]:
    """Summarise images, recorded and simulated before and after the fit; choose pictures."""
    parts = [
        summarise_group(group, group.observation, group.observation.identified) for group in groups
    ]
    summaries: Summaries = {RECORDED: _merge_summaries(parts)}
    pictures = [(f"recorded: {part.name}", part.images[0]) for part in recorded[:2]]
    for kind, simulated in ((BEFORE, before), (AFTER, after)):
        summaries[kind], image = _summarise_simulated_images(groups, simulated)
        pictures.append((kind, image))
    return summaries, pictures


def _summarise_simulated_images(
    groups: list[RecordedGroup], simulated: SimulatedGroups
) -> tuple[list[Summary], np.ndarray]:
    """Summarise rendered images of the contacts, and return the first image.

    As in recorded images, images whose pins cannot be followed are left out; so are contacts that
    did not converge.
    """
    sensor, values, tips_by_group = simulated
    parts: list[list[Summary]] = []
    pictures: list[np.ndarray] = []
    for group, (tips, converged) in zip(groups, tips_by_group, strict=True):
        images = render_images(values.camera(group.observation.size), sensor, tips)
        pictures.append(images[0])
        observation = observe_pins(images, sensor)
        parts.append(summarise_group(group, observation, converged & observation.identified))
    return _merge_summaries(parts), pictures[0]


def summarise_group(
    group: RecordedGroup, observation: PinObservation, usable: np.ndarray
) -> list[Summary]:
    """Summarise a group's images, recorded or simulated; NaN for images not `usable` (N,)."""
    observation = observation._replace(
        positions=np.where(usable[:, None, None], observation.positions, np.nan),
        diameter=np.where(usable[:, None], observation.diameter, np.nan),
    )
    rows = summarise_pins(observation, group.contacts)
    return [row._replace(values=np.where(usable, row.values, np.nan)) for row in rows]


def _merge_summaries(parts: list[list[Summary]]) -> list[Summary]:
    """Join the statistics of several groups by name, image after image."""
    merged: dict[str, Summary] = {}
    for part in parts:
        for row in part:
            if row.name in merged:
                row = row._replace(values=np.concatenate([merged[row.name].values, row.values]))
            merged[row.name] = row
    return list(merged.values())


def build_rows(summaries: Summaries) -> list[Json]:
    """Build a row for each statistic: means over images, None if there are no images.

    `real_se` is the standard error of the recorded mean.
    """
    rows = []
    for real, before, after in zip(
        summaries[RECORDED], summaries[BEFORE], summaries[AFTER], strict=True
    ):
        count = int(np.isfinite(real.values).sum())
        rows.append(
            {
                "name": real.name,
                "unit": real.unit,
                "real": _compute_mean(real),
                "real_se": float(np.nanstd(real.values) / np.sqrt(count)) if count else None,
                "before": _compute_mean(before),
                "after": _compute_mean(after),
                "images": count,
            }
        )
    return rows


def _compute_mean(summary: Summary) -> float | None:
    return float(np.nanmean(summary.values)) if np.isfinite(summary.values).any() else None


def format_table(rows: Sequence[Json], parameters: Sequence[Json]) -> str:
    """Format the rows of statistics and of parameters as text."""
    width = max(len(row["name"]) for row in (*rows, *parameters))
    lines = [f"{'':{width}}  {'recorded':>16}  {'before':>9}  {'after':>9}"]
    for row in rows:
        if row["images"]:
            real = f"{row['real']:.4g} +- {row['real_se']:.2g}"
            lines.append(f"{row['name']:{width}}  {real:>16}  {_format_change(row)}  {_unit(row)}")
    lines += ["", f"{'':{width}}  {'before':>9}  {'after':>9}  95 % interval"]
    for row in parameters:
        interval = f"{row['low']:.4g} to {row['high']:.4g}" if row["low"] is not None else ""
        doubt = "  held" if row["held"] else "  not determined by these images"
        remark = "" if row["determined"] else doubt
        lines.append(
            f"{row['name']:{width}}  {_format_change(row)}  {interval}  {_unit(row)}{remark}"
        )
    return "\n".join(lines)


def _format_change(row: Json) -> str:
    cells = (row["before"], row["after"])
    return "  ".join(f"{value:9.4g}" if value is not None else f"{'':9}" for value in cells)


def _unit(row: Json) -> str:
    return "" if row["unit"] == "1" else row["unit"]


def plot_curves(summaries: Summaries, pictures: Sequence[Picture]) -> bytes:
    """Draw a PNG of ring layout, spacing, pin size and motion over slide, and pictures."""
    by_name: ValuesByName = {}
    for kind, rows in summaries.items():
        by_name[kind] = {row.name: row.values for row in rows}
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
        _plot_rings(panels[0, 0], by_name)
        _plot_histogram(panels[0, 1], by_name, "pin spacing", "pin spacing, px of 128")
        _plot_histogram(panels[0, 2], by_name, "pin diameter", "pin diameter, px of 128")
        _plot_slides(panels[0, 3], by_name)
        for axes in panels[1]:
            axes.axis("off")
        for axes, (name, image) in zip(panels[1], pictures, strict=False):
            axes.imshow(image, cmap="gray", interpolation="nearest")
            axes.set_title(name if len(name) <= MAX_TITLE else f"...{name[3 - MAX_TITLE :]}")
        return encode_png(figure)


def _plot_rings(axes: Axes, by_name: ValuesByName) -> None:
    names = [name for name in by_name[RECORDED] if name.startswith("ring ")]
    recorded = _average_finite(by_name[RECORDED], names)
    for kind, values in by_name.items():
        rings = np.arange(1, len(names) + 1)
        difference = _average_finite(values, names) - recorded
        axes.plot(rings, difference, "o-", markersize=3, color=COLOURS[kind], label=kind)
    axes.set(xlabel="ring", title="radius over outermost, less recorded")
    axes.legend()


def _average_finite(values: dict[str, np.ndarray], names: list[str]) -> np.ndarray:
    """Average the finite values of each name; NaN if there are none."""
    means = []
    for name in names:
        finite = values[name][np.isfinite(values[name])]
        means.append(float(finite.mean()) if len(finite) else float("nan"))
    return np.array(means)


def _plot_histogram(axes: Axes, by_name: ValuesByName, name: str, title: str) -> None:
    pooled = np.concatenate([values[name] for values in by_name.values()])
    edges = np.linspace(np.nanmin(pooled) - 0.05, np.nanmax(pooled) + 0.05, 30).tolist()
    for kind, values in by_name.items():
        finite = values[name][np.isfinite(values[name])]
        if len(finite):
            axes.hist(finite, edges, density=True, histtype="step", color=COLOURS[kind], label=kind)
    axes.set(title=title, yticks=[])


def _plot_slides(axes: Axes, by_name: ValuesByName) -> None:
    for kind, values in by_name.items():
        for part, style in (("central pins left", "o-"), ("outermost ring left", "s:")):
            middles, means = [], []
            bins = [values[name] for name in values if name.startswith(part)]
            for least, lags in zip(SLIDE_BINS_MM, bins, strict=False):
                if np.isfinite(lags).any():
                    middles.append(least + 0.5)
                    means.append(np.nanmean(lags))
            if means:
                axes.plot(middles, means, style, markersize=3, color=COLOURS[kind])
    axes.set(xlabel="slide, mm", title="pins left behind, px of 128\n(full: central, dotted: rim)")
