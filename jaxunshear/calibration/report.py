"""Report a calibration: recorded images, and simulated ones before and after the fit."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from jaxunshear.calibration.fit import render_images
from jaxunshear.calibration.pin_statistics import (
    PinObservation,
    Summary,
    observe_pins,
    summarise_pins,
    summarise_slides,
)
from jaxunshear.calibration.prediction import SensorValues, SolvedContacts
from jaxunshear.calibration.problem import RecordedGroup
from jaxunshear.files import Json
from jaxunshear.style import STYLE, encode_png
from jaxunshear.text_table import format_text_table

MAX_TITLE = 30  # characters
STATISTICS = ("statistic", "unit", "recorded", "before", "after")
PARAMETERS = ("parameter", "unit", "before", "after", "95 % interval", "remark")


@dataclass(frozen=True)
class SimulatedGroups:
    """The contacts of all groups, simulated with one set of values."""

    values: SensorValues
    tips: list[SolvedContacts]  # of each group

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


def summarise_recorded(groups: list[RecordedGroup]) -> list[Summary]:
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
