"""Rows of a verification: a problem, its closed form, what was measured, and the bar."""

import itertools
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from jaxunshear.files import Json
from jaxunshear.text_table import format_text_table


@dataclass(frozen=True)
class Row:
    """One comparison, which informs without a `bar`; with one it must hold.

    Then `order`, that of convergence, must also reach `least_order`. `error` and `bar` are relative
    to the closed form or, where that is zero, to what `problem` names; or they are lengths in px.
    """

    group: str
    problem: str
    closed_form: float | None
    measured: float
    error: float
    bar: float | None = None
    order: float | None = None
    least_order: float | None = None
    settled: bool = True  # every increment was solved below its tolerance
    note: str = ""
    px: bool = False  # `error` and `bar` are in px

    @property
    def holds(self) -> bool:
        """Whether the row holds, written so that a NaN does not."""
        if self.bar is None:
            return True
        enough = self.least_order is None or (
            self.order is not None and self.order >= self.least_order
        )
        return bool(abs(self.error) <= self.bar and enough and self.settled)


class Rows(list[Row]):
    """Rows of a group whose increments were solved below their tolerance if `settled`."""

    def __init__(self, group: str, settled: bool = True) -> None:
        super().__init__()
        self.group, self.settled = group, settled

    def compare(
        self,
        problem: str,
        closed_form: float,
        measured: float,
        bar: float | None = None,
        **more: Any,
    ) -> None:
        """Add a row against a closed form other than zero; `more` are further fields of `Row`."""
        error = float(measured / closed_form - 1)
        fields = {"settled": self.settled} | more
        row = Row(self.group, problem, float(closed_form), float(measured), error, bar, **fields)
        self.append(row)

    def expect_zero(
        self, problem: str, measured: float, scale: float, bar: float | None = None, **more: Any
    ) -> None:
        """Add a row of what should be zero, judged against `scale`."""
        fields = {"settled": self.settled} | more
        error = float(measured / scale)
        self.append(Row(self.group, problem, 0.0, float(measured), error, bar, **fields))


def fit_order(sizes: Iterable[float], errors: Iterable[float]) -> float:
    """Fit the exponent p of |error| ~ size^p, by least squares over at least three sizes.

    It is NaN if an error is zero or not finite.
    """
    x, y = np.asarray(list(sizes), float), np.abs(np.asarray(list(errors), float))
    if len(x) < 3 or not (np.isfinite(y).all() and (y > 0).all()):
        return float("nan")
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def convert_row(row: Row) -> Json:
    """Convert a row to a flat one, for a file of results."""
    return {**asdict(row), "holds": row.holds}


def format_rows(rows: Iterable[Row]) -> str:
    """Format rows as a table for each group.

    Rows with a bar are `ok` or `MISSED`; a row without one is `info`.
    """
    tables = []
    for group, members in itertools.groupby(rows, key=lambda row: row.group):
        lines = [_format_cells(row) for row in members]
        tables.append(f"{group}\n{format_text_table(lines, tuple(lines[0]))}")
    return "\n\n".join(tables)


def _format_cells(row: Row) -> Json:
    verdict = "info" if row.bar is None else "ok" if row.holds else "MISSED"
    if not row.settled:
        verdict += ", not converged"
    unit, factor = ("px", 1.0) if row.px else ("%", 100.0)
    return {
        "problem": row.problem,
        "closed form": row.closed_form,
        "measured": row.measured,
        "error": f"{factor * row.error:.3g} {unit}",
        "allowed": "-" if row.bar is None else f"{factor * row.bar:.3g} {unit}",
        "order": row.order,
        "at least": row.least_order,
        "verdict": verdict,
        "note": row.note,
    }
