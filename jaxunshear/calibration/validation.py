"""Simulated against recorded motions, pin by pin: how much of what every pin does the simulator explains.

    flat, place = settled(values, sensor, seen.size, seen.place, moved)  # where the simulator puts the recorded pins, (N, P, 2) px
    r2(*centred(seen.place, place))

Nobody knows where a pin stands untouched, so that every pin counts less its own mean over the contacts of a folder. Real rings have
phases of their own: the simulated motion is interpolated to where the real pins stand.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np

from jaxunshear.calibration.prediction import Values, interpolation_at, probe
from jaxunshear.calibration.statistics import SLIDE_BINS_MM, less_mean
from jaxunshear.image.camera import project
from jaxunshear.scene.pins import pin_tips
from jaxunshear.settings.sensor import Sensor

FARTHEST_DEG = 68.0  # from the apex: pins that are seen farther out are taken for standing there
SETTLING = 3  # rounds in which the places of untouched pins follow from the mean of the touched ones
PARTS = 3  # of contacts by depth and by distance, equally many
LEAST = 8  # contacts that a row is worth


@dataclass(frozen=True)
class Compared:
    """The contacts of one folder, in px of a 128-px image, every pin less its mean over them; NaN where a pin was not seen."""

    name: str
    recorded: np.ndarray  # (N, P, 2)
    simulated: np.ndarray  # (N, P, 2)
    ceiling: np.ndarray  # (N, P, 2) predicted by the labels alone, from other contacts
    shell: np.ndarray  # (P,)
    rest: np.ndarray  # (P, 2) places in the image, from its middle
    mm_per_px: np.ndarray  # (P,) at the height of each pin
    slide_mm: np.ndarray  # (N,) length
    depth_mm: np.ndarray  # (N,) indentation at the end
    edge_mm: np.ndarray  # (N,) of the dome's apex from the edge, negative on the object; NaN without an edge

    def take(self, rows: np.ndarray) -> "Compared":
        names = ("recorded", "simulated", "ceiling", "slide_mm", "depth_mm", "edge_mm")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def ring(self, shell: int) -> "Compared":
        here = self.shell == shell
        pins = {name: getattr(self, name)[:, here] for name in ("recorded", "simulated", "ceiling")}
        return replace(self, **pins, shell=self.shell[here], rest=self.rest[here], mm_per_px=self.mm_per_px[here])

    @property
    def taps(self) -> np.ndarray:
        """(N,) bool"""
        return self.slide_mm < 1e-6


def stand(values: Values, sensor: Sensor, size: int, rest: np.ndarray) -> np.ndarray:
    """(P, 2) mm of arc from the apex, where pins stand that the camera sees untouched at `rest` (P, 2) px from the middle."""
    own = values.sensor(sensor)
    angle = np.radians(np.linspace(0, FARTHEST_DEG, 500))
    line = np.stack([angle * own.dome_radius_mm, np.zeros_like(angle)], -1)
    seen = (np.asarray(project(values.camera(size), jnp.asarray(_tips(own, line)), own)) - (size - 1) / 2)[:, 0]
    radius = np.linalg.norm(rest, axis=-1)
    arc = np.interp(radius, seen, line[:, 0])
    return rest * np.divide(arc, radius, out=np.zeros_like(arc), where=radius > 0)[:, None]


def _tips(sensor: Sensor, flat: np.ndarray) -> np.ndarray:
    """Untouched tips (P, 3) mm of pins at `flat` (P, 2) mm of arc from the apex, as `scene.pins.pin_tips` has its lattice's."""
    arc = np.linalg.norm(flat, axis=-1)
    angle = arc / sensor.dome_radius_mm
    direction = np.divide(flat, arc[:, None], out=np.zeros_like(flat), where=arc[:, None] > 0)
    outwards = np.concatenate([np.sin(angle)[:, None] * direction, -np.cos(angle)[:, None]], axis=-1)
    inner = sensor.dome_radius_mm - sensor.skin_mm - sensor.pin_length_mm
    return sensor.dome_radius_mm * np.array([0, 0, 1.0]) + inner * outwards


def places(values: Values, sensor: Sensor, size: int, flat: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """(N, P, 2) px from the middle, of pins at `flat` (P, 2) mm of arc, for displacements (N, Q, 3) mm of the probe's pins."""
    own = values.sensor(sensor)
    weights = interpolation_at(flat, probe(sensor, 1.0).pin_spacing_mm)
    shift = (weights @ moved.swapaxes(0, 1).reshape(moved.shape[1], -1)).reshape(len(flat), -1, 3)
    tips = _tips(own, flat) + shift.swapaxes(0, 1)
    return np.asarray(project(values.camera(size), jnp.asarray(tips), own)) - (size - 1) / 2


def settled(
    values: Values, sensor: Sensor, size: int, place: np.ndarray, moved: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`stand` (P, 2) and `places` (N, P, 2) of pins that are recorded at `place` (N, P, 2): their mean over contacts gives where they
    stand, once it is known how far the contacts move it."""
    wanted = np.nanmean(place, axis=0)
    flat = stand(values, sensor, size, wanted)
    for _ in range(SETTLING):
        simulated = places(values, sensor, size, flat, moved)
        drift = np.mean(simulated, axis=0) - _untouched(values, sensor, size, flat)
        flat = stand(values, sensor, size, wanted - drift)
    return flat, places(values, sensor, size, flat, moved)


def _untouched(values: Values, sensor: Sensor, size: int, flat: np.ndarray) -> np.ndarray:
    """(P, 2) px from the middle of untouched pins at `flat` (P, 2)."""
    own = values.sensor(sensor)
    return np.asarray(project(values.camera(size), jnp.asarray(_tips(own, flat)), own)) - (size - 1) / 2


def mm_per_px(values: Values, sensor: Sensor, size: int, flat: np.ndarray) -> np.ndarray:
    """(P,) at the height of each untouched pin."""
    own, camera = values.sensor(sensor), values.camera(size)
    apex = pin_tips(own)[0, 2]
    return camera.mm_across / size * (camera.distance_mm - _tips(own, flat)[:, 2]) / (camera.distance_mm - apex)


def centred(recorded: np.ndarray, simulated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both (N, P, 2), each pin less its mean over the contacts in which both are known."""
    known = np.isfinite(recorded) & np.isfinite(simulated)
    return less_mean(np.where(known, recorded, np.nan)), less_mean(np.where(known, simulated, np.nan))


def r2(recorded: np.ndarray, simulated: np.ndarray) -> float:
    """Share of the recorded motion (N, P, 2), as `centred` gives it, that the simulated one explains; NaN where nothing moves."""
    off, size = np.nansum((recorded - simulated) ** 2), np.nansum(recorded**2)
    return float(1 - off / size) if size > 0 else float("nan")


def rms(vectors: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Root of the mean squared length of vectors (..., 2), NaN left out."""
    square = np.sum(vectors**2, axis=-1)
    return np.sqrt(np.nanmean(square, axis=axis))


Row = dict[str, float | int | str | None]


def rows_of(parts: list[Compared]) -> list[Row]:
    """Scores of taps and slides over all folders, in full and by ring, depth, distance to the edge and length of the slide."""
    rows: list[Row] = []
    for kind in ("tap", "slide"):
        mine = [part.take(np.flatnonzero(part.taps == (kind == "tap"))) for part in parts]
        mine = [part for part in mine if len(part.recorded)]
        if not mine:
            continue
        rows += _scores(kind, mine, full=True)
        for shell in np.unique(mine[0].shell):
            rows += _scores(f"{kind}.ring.{shell}", [part.ring(shell) for part in mine])
        for name, chosen in _subsets(mine):
            rows += _scores(f"{kind}.{name}", chosen)
    return rows


def _subsets(parts: list[Compared]) -> Iterator[tuple[str, list[Compared]]]:
    for quantity, field in (("depth", "depth_mm"), ("edge", "edge_mm")):
        values = np.concatenate([getattr(part, field) for part in parts])
        if np.isfinite(values).sum() >= PARTS * LEAST and np.ptp(values[np.isfinite(values)]) > 0.1:
            ends = np.round(np.nanquantile(values, np.linspace(0, 1, PARTS + 1)), 1)
            ends[0], ends[-1] = np.floor(10 * np.nanmin(values)) / 10, np.ceil(10 * np.nanmax(values)) / 10
            yield from _binned(parts, quantity, field, list(ends))
    longest = max(float(part.slide_mm.max()) for part in parts)
    if longest > 0:
        yield from _binned(parts, "length", "slide_mm", [*SLIDE_BINS_MM, max(longest, SLIDE_BINS_MM[-1]) + 0.1])


def _binned(
    parts: list[Compared], quantity: str, field: str, ends: list[float]
) -> Iterator[tuple[str, list[Compared]]]:
    for low, high in pairwise(ends):
        chosen = [
            part.take(np.flatnonzero((getattr(part, field) >= low) & (getattr(part, field) < high))) for part in parts
        ]
        chosen = [part for part in chosen if len(part.recorded)]
        if sum(len(part.recorded) for part in chosen) >= LEAST:
            yield f"{quantity}.{low:.1f}-{high:.1f}", chosen


def _scores(name: str, parts: list[Compared], full: bool = False) -> list[Row]:
    recorded = np.concatenate([part.recorded.reshape(-1, 2) for part in parts])
    simulated = np.concatenate([part.simulated.reshape(-1, 2) for part in parts])
    ceiling = np.concatenate([part.ceiling.reshape(-1, 2) for part in parts])
    scale = np.concatenate([np.tile(part.mm_per_px, len(part.recorded)) for part in parts])
    off = recorded - simulated
    contacts = sum(len(part.recorded) for part in parts)
    figures = [
        ("r2", "1", r2(recorded, simulated)),
        ("residual_px", "px", float(rms(off))),
        ("residual_mm", "mm", float(rms(off * scale[:, None]))),
        ("motion_px", "px", float(rms(recorded))),
        ("ceiling_r2", "1", r2(recorded, ceiling)),
    ]
    if full:
        figures.append(("ceiling_residual_px", "px", float(rms(recorded - ceiling))))
    return [
        {"name": f"{measure}.{name}", "unit": unit, "value": value, "contacts": contacts}
        for measure, unit, value in figures
    ]
