"""The tables beside recorded images: poses, slides and pose numbers by the name of the image. What is wrong is named by file and row.

A row is counted as spreadsheets and editors do: the heading is row 1.
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
MOST_POSES = 2.0**53
UNKNOWN_ID = -1

WrongRow = tuple[int, str]  # row, and what is wrong with it


@dataclass(frozen=True)
class TableRow:
    number: int  # in the file, the heading being 1
    cells: dict[str, str]


class MisfitRow(NamedTuple):
    """A row that does not fit the heading."""

    number: int
    cells: int


@dataclass(frozen=True)
class LabelTable:
    file: Path
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    uneven: tuple[MisfitRow, ...]  # not among `rows`


class Problem(str):
    """One line on what is wrong with a recording, that knows where."""

    place: Path
    row: int | None  # of a table

    @classmethod
    def with_place(cls, place: Path, text: str, row: int | None = None) -> Problem:
        """That begins with the place."""
        return cls.from_line(place, f"{place}{f', row {row}' if row else ''}: {text}", row)

    @classmethod
    def from_line(cls, place: Path, line: str, row: int | None = None) -> Problem:
        """That names the place in its own words."""
        printable = line.encode(
            "utf-8", "backslashreplace"
        ).decode()  # a file's name may be of bytes that are no text
        problem = cls(" ".join(printable.split()))
        problem.place, problem.row = place, row
        return problem


def _refusal(file: Path, text: str, row: int | None = None) -> UserError:
    return UserError(Problem.with_place(file, text, row))


class ImageLabels(NamedTuple):
    """Of N images, in their order."""

    poses: np.ndarray  # (N, 6) mm and degrees, NaN where unknown
    moves: np.ndarray  # (N, 6)
    pose_ids: np.ndarray  # (N,) int64, UNKNOWN_ID where unknown


def read_table(file: Path) -> LabelTable:
    """Raises UserError, by file and row, for what is no table of text."""
    try:
        data = file.read_bytes()
    except OSError as error:
        raise _refusal(file, f"cannot be read ({error.strerror or error})") from None
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        raise _refusal(
            file, "this is not UTF-8 text: save the table as CSV in UTF-8", row
        ) from None
    reader = csv.reader(io.StringIO(text, newline=""))
    lines: list[tuple[int, list[str]]] = []
    while True:
        row = reader.line_num + 1
        try:
            cells = next(reader, None)
        except csv.Error as error:
            raise _refusal(file, f"this is not CSV ({error})", row) from None
        if cells is None:
            break
        if any(cell.strip() for cell in cells):
            lines.append((row, [cell.strip() for cell in cells]))
    if not lines:
        raise _refusal(file, "is empty")
    columns = tuple(lines[0][1])
    twice = next((name for i, name in enumerate(columns) if name and name in columns[:i]), None)
    if twice is not None:
        raise _refusal(file, f"the heading names column {_format_cell(twice)} twice", lines[0][0])
    width = len(columns)
    return LabelTable(
        file,
        columns,
        tuple(
            TableRow(row, dict(zip(columns, cells, strict=True)))
            for row, cells in lines[1:]
            if len(cells) == width
        ),
        tuple(MisfitRow(row, len(cells)) for row, cells in lines[1:] if len(cells) != width),
    )


def read_targets(table: LabelTable, names: Sequence[str]) -> tuple[ImageLabels, list[Problem]]:
    """The labels of images of these names. Raises UserError where the table names no images."""
    column = next((name for name in IMAGE_COLUMNS if name in table.columns), None)
    if column is None:
        raise _refusal(
            table.file, f"has no column {' or '.join(IMAGE_COLUMNS)}: its poses are not used", 1
        )
    by_name, problems = _by_name(table, column, set(names))
    missing = [name for name in names if name not in by_name]
    if missing:
        text = f"has no row for {len(missing)} of {len(names)} images, the first {missing[0]}: poses unknown"
        problems.append(Problem.with_place(table.file, text))
    rows = [by_name.get(name) for name in names]
    poses, bad_poses = _six(table, rows, POSE_COLUMNS, "pose")
    moves, bad_moves = _six(table, rows, MOVE_COLUMNS, "slide")
    ids, bad_ids = _ids(table, rows)
    return ImageLabels(poses, moves, ids), problems + bad_poses + bad_moves + bad_ids


def make_unknown_labels(images: int) -> ImageLabels:
    """Of images that no table names."""
    unknown = np.full((images, 6), np.nan)
    return ImageLabels(unknown, unknown.copy(), np.full(images, UNKNOWN_ID, np.int64))


def _by_name(
    table: LabelTable, column: str, names: set[str]
) -> tuple[dict[str, TableRow], list[Problem]]:
    """The row of each image; none where two rows of one image differ."""
    by_name: dict[str, TableRow] = {}
    absent, again, differ = list[WrongRow](), list[WrongRow](), set[str]()
    for row in table.rows:
        name = re.split(r"[/\\]", row.cells[column])[-1]
        first = by_name.setdefault(name, row)
        if name not in names:
            absent.append((row.number, f"there is no image {_format_cell(name)} in this folder"))
        elif row.cells != first.cells:
            again.append(
                (
                    row.number,
                    f"{name} has another row, {first.number}, that differs: neither is used",
                )
            )
            differ.add(name)
        elif row is not first:
            again.append((row.number, f"{name} has the same row already, {first.number}"))
    width = len(table.columns)
    uneven = [
        (row, f"{cells} cells where the heading has {width}: this row is not used")
        for row, cells in table.uneven
    ]
    problems = [
        problem for wrong in (uneven, absent, again) for problem in _group_problems(table, wrong)
    ]
    return {name: row for name, row in by_name.items() if name not in differ}, problems


def _group_problems(table: LabelTable, wrong: list[WrongRow]) -> list[Problem]:
    """One problem for all rows that have the same, with the first of them: there may be thousands."""
    if not wrong:
        return []
    row, text = min(wrong)
    return [
        Problem.with_place(
            table.file, text + (f" ({len(wrong)} such rows)" if len(wrong) > 1 else ""), row
        )
    ]


def _six(
    table: LabelTable,
    rows: Sequence[TableRow | None],
    choices: tuple[tuple[str, ...], ...],
    what: str,
) -> tuple[np.ndarray, list[Problem]]:
    """The six columns (N, 6) of whichever naming the file uses, NaN in rows that have not all of them."""
    values = np.full((len(rows), 6), np.nan)
    names = max(choices, key=lambda choice: len(set(table.columns).intersection(choice)))
    lacking = [name for name in names if name not in table.columns]
    if lacking:
        return values, [
            Problem.with_place(
                table.file, f"has no column {', '.join(lacking)}: {what}s are not known"
            )
        ]
    bad: list[WrongRow] = []
    for i, row in enumerate(rows):
        if row is None:
            continue
        wrong = next((name for name in names if _number(row.cells[name]) is None), None)
        if wrong is None:
            values[i] = [float(row.cells[name]) for name in names]
        else:
            bad.append(
                (
                    row.number,
                    f"{wrong} is {_format_cell(row.cells[wrong])}, no usable number: this {what} is unknown",
                )
            )
    return values, _group_problems(table, bad)


def _ids(table: LabelTable, rows: Sequence[TableRow | None]) -> tuple[np.ndarray, list[Problem]]:
    ids, bad = np.full(len(rows), UNKNOWN_ID, np.int64), list[WrongRow]()
    for i, row in enumerate(rows):
        if row is None or not (cell := row.cells.get("pose_id")):
            continue
        number = _number(cell, MOST_POSES)
        if number is None or number < 0 or number % 1:
            bad.append((row.number, f"pose_id is {_format_cell(cell)}, not an integer"))
        else:
            ids[i] = int(number)
    return ids, _group_problems(table, bad)


def _number(cell: str, limit: float = MAX_LABEL) -> float | None:
    """A finite number within the limit; else None."""
    try:
        number = float(cell)
    except ValueError:
        return None
    return number if abs(number) < limit else None


def _format_cell(cell: str) -> str:
    return ascii(cell[:30]) if cell else "empty"


def read_pair_table(file: str | Path) -> list[tuple[str, str]]:
    """(slide, tap), the names of images that belong together, from a CSV with columns `slide` and `tap`.

    Raises UserError, by file and row, for a table without them, a row of another length or with an empty cell, and a slide that
    has two taps.
    """
    table = read_table(Path(file))
    for name in ("slide", "tap"):
        if name not in table.columns:
            raise _refusal(
                table.file, f"there is no column '{name}': pairs need the columns slide and tap", 1
            )
    if table.uneven:
        number, cells = table.uneven[0]
        raise _refusal(
            table.file, f"{cells} cells where the heading has {len(table.columns)}", number
        )
    if not table.rows:
        raise _refusal(table.file, "names no pairs: give a row for each slide, with its tap")
    first: dict[str, int] = {}
    for row in table.rows:
        slide = row.cells["slide"]
        if not slide or not row.cells["tap"]:
            raise _refusal(
                table.file, f"the {'tap' if slide else 'slide'} is not named", row.number
            )
        if slide in first:
            raise _refusal(
                table.file, f"{slide} has a tap already, in row {first[slide]}", row.number
            )
        first[slide] = row.number
    return [(row.cells["slide"], row.cells["tap"]) for row in table.rows]
