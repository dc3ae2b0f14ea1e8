"""Simulated against recorded motions, pin by pin: how much of what every pin does the simulator explains.

    flat, place = fit_positions(values, sensor, seen.size, seen.place, moved)  # where the simulator puts the recorded pins, (N, P, 2) px
    compute_r2(*centre_motions(seen.place, place))

Nobody knows where a pin stands untouched, so that every pin counts less its own mean over the contacts of a folder. Real rings have
phases of their own: the simulated motion is interpolated to where the real pins stand.
"""

from dataclasses import dataclass, replace

import numpy as np

from jaxunshear.calibration.pin_statistics import subtract_mean
from jaxunshear.calibration.prediction import (
    SensorValues,
    compute_interpolation_at,
    interpolate_displacements,
    project_tips,
)
from jaxunshear.config.sensor import Sensor
from jaxunshear.simulator.pin_layout import compute_pin_tips, compute_tips_at

MAX_ANGLE_DEG = 68.0  # from the apex: pins that are seen farther out are taken for standing there
POSITION_ROUNDS = (
    3  # rounds in which the places of untouched pins follow from the mean of the touched ones
)
KINDS = {"tap": True, "slide": False}


@dataclass(frozen=True)
class ComparedFolder:
    """The contacts of one folder, in px of a 128-px image, every pin less its mean over them; NaN where a pin was not seen."""

    name: str
    recorded: np.ndarray  # (N, P, 2)
    simulated: np.ndarray  # (N, P, 2)
    ceiling: np.ndarray  # (N, P, 2) predicted by the labels alone, from other contacts
    shell: np.ndarray  # (P,)
    rest: np.ndarray  # (P, 2) places in the image, from its middle
    mm_per_px: np.ndarray  # (P,) at the height of each pin
    taps: np.ndarray  # (N,) bool, of no slide

    def take(self, rows: np.ndarray) -> "ComparedFolder":
        return replace(
            self,
            **{
                name: getattr(self, name)[rows]
                for name in ("recorded", "simulated", "ceiling", "taps")
            },
        )

    def ring(self, shell: int) -> "ComparedFolder":
        here = self.shell == shell
        pins = {name: getattr(self, name)[:, here] for name in ("recorded", "simulated", "ceiling")}
        return replace(
            self,
            **pins,
            shell=self.shell[here],
            rest=self.rest[here],
            mm_per_px=self.mm_per_px[here],
        )


def locate_pins(values: SensorValues, sensor: Sensor, size: int, rest: np.ndarray) -> np.ndarray:
    """(P, 2) mm of arc from the apex, where pins stand that the camera sees untouched at `rest` (P, 2) px from the middle."""
    own = values.sensor(sensor)
    angle = np.radians(np.linspace(0, MAX_ANGLE_DEG, 500))
    line = np.stack([angle * own.dome_radius_mm, np.zeros_like(angle)], -1)
    seen = project_tips(values, sensor, size, compute_tips_at(own, line))[:, 0]
    radius = np.linalg.norm(rest, axis=-1)
    arc = np.interp(radius, seen, line[:, 0])
    return rest * np.divide(arc, radius, out=np.zeros_like(arc), where=radius > 0)[:, None]


def project_positions(
    values: SensorValues, sensor: Sensor, size: int, flat: np.ndarray, moved: np.ndarray
) -> np.ndarray:
    """(N, P, 2) px from the middle, of pins at `flat` (P, 2) mm of arc, for displacements (N, Q, 3) mm of the probe's pins."""
    weights = compute_interpolation_at(sensor, flat)
    return project_tips(
        values,
        sensor,
        size,
        compute_tips_at(values.sensor(sensor), flat) + interpolate_displacements(weights, moved),
    )


def fit_positions(
    values: SensorValues, sensor: Sensor, size: int, place: np.ndarray, moved: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`locate_pins` (P, 2) and `project_positions` (N, P, 2) of pins that are recorded at `place` (N, P, 2): their mean over contacts gives where they
    stand, once it is known how far the contacts move it."""
    wanted, own = np.nanmean(place, axis=0), values.sensor(sensor)
    flat = locate_pins(values, sensor, size, wanted)
    for _ in range(POSITION_ROUNDS):
        simulated = project_positions(values, sensor, size, flat, moved)
        drift = np.mean(simulated, axis=0) - project_tips(
            values, sensor, size, compute_tips_at(own, flat)
        )
        flat = locate_pins(values, sensor, size, wanted - drift)
    return flat, project_positions(values, sensor, size, flat, moved)


def compute_mm_per_px(
    values: SensorValues, sensor: Sensor, size: int, flat: np.ndarray
) -> np.ndarray:
    """(P,) at the height of each untouched pin."""
    own, camera = values.sensor(sensor), values.camera(size)
    apex = compute_pin_tips(own)[0, 2]
    return (
        camera.mm_across
        / size
        * (camera.distance_mm - compute_tips_at(own, flat)[:, 2])
        / (camera.distance_mm - apex)
    )


def centre_motions(recorded: np.ndarray, simulated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both (N, P, 2), each pin less its mean over the contacts in which both are known."""
    known = np.isfinite(recorded) & np.isfinite(simulated)
    return subtract_mean(np.where(known, recorded, np.nan)), subtract_mean(
        np.where(known, simulated, np.nan)
    )


def compute_r2(recorded: np.ndarray, simulated: np.ndarray) -> float:
    """Share of the recorded motion (N, P, 2), as `centre_motions` gives it, that the simulated one explains; NaN where nothing moves."""
    off, size = np.nansum((recorded - simulated) ** 2), np.nansum(recorded**2)
    return float(1 - off / size) if size > 0 else float("nan")


def compute_rms(vectors: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Root of the mean squared length of vectors (..., 2), NaN left out."""
    square = np.sum(vectors**2, axis=-1)
    return np.sqrt(np.nanmean(square, axis=axis))


Row = dict[str, float | int | str | None]


def build_rows(parts: list[ComparedFolder]) -> list[Row]:
    """Score taps and slides over all folders, in full and by ring."""
    rows: list[Row] = []
    for kind, mine in split_by_kind(parts).items():
        rows += _scores(kind, mine)
        for shell in np.unique(mine[0].shell):
            rows += _scores(f"{kind}.ring.{shell}", [part.ring(shell) for part in mine])
    return rows


def split_by_kind(parts: list[ComparedFolder]) -> dict[str, list[ComparedFolder]]:
    """Part taps from slides, folders without any left out; only those kinds that there are."""
    kinds = {
        kind: [
            part.take(np.flatnonzero(part.taps == tapped))
            for part in parts
            if (part.taps == tapped).any()
        ]
        for kind, tapped in KINDS.items()
    }
    return {kind: mine for kind, mine in kinds.items() if mine}


def _scores(name: str, parts: list[ComparedFolder]) -> list[Row]:
    recorded = np.concatenate([part.recorded.reshape(-1, 2) for part in parts])
    simulated = np.concatenate([part.simulated.reshape(-1, 2) for part in parts])
    ceiling = np.concatenate([part.ceiling.reshape(-1, 2) for part in parts])
    scale = np.concatenate([np.tile(part.mm_per_px, len(part.recorded)) for part in parts])
    off = recorded - simulated
    contacts = sum(len(part.recorded) for part in parts)
    figures = [
        ("r2", "1", compute_r2(recorded, simulated)),
        ("residual_px", "px", float(compute_rms(off))),
        ("residual_mm", "mm", float(compute_rms(off * scale[:, None]))),
        ("motion_px", "px", float(compute_rms(recorded))),
        ("ceiling_r2", "1", compute_r2(recorded, ceiling)),
    ]
    return [
        {"name": f"{measure}.{name}", "unit": unit, "value": value, "contacts": contacts}
        for measure, unit, value in figures
    ]
