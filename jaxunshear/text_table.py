"""Text tables, laid out by rich."""

import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from jaxunshear.files import Json

WIDE = 10_000  # columns of a file or a pipe, so that no line is broken


def format_text_table(rows: Sequence[Json], columns: Sequence[str]) -> str:
    """Format a heading and a line per row: numbers to three digits, `-` for missing values.

    A terminal folds cells that do not fit; in a file or a pipe a row is one line without colours.
    """
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for index, name in enumerate(columns):
        table.add_column(name, justify="right" if index else "left", overflow="fold")
    for row in rows:
        table.add_row(*(_format_cell(row.get(name)) for name in columns))
    terminal = sys.stdout.isatty()
    width = None if terminal else WIDE
    console = Console(width=width, force_terminal=terminal, markup=False, emoji=False)
    with console.capture() as text:
        console.print(table)
    return text.get().removesuffix("\n")


def _format_cell(value: object) -> str:
    if value is None:
        return "-"
    return format_plain(value) if isinstance(value, float) else str(value)


def format_plain(value: float) -> str:
    """Format a number to three digits, and a larger one to its last digit before the point."""
    text = f"{value:.3g}"
    return f"{value:.0f}" if "e+" in text else text


def format_operations(operations: float) -> str:
    """Format a number of operations with a prefix, such as 1.23 G; a dash stands for none."""
    if not operations:
        return "\N{EN DASH}"
    for factor, prefix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if operations >= factor:
            return f"{format_plain(operations / factor)}{prefix}"
    return format_plain(operations)
