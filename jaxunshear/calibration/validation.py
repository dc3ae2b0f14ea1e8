"""Scores of simulated motions: how much of every recorded pin's motion they explain.

    compute_r2(*centre_motions(recorded, simulated))  # (N, P, 2) px each

Rest positions of recorded pins are unknown, so every pin counts less its own mean over the contacts
of a folder.
"""

from dataclasses import dataclass, replace

import numpy as np

from jaxunshear.calibration.pin_statistics import subtract_mean
from jaxunshear.files import Json
from jaxunshear.style import STYLE, encode_png
from jaxunshear.text_table import format_text_table

KINDS = {"tap": True, "slide": False}
MOTIONS = ("recorded", "simulated", "ceiling")  # fields of ComparedFolder
COLUMNS = ("contacts of", "contacts", "r2", "ceiling_r2", "residual_px", "residual_mm", "motion_px")
DOT = 22  # points squared


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


def _compute_rms(vectors: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Compute the root mean squared length of vectors (..., 2), without NaN."""
    return np.sqrt(np.nanmean(np.sum(vectors**2, axis=-1), axis=axis))


def build_rows(folders: list[ComparedFolder]) -> list[Json]:
    """Score taps and slides over all folders, in full and by ring."""
    rows = []
    for kind, parts in _split_by_kind(folders).items():
        counts = [len(part.recorded) for part in parts]
        vectors: dict[str, np.ndarray] = {}
        for motion in MOTIONS:
            arrays = [getattr(part, motion).reshape(-1, 2) for part in parts]
            vectors[motion] = np.concatenate(arrays)
        for name in ("mm_per_px", "ring"):
            of_pins = [getattr(part, name) for part in parts]
            vectors[name] = np.concatenate([*map(np.tile, of_pins, counts)])
        rows += _score(kind, vectors, sum(counts))
        for ring in np.unique(vectors["ring"]):
            inside = {name: value[vectors["ring"] == ring] for name, value in vectors.items()}
            rows += _score(f"{kind}.ring.{ring}", inside, sum(counts))
    return rows


def _split_by_kind(folders: list[ComparedFolder]) -> dict[str, list[ComparedFolder]]:
    """Split taps from slides; kinds and folders without contacts are left out."""
    kinds: dict[str, list[ComparedFolder]] = {}
    for kind, is_tap in KINDS.items():
        for folder in folders:
            rows = np.flatnonzero(folder.taps == is_tap)
            if len(rows):
                kinds.setdefault(kind, []).append(folder.select_contacts(rows))
    return kinds


def _score(name: str, vectors: dict[str, np.ndarray], contacts: int) -> list[Json]:
    """Score vectors (K, 2) of MOTIONS, with their scale `mm_per_px` (K,)."""
    recorded, simulated = vectors["recorded"], vectors["simulated"]
    residual = recorded - simulated
    scores = [
        ("r2", "1", compute_r2(recorded, simulated)),
        ("residual_px", "px", float(_compute_rms(residual))),
        ("residual_mm", "mm", float(_compute_rms(residual * vectors["mm_per_px"][:, None]))),
        ("motion_px", "px", float(_compute_rms(recorded))),
        ("ceiling_r2", "1", compute_r2(recorded, vectors["ceiling"])),
    ]
    return [
        {"name": f"{measure}.{name}", "unit": unit, "value": value, "contacts": contacts}
        for measure, unit, value in scores
    ]


def format_table(rows: list[Json]) -> str:
    """Format a line for taps, slides and each ring of them."""
    lines: dict[str, Json] = {}
    for row in rows:
        measure, _, part = row["name"].partition(".")
        line = lines.setdefault(part, {"contacts of": part, "contacts": row["contacts"]})
        line[measure] = row["value"]
    return format_text_table(list(lines.values()), COLUMNS)


def draw_folders(folders: list[ComparedFolder]) -> bytes:
    """Draw a PNG of recorded motion and of the simulator's error, pin by pin."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    by_kind = _split_by_kind(folders)
    with rc_context(STYLE):
        figure = Figure(figsize=(9, 4.2 * len(by_kind)), layout="constrained", dpi=110)
        panels = figure.subplots(len(by_kind), 2, squeeze=False)
        for row, (kind, parts) in zip(panels, by_kind.items(), strict=True):
            titles = (f"{kind}s: recorded motion, each pin less its mean", f"{kind}s: left over")
            for axes, title in zip(row, titles, strict=True):
                axes.set(xticks=[], yticks=[], aspect="equal", title=title)
                axes.set_axis_off()
            most = max(float(np.nanmax(_compute_rms(part.recorded, axis=0))) for part in parts)
            for part in parts:
                for axes, motion in zip(row, (0, part.simulated), strict=True):
                    rms = _compute_rms(part.recorded - motion, axis=0)
                    heat = axes.scatter(*part.rest.T, c=rms, s=DOT, vmin=0, vmax=most)
            figure.colorbar(heat, ax=list(row), label="px of 128, rms over contacts", shrink=0.8)
        return encode_png(figure)
