"""Write results as rows for machines: a name, a value, a unit, and a bar. Imports no JAX."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from jaxunshear.config.networks import DISENTANGLED, ENTANGLED
from jaxunshear.results.measurement import Measured, Measurement
from jaxunshear.results.run import CodeSwapScore, ResultBar, Results, Tables

BARS = {  # that the demo should clear, on held-out poses
    "ms_ssim.disentangled.overall": ResultBar(">=", 0.90),
    "ms_ssim.sheared.overall": ResultBar("<=", 0.45),
    "pose_ratio.disentangled.edge_mm": ResultBar("<=", 0.6),
    "pose_ratio.disentangled.edge_deg": ResultBar("<=", 0.6),
}
# The paper's figures, of a real TacTip (Gupta, Aitchison, Lepora: Tactile Image-to-Image
# Disentanglement), with the keys of our results. It does not name its MS-SSIM library.
PAPER = {
    "ms_ssim": {  # Table 1
        "sheared": {"disk": 0.33, "clover": 0.31, "teardrop": 0.33, "overall": 0.32},
        ENTANGLED: {"disk": 0.91, "clover": 0.90, "teardrop": 0.90, "overall": 0.90},
        DISENTANGLED: {"disk": 0.94, "clover": 0.92, "teardrop": 0.92, "overall": 0.93},
    },
    "pose_mae": {  # Table 2; a PoseNet trained on taps
        "tap": {"x_mm": 0.43, "yaw_deg": 2.13},
        "sheared": {"x_mm": 2.72, "yaw_deg": 22.20},
        ENTANGLED: {"x_mm": 0.95, "yaw_deg": 6.73},
        DISENTANGLED: {"x_mm": 0.64, "yaw_deg": 4.38},
    },
    "swap": {  # appendix D; its "SSIM" of 93 % is Table 1's multi-scale figure
        "DC(z_p)": {"mse": 0.023, "ms_ssim": 0.93},
        "DC(z_s)": {"mse": 0.22, "ms_ssim": 0.02},
        "DS(z_p,z_s)": {"mse": 0.002, "ms_ssim": 0.995},
        "DS(z_p,z_p)": {"mse": 0.1, "ms_ssim": 0.11},
    },
}
TABLES = (
    *("ms_ssim", "pose_mae", "pose_ratio", "pose_recovery"),
    *("difference", "swap", "pins", "followed"),
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


def _make_row(name: str, value: float | None, unit: str, metric: str) -> Measurement:
    bar = BARS.get(name)
    if bar is None:
        return Measurement(name, value, unit, None, None, None, metric)
    return Measurement(name, value, unit, bar.bar, bar.sense, bar.is_met(value), metric)


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
