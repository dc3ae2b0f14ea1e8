"""Maps of recorded motion and of the simulator's error on the dome, pin by pin."""

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure

from jaxunshear.calibration.validation import ComparedFolder, compute_r2, compute_rms, split_by_kind
from jaxunshear.config.registry import DISENTANGLED
from jaxunshear.style import COLOURS, FAINT, INK, STYLE, encode_png

PIN = 22  # points squared
AXIS_PX = 4.0  # length of a line over the residual that it shows


def validate_figure(folders: list[ComparedFolder]) -> bytes:
    """Draw a PNG of compared folders; it shows no recorded image."""
    by_kind = split_by_kind(folders)
    with rc_context(STYLE):
        figure = Figure(figsize=(13, 4.2 * len(by_kind)), layout="constrained", dpi=110)
        panels = figure.subplots(len(by_kind), 3, squeeze=False, width_ratios=(1, 1, 0.9))
        for row, (kind, parts) in zip(panels, by_kind.items(), strict=True):
            most = max(float(np.nanmax(compute_rms(part.recorded, axis=0))) for part in parts)
            for part in parts:
                heat = _draw_map(row[0], part, compute_rms(part.recorded, axis=0), most)
                residual = part.recorded - part.simulated
                _draw_map(row[1], part, compute_rms(residual, axis=0), most)
                _draw_residual_axes(row[1], part)
            figure.colorbar(
                heat, ax=list(row[:2]), label="px of 128, rms over contacts", shrink=0.8
            )
            row[0].set_title(f"{kind}s: recorded motion, each pin less its mean")
            row[1].set_title(f"{kind}s: left over; lines: its main direction, x {AXIS_PX:g}")
            _plot_rings(row[2], kind, parts)
        return encode_png(figure)


def _draw_map(axes: Axes, part: ComparedFolder, values: np.ndarray, most: float) -> PathCollection:
    axes.set(xticks=[], yticks=[], aspect="equal")
    axes.grid(False)
    for side in axes.spines.values():
        side.set_visible(False)
    x, y = part.rest.T
    return axes.scatter(x, y, c=values, s=PIN, cmap="viridis", vmin=0, vmax=most)


def _draw_residual_axes(axes: Axes, part: ComparedFolder) -> None:
    residual = np.nan_to_num(part.recorded - part.simulated)
    spread = np.einsum("npi,npj->pij", residual, residual) / max(1, len(residual))
    size, direction = np.linalg.eigh(spread)
    half = 0.5 * AXIS_PX * np.sqrt(np.maximum(size[:, 1], 0))[:, None] * direction[..., 1]
    lines = list(np.stack([part.rest - half, part.rest + half], 1))
    axes.add_collection(LineCollection(lines, colors=INK, linewidths=0.7))


def _plot_rings(axes: Axes, kind: str, parts: list[ComparedFolder]) -> None:
    rings = np.unique(parts[0].ring)
    for label, field, colour in (
        ("simulated", "simulated", COLOURS[DISENTANGLED]),
        ("regression from labels", "ceiling", FAINT),
    ):
        scores = []
        for ring in rings:
            pins = [part.select_ring(ring) for part in parts]
            recorded = np.concatenate([part.recorded.ravel() for part in pins])
            predicted = np.concatenate([getattr(part, field).ravel() for part in pins])
            scores.append(compute_r2(recorded, predicted))
        axes.plot(rings, scores, "o-", markersize=3, color=colour, label=label)
    axes.set(
        xlabel="ring (0: apex)",
        title=f"{kind}s: share of the motion explained, R2",
        ylim=(min(0.0, *scores), 1),
    )
    axes.legend(loc="lower left")
