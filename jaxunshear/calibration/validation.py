"""Scores of simulated motions: how much of every recorded pin's motion they explain.

    flat, simulated = fit_positions(values, sensor, size, recorded, displacement)  # (N, P, 2) px
    compute_r2(*centre_motions(recorded, simulated))

Rest positions of recorded pins are unknown, so every pin counts less its own mean over the contacts
of a folder. The phases of real rings differ from those of the layout, so the simulated motion is
interpolated to where the real pins are.
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

MAX_ANGLE_DEG = 68.0  # from the apex; pins that appear farther out are placed there
POSITION_ROUNDS = 3  # in which rest positions follow from the mean of the touched pins
KINDS = {"tap": True, "slide": False}
MOTIONS = ("recorded", "simulated", "ceiling")  # fields of ComparedFolder

Row = dict[str, float | int | str | None]


@dataclass(frozen=True)
class ComparedFolder:
    """The contacts of one folder, in px of a 128-px image.

    Every pin counts less its mean over them; NaN if it was not detected.
    """

    name: str
    recorded: np.ndarray  # (N, P, 2)
    simulated: np.ndarray  # (N, P, 2)
    ceiling: np.ndarray  # (N, P, 2) predicted by the labels alone, from other contacts
    ring: np.ndarray  # (P,)
    rest: np.ndarray  # (P, 2) positions in the image, from its middle
    mm_per_px: np.ndarray  # (P,) at the height of each pin
    taps: np.ndarray  # (N,) bool, contacts without a slide

    def select_contacts(self, rows: np.ndarray) -> "ComparedFolder":
        fields = {name: getattr(self, name)[rows] for name in (*MOTIONS, "taps")}
        return replace(self, **fields)

    def select_ring(self, ring: int) -> "ComparedFolder":
        pins = self.ring == ring
        fields = {name: getattr(self, name)[:, pins] for name in MOTIONS}
        fields |= {name: getattr(self, name)[pins] for name in ("ring", "rest", "mm_per_px")}
        return replace(self, **fields)


def locate_pins(values: SensorValues, sensor: Sensor, size: int, rest: np.ndarray) -> np.ndarray:
    """Locate pins on the dome (P, 2), mm of arc from the apex.

    `rest` (P, 2) are their untouched positions, px from the middle of the image.
    """
    fitted = values.sensor(sensor)
    angle = np.radians(np.linspace(0, MAX_ANGLE_DEG, 500))
    line = np.stack([angle * fitted.dome_radius_mm, np.zeros_like(angle)], -1)
    line_px = project_tips(values, sensor, size, compute_tips_at(fitted, line))[:, 0]
    radius = np.linalg.norm(rest, axis=-1)
    arc = np.interp(radius, line_px, line[:, 0])
    return rest * np.divide(arc, radius, out=np.zeros_like(arc), where=radius > 0)[:, None]


def project_positions(
    values: SensorValues, sensor: Sensor, size: int, flat: np.ndarray, displacement: np.ndarray
) -> np.ndarray:
    """Project pins at `flat` (P, 2) mm of arc to (N, P, 2) px from the middle of the image.

    `displacement` (N, Q, 3) mm is that of the probe's pins.
    """
    weights = compute_interpolation_at(sensor, flat)
    tips = compute_tips_at(values.sensor(sensor), flat)
    tips = tips + interpolate_displacements(weights, displacement)
    return project_tips(values, sensor, size, tips)


def fit_positions(
    values: SensorValues, sensor: Sensor, size: int, recorded: np.ndarray, displacement: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fit positions on the dome (P, 2) mm of arc to pins recorded at (N, P, 2) px.

    The simulated contacts say how far the pins' mean over the contacts is from their rest position.
    Also returns the pins (N, P, 2) px of `project_positions`.
    """
    mean, fitted = np.nanmean(recorded, axis=0), values.sensor(sensor)
    flat = locate_pins(values, sensor, size, mean)
    for _ in range(POSITION_ROUNDS):
        simulated = project_positions(values, sensor, size, flat, displacement)
        rest = project_tips(values, sensor, size, compute_tips_at(fitted, flat))
        flat = locate_pins(values, sensor, size, mean - (np.mean(simulated, axis=0) - rest))
    return flat, project_positions(values, sensor, size, flat, displacement)


def compute_mm_per_px(
    values: SensorValues, sensor: Sensor, size: int, flat: np.ndarray
) -> np.ndarray:
    """Compute the scale (P,) at the height of each untouched pin."""
    fitted, camera = values.sensor(sensor), values.camera(size)
    apex = compute_pin_tips(fitted)[0, 2]
    return (
        camera.mm_across
        / size
        * (camera.distance_mm - compute_tips_at(fitted, flat)[:, 2])
        / (camera.distance_mm - apex)
    )


def centre_motions(recorded: np.ndarray, simulated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Subtract each pin's mean over the contacts in which both motions (N, P, 2) are known."""
    known = np.isfinite(recorded) & np.isfinite(simulated)
    return (
        subtract_mean(np.where(known, recorded, np.nan)),
        subtract_mean(np.where(known, simulated, np.nan)),
    )


def compute_r2(recorded: np.ndarray, simulated: np.ndarray) -> float:
    """Compute the share of the recorded motion that the simulated one explains.

    Both are (N, P, 2) from `centre_motions`. NaN if nothing moves.
    """
    error, size = np.nansum((recorded - simulated) ** 2), np.nansum(recorded**2)
    return float(1 - error / size) if size > 0 else float("nan")


def compute_rms(vectors: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Compute the root mean squared length of vectors (..., 2), without NaN."""
    return np.sqrt(np.nanmean(np.sum(vectors**2, axis=-1), axis=axis))


def build_rows(folders: list[ComparedFolder]) -> list[Row]:
    """Score taps and slides over all folders, in full and by ring."""
    rows: list[Row] = []
    for kind, parts in split_by_kind(folders).items():
        rows += _score(kind, parts)
        for ring in np.unique(parts[0].ring):
            rows += _score(f"{kind}.ring.{ring}", [part.select_ring(ring) for part in parts])
    return rows


def split_by_kind(folders: list[ComparedFolder]) -> dict[str, list[ComparedFolder]]:
    """Split taps from slides; kinds and folders without contacts are left out."""
    kinds: dict[str, list[ComparedFolder]] = {}
    for kind, is_tap in KINDS.items():
        for folder in folders:
            rows = np.flatnonzero(folder.taps == is_tap)
            if len(rows):
                kinds.setdefault(kind, []).append(folder.select_contacts(rows))
    return kinds


def _score(name: str, parts: list[ComparedFolder]) -> list[Row]:
    recorded = np.concatenate([part.recorded.reshape(-1, 2) for part in parts])
    simulated = np.concatenate([part.simulated.reshape(-1, 2) for part in parts])
    ceiling = np.concatenate([part.ceiling.reshape(-1, 2) for part in parts])
    scale = np.concatenate([np.tile(part.mm_per_px, len(part.recorded)) for part in parts])
    residual = recorded - simulated
    contacts = sum(len(part.recorded) for part in parts)
    scores = [
        ("r2", "1", compute_r2(recorded, simulated)),
        ("residual_px", "px", float(compute_rms(residual))),
        ("residual_mm", "mm", float(compute_rms(residual * scale[:, None]))),
        ("motion_px", "px", float(compute_rms(recorded))),
        ("ceiling_r2", "1", compute_r2(recorded, ceiling)),
    ]
    return [
        {"name": f"{measure}.{name}", "unit": unit, "value": value, "contacts": contacts}
        for measure, unit, value in scores
    ]
