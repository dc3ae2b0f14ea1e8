"""Rows of a verification: a problem, its closed form, what was measured, and the bar."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from jaxunshear.files import Json

WIDTH = 76  # of the problems' column


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


def make_comparison_row(
    group: str,
    problem: str,
    closed_form: float,
    measured: float,
    bar: float | None = None,
    **more: Any,
) -> Row:
    """Make a row against a closed form other than zero; `more` are further fields of `Row`."""
    error = float(measured / closed_form - 1)
    return Row(group, problem, float(closed_form), float(measured), error, bar, **more)


def make_zero_row(
    group: str, problem: str, measured: float, scale: float, bar: float | None = None, **more: Any
) -> Row:
    """Make a row of what should be zero, judged against `scale`."""
    return Row(group, problem, 0.0, float(measured), float(measured / scale), bar, **more)


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
    """Format rows as plain text, with a heading for each group.

    Rows with a bar are `ok` or `MISSED`; a row without one is `info`.
    """
    lines, group = [], None
    for row in rows:
        if row.group != group:
            group = row.group
            head = f"{'closed form':>12} {'measured':>12} {'error':>10} {'allowed':>9}  order"
            lines += ["", group, f"  {'':{WIDTH}} {head}"]
        closed = "-" if row.closed_form is None else f"{row.closed_form:.5g}"
        order = "" if row.order is None else f"{row.order:.2f}"
        if row.least_order is not None:
            order += f" (>= {row.least_order:g})"
        verdict = "info" if row.bar is None else "ok" if row.holds else "MISSED"
        if not row.settled:
            verdict += ", not converged"
        error, bar = _format_error(row, row.error), _format_error(row, row.bar)
        lines.append(
            f"  {row.problem:{WIDTH}} {closed:>12} {row.measured:>12.5g} {error:>10}"
            f" {bar:>9}  {order:13} {verdict}" + (f"  ({row.note})" if row.note else "")
        )
    return "\n".join(lines).lstrip("\n")


def _format_error(row: Row, value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.3g} px" if row.px else f"{100 * value:.3g} %"
