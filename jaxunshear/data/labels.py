"""Read the tables beside recorded images: poses, slides and pose numbers by image name.

Problems are named by file and row. A row is counted as spreadsheets and editors do: the heading is
row 1.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.errors import UserError

TABLES = ("targets.csv", "targets_images.csv")  # the first that can be read is
IMAGE_COLUMNS = ("sensor_image", "image_name")
AXES = ("x", "y", "z", "Rx", "Ry", "Rz")
POSE_COLUMNS = tuple(f"pose_{i}" for i in range(1, 7)), tuple(f"pose_{axis}" for axis in AXES)
MOVE_COLUMNS = tuple(f"move_{i}" for i in range(1, 7)), tuple(f"shear_{axis}" for axis in AXES)
MAX_LABEL = 1e5  # mm or degrees: a number beyond it is no label
MAX_POSE_ID = 2.0**53
UNKNOWN_ID = -1


class WrongRow(NamedTuple):
    number: int  # in the file, the heading being 1
    text: str  # what is wrong with it


@dataclass(frozen=True)
class TableRow:
    number: int  # in the file, the heading being 1
    cells: dict[str, str]


class MisfitRow(NamedTuple):
    """A row that does not fit the heading."""

    number: int
    cells: int  # how many it has


@dataclass(frozen=True)
class LabelTable:
    file: Path
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    uneven: tuple[MisfitRow, ...]  # not among `rows`


class Problem(str):
    """One line on what is wrong with a recording, with the place as data."""

    place: Path
    row: int | None  # of a table

    @classmethod
    def with_place(cls, place: Path, text: str, row: int | None = None) -> Problem:
        """Make a line that begins with the place."""
        return cls.from_line(place, f"{place}{f', row {row}' if row else ''}: {text}", row)

    @classmethod
    def from_line(cls, place: Path, line: str, row: int | None = None) -> Problem:
        """Make a problem of a line that names the place in its own words."""
        # a file's name may consist of bytes that are no text
        printable = line.encode("utf-8", "backslashreplace").decode()
        problem = cls(" ".join(printable.split()))
        problem.place, problem.row = place, row
        return problem


def _make_error(file: Path, text: str, row: int | None = None) -> UserError:
    return UserError(Problem.with_place(file, text, row))


class ImageLabels(NamedTuple):
    """The labels of N images, in their order."""

    poses: np.ndarray  # (N, 6) mm and degrees, NaN where unknown
    moves: np.ndarray  # (N, 6)
    pose_ids: np.ndarray  # (N,) int64, UNKNOWN_ID where unknown


def read_table(file: Path) -> LabelTable:
    """Read a table. Raises UserError, by file and row, for what is no table of text."""
    heading, *lines = _read_lines(file)
    columns = tuple(heading.cells)
    for i, name in enumerate(columns):
        if name and name in columns[:i]:
            text = f"the heading names column {_format_cell(name)} twice"
            raise _make_error(file, text, heading.number)
    width = len(columns)
    rows = [
        TableRow(number, dict(zip(columns, cells, strict=True)))
        for number, cells in lines
        if len(cells) == width
    ]
    uneven = [MisfitRow(number, len(cells)) for number, cells in lines if len(cells) != width]
    return LabelTable(file, columns, tuple(rows), tuple(uneven))


class _Line(NamedTuple):
    number: int
    cells: list[str]


def _read_lines(file: Path) -> list[_Line]:
    """Read the lines of a CSV file that are not blank: one at least, or UserError."""
    reader = csv.reader(io.StringIO(_read_text(file), newline=""))
    lines: list[_Line] = []
    while True:
        number = reader.line_num + 1
        try:
            cells = next(reader, None)
        except csv.Error as error:
            raise _make_error(file, f"this is not CSV ({error})", number) from None
        if cells is None:
            break
        if any(cell.strip() for cell in cells):
            lines.append(_Line(number, [cell.strip() for cell in cells]))
    if not lines:
        raise _make_error(file, "is empty")
    return lines


def _read_text(file: Path) -> str:
    try:
        data = file.read_bytes()
    except OSError as error:
        raise _make_error(file, f"cannot be read ({error.strerror or error})") from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        text = "this is not UTF-8 text: save the table as CSV in UTF-8"
        raise _make_error(file, text, row) from None


def read_targets(table: LabelTable, names: Sequence[str]) -> tuple[ImageLabels, list[Problem]]:
    """Read the labels of images of these names, and list the problems of the table.

    Raises UserError if the table names no images.
    """
    column = next((name for name in IMAGE_COLUMNS if name in table.columns), None)
    if column is None:
        text = f"has no column {' or '.join(IMAGE_COLUMNS)}: its poses are not used"
        raise _make_error(table.file, text, 1)
    rows_by_name, problems = _index_rows(table, column, set(names))
    missing = [name for name in names if name not in rows_by_name]
    if missing:
        text = (
            f"has no row for {len(missing)} of {len(names)} images, "
            f"the first {missing[0]}: poses unknown"
        )
        problems.append(Problem.with_place(table.file, text))
    rows = [rows_by_name.get(name) for name in names]
    poses, bad_poses = _read_six(table, rows, POSE_COLUMNS, "pose")
    moves, bad_moves = _read_six(table, rows, MOVE_COLUMNS, "slide")
    ids, bad_ids = _read_pose_ids(table, rows)
    return ImageLabels(poses, moves, ids), problems + bad_poses + bad_moves + bad_ids


def make_unknown_labels(images: int) -> ImageLabels:
    """Make the labels of images that no table names."""
    unknown = np.full((images, 6), np.nan)
    return ImageLabels(unknown, unknown.copy(), np.full(images, UNKNOWN_ID, np.int64))


def _index_rows(
    table: LabelTable, column: str, names: set[str]
) -> tuple[dict[str, TableRow], list[Problem]]:
    """Return the row of each image, without images of which two rows differ, and the problems."""
    rows_by_name: dict[str, TableRow] = {}
    absent, repeated, ambiguous = list[WrongRow](), list[WrongRow](), set[str]()
    for row in table.rows:
        name = re.split(r"[/\\]", row.cells[column])[-1]
        first = rows_by_name.setdefault(name, row)
        if name not in names:
            text = f"there is no image {_format_cell(name)} in this folder"
            absent.append(WrongRow(row.number, text))
        elif row.cells != first.cells:
            text = f"{name} has another row, {first.number}, that differs: neither is used"
            repeated.append(WrongRow(row.number, text))
            ambiguous.add(name)
        elif row is not first:
            text = f"{name} has the same row already, {first.number}"
            repeated.append(WrongRow(row.number, text))
    width = len(table.columns)
    uneven = [
        WrongRow(number, f"{cells} cells where the heading has {width}: this row is not used")
        for number, cells in table.uneven
    ]
    problems = [
        *_summarise_problems(table, uneven),
        *_summarise_problems(table, absent),
        *_summarise_problems(table, repeated),
    ]
    unique = {name: row for name, row in rows_by_name.items() if name not in ambiguous}
    return unique, problems


def _summarise_problems(table: LabelTable, wrong: list[WrongRow]) -> list[Problem]:
    """Make one problem of all rows with the same, by the first: there may be thousands."""
    if not wrong:
        return []
    first = min(wrong)
    count = f" ({len(wrong)} such rows)" if len(wrong) > 1 else ""
    return [Problem.with_place(table.file, first.text + count, first.number)]


def _read_six(
    table: LabelTable,
    rows: Sequence[TableRow | None],
    namings: tuple[tuple[str, ...], ...],
    what: str,
) -> tuple[np.ndarray, list[Problem]]:
    """Read six columns (N, 6) by the naming of the file; a row is NaN unless it has all six."""
    values = np.full((len(rows), 6), np.nan)
    names = max(namings, key=lambda naming: len(set(table.columns).intersection(naming)))
    absent = [name for name in names if name not in table.columns]
    if absent:
        text = f"has no column {', '.join(absent)}: {what}s are not known"
        return values, [Problem.with_place(table.file, text)]
    bad: list[WrongRow] = []
    for i, row in enumerate(rows):
        if row is None:
            continue
        wrong = next((name for name in names if _parse_number(row.cells[name]) is None), None)
        if wrong is None:
            values[i] = [float(row.cells[name]) for name in names]
        else:
            cell = _format_cell(row.cells[wrong])
            text = f"{wrong} is {cell}, no usable number: this {what} is unknown"
            bad.append(WrongRow(row.number, text))
    return values, _summarise_problems(table, bad)


def _read_pose_ids(
    table: LabelTable, rows: Sequence[TableRow | None]
) -> tuple[np.ndarray, list[Problem]]:
    ids, bad = np.full(len(rows), UNKNOWN_ID, np.int64), list[WrongRow]()
    for i, row in enumerate(rows):
        if row is None or not (cell := row.cells.get("pose_id")):
            continue
        number = _parse_number(cell, MAX_POSE_ID)
        if number is None or number < 0 or number % 1:
            text = f"pose_id is {_format_cell(cell)}, not an integer"
            bad.append(WrongRow(row.number, text))
        else:
            ids[i] = int(number)
    return ids, _summarise_problems(table, bad)


def _parse_number(cell: str, limit: float = MAX_LABEL) -> float | None:
    """Parse a finite number within the limit; else None."""
    try:
        number = float(cell)
    except ValueError:
        return None
    return number if abs(number) < limit else None


def _format_cell(cell: str) -> str:
    return ascii(cell[:30]) if cell else "empty"


class ImagePair(NamedTuple):
    """The names of a slide's image and of its tap's."""

    slide: str
    tap: str


def read_pair_table(file: str | Path) -> list[ImagePair]:
    """Read a CSV with columns `slide` and `tap` that names images that belong together.

    Raises UserError, by file and row, for a table without them, a row of another length or with an
    empty cell, and a slide that has two taps.
    """
    table = read_table(Path(file))
    for name in ImagePair._fields:
        if name not in table.columns:
            text = f"there is no column '{name}': pairs need the columns slide and tap"
            raise _make_error(table.file, text, 1)
    if table.uneven:
        number, cells = table.uneven[0]
        text = f"{cells} cells where the heading has {len(table.columns)}"
        raise _make_error(table.file, text, number)
    if not table.rows:
        raise _make_error(table.file, "names no pairs: give a row for each slide, with its tap")
    first: dict[str, int] = {}
    pairs = []
    for row in table.rows:
        pair = ImagePair(row.cells["slide"], row.cells["tap"])
        if not pair.slide or not pair.tap:
            text = f"the {'tap' if pair.slide else 'slide'} is not named"
            raise _make_error(table.file, text, row.number)
        if pair.slide in first:
            text = f"{pair.slide} has a tap already, in row {first[pair.slide]}"
            raise _make_error(table.file, text, row.number)
        first[pair.slide] = row.number
        pairs.append(pair)
    return pairs
