"""Recorded images beside simulated ones of the same contacts, before and after a fit."""

import numpy as np

from jaxunshear.calibration.prediction import Values
from jaxunshear.calibration.problem import Group
from jaxunshear.calibration.rendering import render
from jaxunshear.calibration.report import AFTER, BEFORE, RECORDED, Summaries
from jaxunshear.calibration.sampling import Recorded
from jaxunshear.calibration.statistics import Seen, Summary, observe, summaries
from jaxunshear.settings.sensor import Sensor

Tips = list[tuple[np.ndarray, np.ndarray]]  # of each group: pins' tips, and which contacts converged


def compared(
    recorded: list[Recorded],
    groups: list[Group],
    before: tuple[Sensor, Values, Tips],
    after: tuple[Sensor, Values, Tips],
) -> tuple[Summaries, list[tuple[str, np.ndarray]]]:
    """Statistics of recorded images and of simulated ones before and after the fit, and pictures with their titles."""
    reported: Summaries = {RECORDED: _merged([summaries_of(group, group.seen, group.seen.sure) for group in groups])}
    pictures = [(f"recorded: {part.name}", part.images[0]) for part in recorded[:2]]
    for kind, (sensor, values, tips) in ((BEFORE, before), (AFTER, after)):
        reported[kind], picture = _simulated(groups, sensor, values, tips)
        pictures.append((kind, picture))
    return reported, pictures


def _simulated(groups: list[Group], sensor: Sensor, values: Values, tips: Tips) -> tuple[list[Summary], np.ndarray]:
    """Statistics of rendered images of the same contacts, and the first image. Left out are, as among the recorded ones, images whose
    pins cannot be followed, and contacts that did not converge."""
    parts: list[list[Summary]] = []
    pictures: list[np.ndarray] = []
    for group, (tip, converged) in zip(groups, tips, strict=True):
        images = render(values.camera(group.seen.size), sensor, tip)
        pictures = pictures or [images[0]]
        seen = observe(images, sensor)
        parts.append(summaries_of(group, seen, converged & seen.sure))
    return _merged(parts), pictures[0]


def summaries_of(group: Group, seen: Seen, kept: np.ndarray) -> list[Summary]:
    """Of a group's images, recorded or simulated; NaN where they are not `kept` (N,)."""
    contacts = group.contacts
    seen = seen._replace(
        place=np.where(kept[:, None, None], seen.place, np.nan), diameter=np.where(kept[:, None], seen.diameter, np.nan)
    )
    rows = summaries(seen, contacts.slide if contacts else None, contacts.yaw if contacts else None)
    return [row._replace(values=np.where(kept, row.values, np.nan)) for row in rows]


def _merged(parts: list[list[Summary]]) -> list[Summary]:
    """The same statistics of several groups, image after image; those that only some have are theirs alone."""
    merged: dict[str, Summary] = {}
    for part in parts:
        for row in part:
            known = merged.get(row.name)
            merged[row.name] = row if known is None else row._replace(values=np.concatenate([known.values, row.values]))
    return list(merged.values())
