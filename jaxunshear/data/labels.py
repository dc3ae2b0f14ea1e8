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


@dataclass(frozen=True)
class LabelTable:
    """A table of text; rows are known by their number in the file, the heading being 1."""

    file: Path
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


def _make_error(file: Path, text: str, row: int | None = None) -> UserError:
    return UserError(LabelProblem.with_place(file, text, row))


class ImageLabels(NamedTuple):
    """The labels of N images, in their order."""

    poses: np.ndarray  # (N, 6) mm and degrees, NaN where unknown
    moves: np.ndarray  # (N, 6)
    pose_ids: np.ndarray  # (N,) int64, UNKNOWN_ID where unknown

    @classmethod
    def make_unknown(cls, images: int) -> ImageLabels:
        unknown = np.full((images, 6), np.nan)
        return cls(unknown, unknown.copy(), np.full(images, UNKNOWN_ID, np.int64))


def read_table(file: Path) -> LabelTable:
    """Read a table. Raises UserError, by file and row, for what is no table of text."""
    lines = _read_lines(file)
    heading = min(lines)
    columns = tuple(lines.pop(heading))
    repeated = next((name for name in columns if name and columns.count(name) > 1), None)
    if repeated is not None:
        text = f"the heading names column {_format_cell(repeated)} twice"
        raise _make_error(file, text, heading)
    width, rows, uneven = len(columns), {}, {}
    for number, cells in lines.items():
        if len(cells) == width:
            rows[number] = dict(zip(columns, cells, strict=True))
        else:
            uneven[number] = len(cells)
    return LabelTable(file, columns, rows, uneven)


def _read_lines(file: Path) -> dict[int, list[str]]:
    """Read the cells of the lines of a CSV file that are not blank: one at least, or UserError."""
    try:
        data = file.read_bytes()
        text = data.decode("utf-8-sig")
    except OSError as error:
        raise _make_error(file, f"cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        remedy = "this is not UTF-8 text: save the table as CSV in UTF-8"
        raise _make_error(file, remedy, row) from None
    reader = csv.reader(io.StringIO(text, newline=""))
    lines: dict[int, list[str]] = {}
    number = 1
    try:
        for cells in reader:
            if any(cell.strip() for cell in cells):
                lines[number] = [cell.strip() for cell in cells]
            number = reader.line_num + 1
    except csv.Error as error:
        raise _make_error(file, f"this is not CSV ({error})", number) from None
    if not lines:
        raise _make_error(file, "is empty")
    return lines


def read_targets(table: LabelTable, names: Sequence[str]) -> tuple[ImageLabels, list[LabelProblem]]:
    """Read the labels of images of these names, and list the problems of the table.

    Raises UserError if the table names no images.
    """
    column = next((name for name in IMAGE_COLUMNS if name in table.columns), None)
    if column is None:
        text = f"has no column {' or '.join(IMAGE_COLUMNS)}: its poses are not used"
        raise _make_error(table.file, text, 1)
    numbers_by_name, problems = _index_rows(table, column, set(names))
    numbers = [numbers_by_name.get(name) for name in names]
    if missing := [name for name, number in zip(names, numbers, strict=True) if number is None]:
        text = (
            f"has no row for {len(missing)} of {len(names)} images, "
            f"the first {missing[0]}: poses unknown"
        )
        problems.append(LabelProblem.with_place(table.file, text))
    poses, bad_poses = _read_six(table, numbers, POSE_COLUMNS, "pose")
    moves, bad_moves = _read_six(table, numbers, MOVE_COLUMNS, "slide")
    ids, bad_ids = _read_pose_ids(table, numbers)
    return ImageLabels(poses, moves, ids), problems + bad_poses + bad_moves + bad_ids


def _index_rows(
    table: LabelTable, column: str, names: set[str]
) -> tuple[dict[str, int], list[LabelProblem]]:
    """Return the row of each image, without images of which two rows differ, and the problems."""
    numbers: dict[str, int] = {}
    absent, repeated, ambiguous = dict[int, str](), dict[int, str](), set[str]()
    for number, cells in table.rows.items():
        name = re.split(r"[/\\]", cells[column])[-1]
        first = numbers.setdefault(name, number)
        if name not in names:
            absent[number] = f"there is no image {_format_cell(name)} in this folder"
        elif cells != table.rows[first]:
            repeated[number] = f"{name} has another row, {first}, that differs: neither is used"
            ambiguous.add(name)
        elif number != first:
            repeated[number] = f"{name} has the same row already, {first}"
    width = len(table.columns)
    uneven = {
        number: f"{cells} cells where the heading has {width}: this row is not used"
        for number, cells in table.uneven.items()
    }
    problems = []
    for wrong in (uneven, absent, repeated):
        problems += _summarise_problems(table, wrong)
    return {name: row for name, row in numbers.items() if name not in ambiguous}, problems


def _summarise_problems(table: LabelTable, wrong: dict[int, str]) -> list[LabelProblem]:
    """Make one problem of all rows with the same, by the first: there may be thousands."""
    if not wrong:
        return []
    first = min(wrong)
    count = f" ({len(wrong)} such rows)" if len(wrong) > 1 else ""
    return [LabelProblem.with_place(table.file, wrong[first] + count, first)]


def _read_six(
    table: LabelTable,
    numbers: Sequence[int | None],
    namings: tuple[tuple[str, ...], ...],
    what: str,
) -> tuple[np.ndarray, list[LabelProblem]]:
    """Read six columns (N, 6) by the naming of the file; a row is NaN unless it has all six."""
    values, bad = np.full((len(numbers), 6), np.nan), dict[int, str]()
    names = max(namings, key=lambda naming: len(set(table.columns).intersection(naming)))
    absent = [name for name in names if name not in table.columns]
    if absent:
        text = f"has no column {', '.join(absent)}: {what}s are not known"
        return values, [LabelProblem.with_place(table.file, text)]
    for i, number in enumerate(numbers):
        if number is None:
            continue
        cells = table.rows[number]
        row = {name: _parse_number(cells[name]) for name in names}
        if wrong := [name for name, value in row.items() if value is None]:
            cell = _format_cell(cells[wrong[0]])
            bad[number] = f"{wrong[0]} is {cell}, no usable number: this {what} is unknown"
        else:
            values[i] = list(row.values())
    return values, _summarise_problems(table, bad)


def _read_pose_ids(
    table: LabelTable, numbers: Sequence[int | None]
) -> tuple[np.ndarray, list[LabelProblem]]:
    ids, bad = np.full(len(numbers), UNKNOWN_ID, np.int64), dict[int, str]()
    for i, number in enumerate(numbers):
        cell = "" if number is None else table.rows[number].get("pose_id", "")
        if number is None or not cell:
            continue
        pose_id = _parse_number(cell, MAX_POSE_ID)
        if pose_id is None or pose_id < 0 or pose_id % 1:
            bad[number] = f"pose_id is {_format_cell(cell)}, not an integer"
        else:
            ids[i] = int(pose_id)
    return ids, _summarise_problems(table, bad)


def _parse_number(cell: str, limit: float = MAX_LABEL) -> float | None:
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
        number, cells = next(iter(table.uneven.items()))
        text = f"{cells} cells where the heading has {len(table.columns)}"
        raise _make_error(table.file, text, number)
    if not table.rows:
        raise _make_error(table.file, "names no pairs: give a row for each slide, with its tap")
    first: dict[str, int] = {}
    pairs = []
    for number, row in table.rows.items():
        pair = ImagePair(row["slide"], row["tap"])
        if not pair.slide or not pair.tap:
            text = f"the {'tap' if pair.slide else 'slide'} is not named"
            raise _make_error(table.file, text, number)
        if pair.slide in first:
            text = f"{pair.slide} has a tap already, in row {first[pair.slide]}"
            raise _make_error(table.file, text, number)
        first[pair.slide] = number
        pairs.append(pair)
    return pairs
