"""What tables take from docs/results, and how they print it."""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from statistics import fmean
from typing import Any

from docs.provenance import read_result
from jaxunshear.files import Json
from jaxunshear.results.record_files import convert_record
from jaxunshear.results.sweep import CellResult, Figure, Figures, SweepResult

USED: list[str] = []  # results that were loaded since it was emptied
KINDS = {  # what a pose is predicted from, or an image compared with
    "tap": "tap",
    "sheared": "sheared",
    "translated": "sheared, best translation",
    "mean_tap": "mean training tap",
    "nearest_tap": "nearest training tap",
    "entangled": "entangled",
    "entangled_large": "entangled, as many parameters",
    "unet": "U-Net",
    "disentangled": "disentangled",
    "sheared_learnt": "PoseNet that learnt slides",
}
TARGETS = {"x_mm": 2, "yaw_deg": 1, "edge_mm": 2, "edge_deg": 1}  # of simulated poses, with digits
EDGE_TARGETS = {"edge_mm": 2, "edge_deg": 1}


def load_result(name: str) -> Json:
    """Return docs/results/<name>.json."""
    USED.append(name)
    return read_result(name)


def load_cells(name: str) -> Sequence[CellResult]:
    """Return the cells of a sweep."""
    load_result(name)
    return _convert_sweep(name).cells


@cache
def _convert_sweep(name: str) -> SweepResult:
    return convert_record(read_result(name), SweepResult, f"{name}.json", "make it again")


def load_runs(name: str, label_start: str = "") -> list[dict[str, Json]]:
    """Return the rows by name of the runs in a file whose label begins with `label_start`."""
    runs = load_result(name)["runs"]
    return [
        _index_rows(run["rows"]) for label, run in runs.items() if label.startswith(label_start)
    ]


def load_rows(name: str) -> dict[str, dict[str, Any]]:
    """Return the rows of a file by their names."""
    return _index_rows(load_result(name)["rows"])


def _index_rows(rows: list[Json]) -> dict[str, Json]:
    return {row["name"]: row for row in rows}


def load_locked_scores(name: str) -> dict[str, float]:
    """Return scores by name that others made on recordings that are not here."""
    return {row["name"]: row["value"] for row in load_result(f"locked/{name}")["rows"]}


def start_table(header: str) -> list[str]:
    """Return the first two lines of a table."""
    return [header, "|---" * (header.count("|") - 1) + "|"]


def format_line(name: str, cells: Iterable[str]) -> str:
    """Format a line of a table."""
    return f"| {name} | {' | '.join(cells)} |"


def tabulate_rows(header: str, rows: Iterable[Json], label: str, *templates: str) -> str:
    """Tabulate rows: the label and the cells are templates of their fields."""
    lines = start_table(header)
    for row in rows:
        cells = [template.format(**row) for template in templates]
        lines.append(format_line(label.format(**row), cells))
    return "\n".join(lines)


def format_interval(figure: Figure, digits: int) -> str:
    """Format a mean with its interval."""
    low, high = figure.interval
    return f"{figure.mean:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def format_figures(figures: Figures, columns: Mapping[str, int], prefix: str = "") -> list[str]:
    """Format figures by name, each with so many digits and its interval."""
    return [format_interval(figures[prefix + name], digits) for name, digits in columns.items()]


def format_range(values: Sequence[float], digits: int) -> str:
    """Format a mean with the least and the largest value; one value alone."""
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    return f"{fmean(values):.{digits}f} [{min(values):.{digits}f}, {max(values):.{digits}f}]"


def format_seeds(figure: Figure, digits: int = 2) -> str:
    """Format the mean of the seeds with the least and the largest one."""
    return format_range(list(figure.per_seed.values()), digits)


def format_ratio(error: Figure, reference: Figure) -> str:
    """Format the ratio of two errors, by seed."""
    ratios = [error.per_seed[seed] / other for seed, other in reference.per_seed.items()]
    return format_range(ratios, 2)
