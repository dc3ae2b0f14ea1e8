"""Rows of figures as text, laid out by rich."""

import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from jaxunshear.files import Json

WIDE = 10_000  # columns where nobody watches: lines of a file or a pipe are never broken


def format_text_table(rows: Sequence[Json], columns: Sequence[str]) -> str:
    """A heading, then a line a row: numbers to three digits, `-` for what a row does not have.

    In a terminal cells that do not fit are folded; elsewhere a row is one line, without colours or frames.
    """
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for place, name in enumerate(columns):
        table.add_column(name, justify="right" if place else "left", overflow="fold")
    for row in rows:
        table.add_row(*(_text(row.get(name)) for name in columns))
    seen = sys.stdout.isatty()
    console = Console(width=None if seen else WIDE, force_terminal=seen, markup=False, emoji=False)
    with console.capture() as text:
        console.print(table)
    return text.get().removesuffix("\n")


def _text(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
