"""Results as rows for machines: a name, a value, a unit, and the bar it should clear. Imports no JAX."""

import math
from typing import Any

BARS: dict[str, tuple[str, float]] = {  # of the demo, on held-out poses
    "ms_ssim.disentangled.overall": (">=", 0.90),
    "ms_ssim.sheared.overall": ("<=", 0.45),
    "pose_ratio.disentangled.edge_mm": ("<=", 0.6),
    "pose_ratio.disentangled.edge_deg": ("<=", 0.6),
}
TABLES = ("ms_ssim", "pose_mae", "pose_ratio", "pose_recovery", "difference", "swap", "pins", "followed")
UNITS = {"_mm": "mm", "_deg": "deg", "_px": "px", "_per_image": "pins/image"}


def measurements(results: dict[str, Any]) -> dict[str, Any]:
    """The rows of a results dict, with the machine and the versions they were measured on and with.

    A row: `name` (the path in results.json, joined by dots), `value` (null where there is none), `unit` ("1" for plain
    numbers), `bar` and its `sense` (">=" or "<="), `ok` (null where no bar is set), and `metric`, the exact quantity.
    """
    rows = []
    for table in (*TABLES, "pin_error", "half_width", "coverage"):
        rows += _rows(results, table, results["metric"], "")
    rows += _of_readers(results, results["metric"], "")
    for test, further in results["tests"].items():
        for table in TABLES:
            rows += _rows(further, table, results["metric"], f"{test}.")
        rows += _of_readers(further, results["metric"], f"{test}.")
    for network, times in results["ms_per_image"].items():
        rows.append(_row(f"ms_per_image.{network}", times["median"], "ms", "median of one image at a time"))
    rows += [_row(f"time_s.{stage}", seconds, "s", "wall clock") for stage, seconds in results["time_s"].items()]
    return {"rows": rows, "machine": results["machine"], "versions": results["versions"]}


def _rows(results: dict[str, Any], table: str, metrics: dict[str, Any], prefix: str) -> list[dict[str, Any]]:
    metric = metrics.get(table, table)
    return [
        _row(f"{prefix}{table}.{kind}.{column}", value, _unit(table, column), metric)
        for kind, columns in results.get(table, {}).items()
        for column, value in columns.items()
        if not isinstance(value, str)
    ]


def _of_readers(results: dict[str, Any], metrics: dict[str, Any], prefix: str) -> list[dict[str, Any]]:
    """`readers.<reader>.<kind>.<column>`; none of runs evaluated by an earlier version."""
    return [
        row
        for reader, kinds in results.get("readers", {}).items()
        for row in _rows({reader: kinds}, reader, {reader: metrics["readers"]}, f"{prefix}readers.")
    ]


def reproducible(results: dict[str, Any]) -> dict[str, Any]:
    """What must come out equal, bit for bit, from the same experiment on the same machine: all but times and places."""
    places = ("time_s", "ms_per_image", "machine", "trained_on", "command")
    return {name: value for name, value in results.items() if name not in places}


def _row(name: str, value: float | None, unit: str, metric: str) -> dict[str, Any]:
    sense, bar = BARS.get(name, (None, None))
    ok = None
    if bar is not None:
        ok = value is not None and (value >= bar if sense == ">=" else value <= bar)
    return {"name": name, "value": value, "unit": unit, "bar": bar, "sense": sense, "ok": ok, "metric": metric}


def _unit(table: str, column: str) -> str:
    if table in ("pose_ratio", "pose_recovery", "coverage"):
        return "1"
    return next((unit for ending, unit in UNITS.items() if column.endswith(ending)), "1")


def rounded(value: Any) -> Any:
    """Six significant digits are more than any figure here deserves; what is not finite is null, as in the file."""
    if isinstance(value, dict):
        return {name: rounded(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
