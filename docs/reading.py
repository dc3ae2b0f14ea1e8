"""What tables take from docs/results, and how they print it."""

from collections.abc import Sequence
from functools import cache
from statistics import fmean
from typing import Any

from docs.provenance import read_result
from jaxunshear.files import Json
from jaxunshear.results.record_files import convert_record
from jaxunshear.results.sweep import CellResult, Figure, SweepResult

USED: list[str] = []  # results that were taken since it was emptied


def take(name: str) -> Json:
    """Return docs/results/<name>.json."""
    USED.append(name)
    return read_result(name)


def swept(name: str) -> Sequence[CellResult]:
    """Return the cells of a sweep."""
    take(name)
    return _sweep(name).cells


@cache
def _sweep(name: str) -> SweepResult:
    return convert_record(read_result(name), SweepResult, f"{name}.json", "make it again")


def runs_of(name: str, begins: str = "") -> list[dict[str, Json]]:
    """Return the rows by name of each run in a file of several, of those whose label begins so."""
    runs = take(name)["runs"]
    return [
        {row["name"]: row for row in run["rows"]}
        for label, run in runs.items()
        if label.startswith(begins)
    ]


def by_name(name: str) -> dict[str, dict[str, Any]]:
    """Return the rows of a file by their names."""
    return {row["name"]: row for row in take(name)["rows"]}


def as_line(name: str, cells: Sequence[str]) -> str:
    """Return a line of a table."""
    return f"| {name} | {' | '.join(cells)} |"


def with_interval(metric: Figure, digits: int) -> str:
    """Print a mean with its interval."""
    low, high = metric.interval
    return f"{metric.mean:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def with_range(values: Sequence[float], digits: int) -> str:
    """Print a mean with the least and the most."""
    return f"{fmean(values):.{digits}f} [{min(values):.{digits}f}, {max(values):.{digits}f}]"
