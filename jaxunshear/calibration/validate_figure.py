"""Where on the dome the simulator goes wrong: maps of recorded motion and of what is left, pin by pin, of taps and of slides."""

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure

from jaxunshear.calibration.validation import ComparedFolder, compute_r2, compute_rms, split_by_kind
from jaxunshear.config.registry import DISENTANGLED
from jaxunshear.style import COLOURS, FAINT, INK, STYLE, encode_png

PIN = 22  # points squared
AXIS_PX = 4.0  # a line is so many times as long as the residual it stands for


def validate_figure(parts: list[ComparedFolder]) -> bytes:
    """A PNG of compared folders; it shows no recorded image."""
    mine = split_by_kind(parts)
    with rc_context(STYLE):
        figure = Figure(figsize=(13, 4.2 * len(mine)), layout="constrained", dpi=110)
        panels = figure.subplots(len(mine), 3, squeeze=False, width_ratios=(1, 1, 0.9))
        for row, (kind, chosen) in zip(panels, mine.items(), strict=True):
            most = max(float(np.nanmax(compute_rms(part.recorded, axis=0))) for part in chosen)
            for part in chosen:
                heat = _map(row[0], part, compute_rms(part.recorded, axis=0), most)
                _map(row[1], part, compute_rms(part.recorded - part.simulated, axis=0), most)
                _draw_residual_axes(row[1], part)
            figure.colorbar(
                heat, ax=list(row[:2]), label="px of 128, rms over contacts", shrink=0.8
            )
            row[0].set_title(f"{kind}s: recorded motion, each pin less its mean")
            row[1].set_title(f"{kind}s: left over; lines: its main direction, x {AXIS_PX:g}")
            _rings(row[2], kind, chosen)
        return encode_png(figure)


def _map(axes: Axes, part: ComparedFolder, values: np.ndarray, most: float) -> PathCollection:
    axes.set(xticks=[], yticks=[], aspect="equal")
    axes.grid(False)
    for side in axes.spines.values():
        side.set_visible(False)
    x, y = part.rest.T
    return axes.scatter(x, y, c=values, s=PIN, cmap="viridis", vmin=0, vmax=most)


def _draw_residual_axes(axes: Axes, part: ComparedFolder) -> None:
    off = np.nan_to_num(part.recorded - part.simulated)
    spread = np.einsum("npi,npj->pij", off, off) / max(1, len(off))
    size, direction = np.linalg.eigh(spread)
    half = 0.5 * AXIS_PX * np.sqrt(np.maximum(size[:, 1], 0))[:, None] * direction[..., 1]
    axes.add_collection(
        LineCollection(
            list(np.stack([part.rest - half, part.rest + half], 1)), colors=INK, linewidths=0.7
        )
    )


def _rings(axes: Axes, kind: str, parts: list[ComparedFolder]) -> None:
    shells = np.unique(parts[0].shell)
    for label, field, colour in (
        ("simulated", "simulated", COLOURS[DISENTANGLED]),
        ("regression from labels", "ceiling", FAINT),
    ):
        scores = [
            compute_r2(
                np.concatenate([part.ring(shell).recorded.ravel() for part in parts]),
                np.concatenate([getattr(part.ring(shell), field).ravel() for part in parts]),
            )
            for shell in shells
        ]
        axes.plot(shells, scores, "o-", markersize=3, color=colour, label=label)
    axes.set(
        xlabel="ring (0: apex)",
        title=f"{kind}s: share of the motion explained, R2",
        ylim=(min(0.0, *scores), 1),
    )
    axes.legend(loc="lower left")
