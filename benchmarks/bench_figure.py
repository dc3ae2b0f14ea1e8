"""The work-precision diagram of `python -m benchmarks sim`: how far off against how long, a panel for slides and one for taps."""

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
MARKS = "os^Dv<>PX*"


def plot_work_precision(rows: Sequence[Json]) -> bytes:
    """PNG. Rows without an error to show (the reference itself) and rows that crashed are left out; failures are named below."""
    kinds = [kind for kind in KINDS if any(row["kind"] == kind for row in rows)]
    with rc_context(STYLE):
        figure = Figure(figsize=(6.4 * len(kinds), 6.4), layout="constrained", dpi=130)
        panels = figure.subplots(1, len(kinds), squeeze=False)[0]
        for axes, kind in zip(panels, kinds, strict=True):
            _panel(axes, [row for row in rows if row["kind"] == kind])
            axes.set_title(f"{kind}s")
        panels[0].set_ylabel("rms pin error (px of 256); bar: up to the 95th percentile")
        return encode_png(figure)


def choose_series(row: Json) -> str:
    """What a point is drawn with: rows that differ in one thing make a line."""
    if row["solver"] != OWN_SOLVER:
        return row["solver"]
    if row["against"] != "reference":
        return f"mesh (against {row['against']})"
    changed = row["name"].partition(", ")[2].split(" ")[0]
    return {"tolerance": "auto: tolerance", "steps": "auto: steps"}.get(
        changed, row["name"].partition(",")[0]
    )


def _panel(axes: Axes, rows: list[Json]) -> None:
    lines: dict[str, list[Json]] = {}
    for row in rows:
        if row.get("rms_px", 0) > 0:
            lines.setdefault(choose_series(row), []).append(row)
    for number, (name, points) in enumerate(lines.items()):
        points.sort(key=lambda row: row["ratio"])
        x, y, top = ([row[field] for row in points] for field in ("ratio", "rms_px", "p95_px"))
        colour, mark = (
            COLOURS[number % len(COLOURS)],
            MARKS[(number + number // len(COLOURS)) % len(MARKS)],
        )
        several = (
            "-"
            if (len(points) > 1 and "auto:" in name) or points[0]["solver"] != OWN_SOLVER
            else ""
        )
        axes.plot(
            x,
            y,
            linestyle=several,
            marker=mark,
            color=colour,
            markersize=6,
            label=name,
            linewidth=1,
        )
        axes.vlines(x, y, np.maximum(top, y), color=colour, linewidth=0.8, alpha=0.5)
        failing = [row for row in points if row["failed"]]
        axes.plot(
            [row["ratio"] for row in failing],
            [row["rms_px"] for row in failing],
            "x",
            color=INK,
            markersize=11,
        )
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="time of a state / time of a 2048 x 2048 float32 matrix product",
    )
    timed = [row["product_ms"] for row in rows if "product_ms" in row]
    if timed:
        product = float(np.median(timed))
        upper = axes.secondary_xaxis(
            "top", functions=(partial(np.multiply, product), lambda ms: np.divide(ms, product))
        )
        upper.set_xlabel("ms a state, here")
    axes.legend(fontsize=LABEL, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3)
    failures = [f"{row['name']}: {row['failed']}" for row in rows if row["failed"]]
    if failures:
        text = "failing (crossed out):\n" + "\n".join(failures)
        axes.text(
            0.01, 0.01, text, transform=axes.transAxes, fontsize=LABEL, color=FAINT, va="bottom"
        )
