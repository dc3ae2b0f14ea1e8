"""How well the contact geometry of taps, sheared and unsheared images agrees with how far the simulator's skin was pressed in."""

import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxunshear.applications.fresh import FreshContacts
from jaxunshear.applications.geometry import relative_growth, smoothed
from jaxunshear.applications.perception import Unshear, in_batches
from jaxunshear.errors import UserError
from jaxunshear.evaluation.spread import intervals
from jaxunshear.image.lattice import Lattice
from jaxunshear.image.tracking import tracks_of

SEED = 0


class Geometry(NamedTuple):
    """Heights of N contacts by kind of image, NaN rows where pins were not identified for sure."""

    height_mm: dict[str, np.ndarray]  # (N, P)
    ms: dict[str, float]  # an image, from image to heights, networks included


def known_growths(lattice: Lattice, known: FreshContacts) -> np.ndarray:
    """`growths` of taps. Raises `UserError` where hardly any shows its pins well enough."""
    growth = growths(lattice, known.tap)
    sure = np.mean(~np.isnan(growth[:, 0]))
    if sure < 0.5:
        raise UserError(
            f"pins are identified in only {100 * sure:.0f} % of simulated taps of {known.tap.shape[1]} px: "
            "use a model of larger images (128 px or more)"
        )
    return growth


def growths(lattice: Lattice, images: np.ndarray) -> np.ndarray:
    """Smoothed relative growth (N, P) of the pins' cells in images (N, S, S); NaN rows where pins were not identified for sure."""
    growth = np.full((len(images), len(lattice.place)), np.nan)
    tracks = tracks_of(lattice, images)
    sure = np.array([track.sure for track in tracks])
    if sure.any():
        motion = np.stack([track.motion for track in tracks])[sure]
        growth[sure] = smoothed(lattice, relative_growth(lattice, motion))
    return growth


def mm_of_growth(lattice: Lattice, known: FreshContacts) -> float:
    """Indentation (mm) of a cell that has doubled: least squares over taps whose indentation is known."""
    growth = known_growths(lattice, known)
    told = ~np.isnan(growth)
    return float(np.sum(known.indentation_mm[told] * growth[told]) / np.sum(growth[told] ** 2))


def geometry_of(lattice: Lattice, contacts: FreshContacts, mm: float, networks: Mapping[str, Unshear]) -> Geometry:
    """Heights of taps, sheared images and what each network makes of these."""
    height, ms = {}, {}
    for kind in ("tap", "sheared", *networks):
        images = contacts.tap if kind == "tap" else contacts.sheared
        if kind in networks:
            in_batches(networks[kind], images[:1])  # compiles
        began = time.perf_counter()
        seen = in_batches(networks[kind], images) if kind in networks else images
        height[kind] = mm * growths(lattice, seen)
        ms[kind] = 1e3 * (time.perf_counter() - began) / len(images)
    return Geometry(height, ms)


def geometry_rows(names: tuple[str, ...], contacts: FreshContacts, geometry: Geometry) -> list[dict[str, Any]]:
    """A row for each stimulus and kind, and for all stimuli: mean correlation with its interval, rmse, and what was left out."""
    rows = []
    groups = {"all": np.ones(len(contacts.stimulus), bool)}
    groups |= {name: contacts.stimulus == index for index, name in enumerate(names)}
    for group, inside in groups.items():
        for kind, height in geometry.height_mm.items():
            told = inside & ~np.isnan(height[:, 0])
            row: dict[str, Any] = {
                "name": f"{group}/{kind}",
                "stimulus": group,
                "kind": kind,
                "contacts": int(inside.sum()),
                "unmatched": int((inside & ~told).sum()),
                "ms_per_image": geometry.ms[kind],
            }
            if told.any():
                true = contacts.indentation_mm[told]
                score = {
                    "correlation": correlation(height[told], true),
                    "rmse_mm": np.sqrt(np.mean((height[told] - true) ** 2, axis=-1)),
                }
                spans = intervals(score, np.flatnonzero(told), SEED)
                for name, values in score.items():
                    row |= {name: float(values.mean()), f"{name}_interval": spans[name]}
            rows.append(row)
    return rows


def correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pearson's, row by row, (N,) of (N, P); 0 where a row is flat."""
    a, b = (x - x.mean(axis=-1, keepdims=True) for x in (a, b))
    scale = np.sqrt(np.sum(a**2, axis=-1) * np.sum(b**2, axis=-1))
    return np.divide(np.sum(a * b, axis=-1), scale, out=np.zeros(len(a)), where=scale > 0)
