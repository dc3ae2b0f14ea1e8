"""Plots error against run time for `python -m benchmarks sim`, slides and taps in two panels."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.bench_sim import OWN_SOLVER
from jaxunshear.files import Json
from jaxunshear.style import FAINT, INK, LABEL, STYLE, encode_png
from verification.paper import KINDS

COLOURS = ("#1f6feb", "#d9822b", "#2a9d6f", "#8957e5", "#bf3989", "#57606a", "#9a6700")
MARKERS = "os^Dv<>PX*"


def plot_work_precision(rows: Sequence[Json]) -> bytes:
    """Plot rows as a PNG; failures are named below.

    Rows without an error (the reference itself) and rows that crashed are left out.
    """
    present = {row["kind"] for row in rows}
    kinds = [kind for kind in KINDS if kind in present]
    with rc_context(STYLE):
        figure = Figure(figsize=(6.4 * len(kinds), 6.4), layout="constrained", dpi=130)
        panels = figure.subplots(1, len(kinds), squeeze=False)[0]
        for axes, kind in zip(panels, kinds, strict=True):
            _plot_panel(axes, [row for row in rows if row["kind"] == kind])
            axes.set_title(f"{kind}s")
        panels[0].set_ylabel("rms pin error (px of 256); bar: up to the 95th percentile")
        return encode_png(figure)


def choose_series(row: Json) -> str:
    """Choose the line of a row: rows that differ in one setting share a line."""
    if row["solver"] != OWN_SOLVER:
        return row["solver"]
    if row["against"] != "reference":
        return f"mesh (against {row['against']})"
    changed = row["name"].partition(", ")[2].split(" ")[0]
    return {"tolerance": "auto: tolerance", "steps": "auto: steps"}.get(
        changed, row["name"].partition(",")[0]
    )


def _plot_panel(axes: Axes, rows: list[Json]) -> None:
    series: dict[str, list[Json]] = {}
    for row in rows:
        if row.get("rms_px", 0) > 0:
            series.setdefault(choose_series(row), []).append(row)
    for number, (name, points) in enumerate(series.items()):
        _plot_series(axes, number, name, sorted(points, key=lambda row: row["ratio"]))
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="time of a state / time of a 2048 x 2048 float32 matrix product",
    )
    product_ms = [row["product_ms"] for row in rows if "product_ms" in row]
    if product_ms:
        factor = float(np.median(product_ms))
        to_ms, to_ratio = partial(np.multiply, factor), lambda ms: np.divide(ms, factor)
        axes.secondary_xaxis("top", functions=(to_ms, to_ratio)).set_xlabel("ms a state, here")
    axes.legend(fontsize=LABEL, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3)
    failures = [f"{row['name']}: {row['failed']}" for row in rows if row["failed"]]
    if failures:
        text = "failing (crossed out):\n" + "\n".join(failures)
        axes.text(
            0.01, 0.01, text, transform=axes.transAxes, fontsize=LABEL, color=FAINT, va="bottom"
        )


def _plot_series(axes: Axes, number: int, name: str, points: list[Json]) -> None:
    ratios = [row["ratio"] for row in points]
    errors = [row["rms_px"] for row in points]
    colour = COLOURS[number % len(COLOURS)]
    is_other_solver = points[0]["solver"] != OWN_SOLVER
    has_line = is_other_solver or (len(points) > 1 and "auto:" in name)
    axes.plot(
        ratios,
        errors,
        linestyle="-" if has_line else "",
        marker=MARKERS[(number + number // len(COLOURS)) % len(MARKERS)],
        color=colour,
        markersize=6,
        label=name,
        linewidth=1,
    )
    top = np.maximum([row["p95_px"] for row in points], errors)
    axes.vlines(ratios, errors, top, color=colour, linewidth=0.8, alpha=0.5)
    failed = [row for row in points if row["failed"]]
    failed_ratios = [row["ratio"] for row in failed]
    axes.plot(failed_ratios, [row["rms_px"] for row in failed], "x", color=INK, markersize=11)
