"""Write results as rows for machines: a name, a value, a unit, and a bar. Imports no JAX."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from jaxunshear.files import Json, to_builtins
from jaxunshear.results.measurement import Measured, Measurement
from jaxunshear.results.run import CodeSwapScore, Results, Tables

BARS: dict[str, tuple[str, float]] = {  # that the demo should clear, on held-out poses
    "ms_ssim.disentangled.overall": (">=", 0.90),
    "ms_ssim.sheared.overall": ("<=", 0.45),
    "pose_ratio.disentangled.edge_mm": ("<=", 0.6),
    "pose_ratio.disentangled.edge_deg": ("<=", 0.6),
}
TABLES = (
    "ms_ssim",
    "pose_mae",
    "pose_ratio",
    "pose_recovery",
    "difference",
    "swap",
    "pins",
    "followed",
)
UNITS = {"_mm": "mm", "_deg": "deg", "_px": "px", "_per_image": "pins/image"}


def build_measurements(results: Results) -> Measured:
    """Build the rows of a run's results, with the machine and the versions they come from."""
    rows = _build_test_rows(results, (*TABLES, "pin_error", "half_width", "coverage"), results, "")
    for test, further in results.tests.items():
        rows += _build_test_rows(further, TABLES, results, f"{test}.")
    note = "median of one image at a time"
    for network, times in results.ms_per_image.items():
        rows.append(_make_row(f"ms_per_image.{network}", times["median"], "ms", note))
    for stage, seconds in results.time_s.items():
        rows.append(_make_row(f"time_s.{stage}", seconds, "s", "wall clock"))
    return Measured(
        rows,
        results.machine,
        results.versions,
        results.source,
        results.trained_on,
        results.trained_by,
        command=results.command,
        test_data=results.test_data,
    )


def _build_test_rows(
    tables: Tables, names: Sequence[str], results: Results, prefix: str
) -> list[Measurement]:
    """Build the rows of one test: those of the tables `names`, and of other pose estimators."""
    named = [(name, getattr(tables, name, None), name) for name in names]
    if tables.pose_smooth:
        named.append(("pose_smooth", tables.pose_smooth.pose_mae, "pose_smooth"))
    named += [(f"readers.{name}", table, "readers") for name, table in tables.readers.items()]
    rows = []
    for name, table, note in named:
        metric = str(results.metric.get(note, note))
        for kind, columns in (table or {}).items():
            values = vars(columns) if isinstance(columns, CodeSwapScore) else columns
            for column, value in values.items():
                if not isinstance(value, str):
                    unit = _find_unit(name, column)
                    rows.append(_make_row(f"{prefix}{name}.{kind}.{column}", value, unit, metric))
    return rows


def select_reproducible(results: Results) -> Json:
    """Select what the same experiment on the same machine gives bit for bit.

    That is all but times and places.
    """
    places = ("time_s", "ms_per_image", "machine", "trained_on", "source", "trained_by", "command")
    return {name: value for name, value in to_builtins(results).items() if name not in places}


def _make_row(name: str, value: float | None, unit: str, metric: str) -> Measurement:
    sense, bar = BARS.get(name, (None, None))
    ok = None
    if bar is not None:
        ok = value is not None and (value >= bar if sense == ">=" else value <= bar)
    return Measurement(name, value, unit, bar, sense, ok, metric)


def _find_unit(table: str, column: str) -> str:
    if table in ("pose_ratio", "pose_recovery", "coverage"):
        return "1"
    return next((unit for ending, unit in UNITS.items() if column.endswith(ending)), "1")


def round_values(value: Any) -> Any:
    """Round all numbers to six significant digits; None stands for those that are not finite."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.replace(value, **round_values(vars(value)))
    if isinstance(value, dict):
        return {name: round_values(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [round_values(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
