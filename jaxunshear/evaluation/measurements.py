"""Results as rows for machines: a name, a value, a unit, and the bar it should clear. Imports no JAX."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from jaxunshear.files import Json
from jaxunshear.results.measurement import Measured, Measurement
from jaxunshear.results.run import CodeSwapScore, Results, Table
from jaxunshear.serialization import to_builtins

BARS: dict[str, tuple[str, float]] = {  # of the demo, on held-out poses
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
    """The rows of a run's results, with the machine and the versions they were measured on and with."""
    rows = []
    for prefix, found, names in (
        ("", results, (*TABLES, "pin_error", "half_width", "coverage")),
        *((f"{test}.", further, TABLES) for test, further in results.tests.items()),
    ):
        for name in names:
            rows += _rows(getattr(found, name, None), name, results.metric.get(name, name), prefix)
        if found.pose_smooth:
            rows += _rows(
                found.pose_smooth.pose_mae, "pose_smooth", results.metric["pose_smooth"], prefix
            )
        for reader, kinds in found.readers.items():
            rows += _rows(kinds, reader, results.metric["readers"], f"{prefix}readers.")
    for network, times in results.ms_per_image.items():
        rows.append(
            _row(f"ms_per_image.{network}", times["median"], "ms", "median of one image at a time")
        )
    rows += [
        _row(f"time_s.{stage}", seconds, "s", "wall clock")
        for stage, seconds in results.time_s.items()
    ]
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


def _rows(
    kinds: Table | Mapping[str, CodeSwapScore] | None, table: str, metric: str | int, prefix: str
) -> list[Measurement]:
    return [
        _row(f"{prefix}{table}.{kind}.{column}", value, _unit(table, column), str(metric))
        for kind, columns in (kinds or {}).items()
        for column, value in (
            vars(columns) if isinstance(columns, CodeSwapScore) else columns
        ).items()
        if not isinstance(value, str)
    ]


def select_reproducible(results: Results) -> Json:
    """What must come out equal, bit for bit, from the same experiment on the same machine: all but times and places."""
    places = ("time_s", "ms_per_image", "machine", "trained_on", "source", "trained_by", "command")
    return {name: value for name, value in to_builtins(results).items() if name not in places}


def _row(name: str, value: float | None, unit: str, metric: str) -> Measurement:
    sense, bar = BARS.get(name, (None, None))
    ok = None
    if bar is not None:
        ok = value is not None and (value >= bar if sense == ">=" else value <= bar)
    return Measurement(name, value, unit, bar, sense, ok, metric)


def _unit(table: str, column: str) -> str:
    if table in ("pose_ratio", "pose_recovery", "coverage"):
        return "1"
    return next((unit for ending, unit in UNITS.items() if column.endswith(ending)), "1")


def round_values(value: Any) -> Any:
    """Six significant digits are more than any figure here deserves; what is not finite is null, as in the file."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.replace(value, **round_values(vars(value)))
    if isinstance(value, dict):
        return {name: round_values(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [round_values(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
