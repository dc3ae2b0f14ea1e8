"""Read tables of text as spreadsheets and laboratories write them.

Commas, semicolons or tabs separate cells: whichever the heading has most of, or what a first line
`sep=;` names. Lines above the heading that begin with # are skipped. If commas do not separate
cells, `1,5` is 1.5 as in German or French. Problems are named by file and row. The first line of
the file is row 1, as in spreadsheets and editors.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxunshear.errors import UserError
from jaxunshear.files import NUMBER, explain_no_content

TABLES = ("targets.csv", "targets_images.csv")  # before others in their folder
TABLE_SUFFIXES = {".csv", ".tsv", ".xlsx", ".xls", ".ods"}  # only the first two can be read
DELIMITERS = (",", ";", "\t")
DECIMAL_COMMA = re.compile(NUMBER.replace(r"\.", ","))
THOUSANDS = re.compile(r"[+-]?[1-9][0-9]{0,2}(,[0-9]{3})+")


@dataclass(frozen=True)
class LabelTable:
    """A table of text; rows are known by their number in the file."""

    file: Path
    heading: int  # its row
    columns: tuple[str, ...]
    rows: dict[int, dict[str, str]]  # cells by column
    uneven: dict[int, int]  # rows that do not fit the heading: how many cells they have


class LabelProblem(str):
    """One line on what is wrong with a recording, with the place as data."""

    place: Path
    row: int | None  # of a table

    @classmethod
    def with_place(cls, place: Path, text: str, row: int | None = None) -> LabelProblem:
        """Make a line that begins with the place."""
        return cls.from_line(place, f"{place}{f', row {row}' if row else ''}: {text}", row)

    @classmethod
    def from_line(cls, place: Path, line: str, row: int | None = None) -> LabelProblem:
        """Make a problem of a line that names the place in its own words."""
        # a file's name may consist of bytes that are no text
        printable = line.encode("utf-8", "backslashreplace").decode()
        problem = cls(" ".join(printable.split()))
        problem.place, problem.row = place, row
        return problem


def make_table_error(file: Path, text: str, row: int | None = None) -> UserError:
    """Make the error of a table that cannot be used."""
    return UserError(LabelProblem.with_place(file, text, row))


def format_cell(cell: str) -> str:
    """Format a cell for a message."""
    return ascii(cell[:30]) if cell else "empty"


def list_files(folder: Path) -> Iterator[Path]:
    """List the files of a folder, and links that lead nowhere: these are named when read."""
    for path in folder.iterdir():
        is_broken = path.is_symlink() and not path.exists()
        if not path.name.startswith((".", "~")) and (path.is_file() or is_broken):
            yield path


def list_tables(folder: Path) -> list[Path]:
    """List the tables in a folder, those of TABLES first."""
    tables = [path for path in list_files(folder) if path.suffix.lower() in TABLE_SUFFIXES]
    order = {name: rank for rank, name in enumerate(TABLES)}
    return sorted(tables, key=lambda path: (order.get(path.name, len(order)), path.name))


def read_table(file: Path) -> LabelTable:
    """Read a table. Raises UserError, by file and row, for what is no table of text."""
    lines = _read_lines(file)
    heading = min(lines)
    columns = tuple(lines.pop(heading))
    if value := next((name for name in columns if re.fullmatch(NUMBER, name)), None):
        text = f"has no heading, but {value} in its place: name the columns in the first line"
        raise make_table_error(file, text, heading)
    repeated = next((name for name in columns if name and columns.count(name) > 1), None)
    if repeated is not None:
        text = f"the heading names column {format_cell(repeated)} twice"
        raise make_table_error(file, text, heading)
    width, rows, uneven = len(columns), {}, {}
    for number, cells in lines.items():
        if len(cells) == width:
            rows[number] = dict(zip(columns, cells, strict=True))
        else:
            uneven[number] = len(cells)
    return LabelTable(file, heading, columns, rows, uneven)


def _read_lines(file: Path) -> dict[int, list[str]]:
    """Read the cells of the lines of a table that are not blank: one at least, or UserError."""
    text = list(io.StringIO(_read_text(file), newline=""))
    above, delimiter = 0, ""
    for line in text:
        if named := re.fullmatch(r"sep=(.)\s*", line):
            delimiter = named[1]
        elif line.strip() and not line.startswith("#"):
            break
        above += 1
    lines: dict[int, list[str]] = {}
    number = above + 1
    try:
        delimiter = delimiter or _choose_delimiter(text[above : above + 1])
        reader = csv.reader(text[above:], delimiter=delimiter)
        for cells in reader:
            if any(cell.strip() for cell in cells):
                lines[number] = [cell.strip() for cell in cells]
            number = above + reader.line_num + 1
    except csv.Error as error:
        raise make_table_error(file, f"this is not CSV ({error})", number) from None
    if not lines:
        raise make_table_error(file, "is empty")
    return lines if delimiter == "," else _convert_decimal_commas(lines)


def _read_text(file: Path) -> str:
    try:
        data = file.read_bytes()
    except OSError as error:
        raise make_table_error(file, f"cannot be read ({error.strerror or error})") from None
    if reason := explain_no_content(data):
        raise make_table_error(file, reason)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        remedy = "this is not UTF-8 text: save the table as CSV in UTF-8"
        raise make_table_error(file, remedy, row) from None


def _choose_delimiter(heading: Sequence[str]) -> str:
    """Choose the delimiter that gives a heading the most cells."""
    return max(DELIMITERS, key=lambda each: sum(map(len, csv.reader(heading, delimiter=each))))


def _convert_decimal_commas(lines: dict[int, list[str]]) -> dict[int, list[str]]:
    """Write `1,5` as 1.5 unless numbers have points, too, or all commas may be of thousands."""
    cells = [cell for line in lines.values() for cell in line]
    commas = [cell for cell in cells if "," in cell and DECIMAL_COMMA.fullmatch(cell)]
    has_points = any("." in cell and re.fullmatch(NUMBER, cell) for cell in cells)
    if has_points or all(map(THOUSANDS.fullmatch, commas)):
        return lines
    points = {cell: cell.replace(",", ".") for cell in commas}
    for line in lines.values():
        line[:] = [points.get(cell, cell) for cell in line]
    return lines
