"""Rows of figures as plain text."""

from collections.abc import Sequence

from jaxunshear.storage import Json


def plain_table(rows: Sequence[Json], columns: Sequence[str]) -> str:
    """A heading, then a line a row: numbers to three digits, `-` for what a row does not have."""
    cells = [list(columns)] + [[_text(row.get(name)) for name in columns] for row in rows]
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    return "\n".join(
        "  ".join([line[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(line[1:], widths[1:], strict=True))])
        for line in cells
    )


def _text(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
