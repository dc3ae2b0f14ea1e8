"""Read the tables beside recorded images: poses, slides and other numbers by image name.

The column of images is `sensor_image` or `image_name`, or whichever names images of the folder.
Names match in any form of Unicode. Problems are named by file and row.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.targets import LABELLED_SLIDES, RECORDED_FIELDS
from jaxunshear.data.tables import (
    LabelProblem,
    LabelTable,
    format_cell,
    make_table_error,
    read_table,
)
from jaxunshear.files import parse_number

IMAGE_COLUMNS = ("sensor_image", "image_name")
REFERENCE = "reference"  # the image of the sensor that touches nothing, which has no pose
AXES = ("x", "y", "z", "Rx", "Ry", "Rz")
POSE_COLUMNS = tuple(f"pose_{i}" for i in range(1, 7)), tuple(f"pose_{axis}" for axis in AXES)
MOVE_COLUMNS = tuple(f"move_{i}" for i in range(1, 7)), tuple(f"shear_{axis}" for axis in AXES)
MAX_LABEL = 1e5  # mm or degrees: a number beyond it is no label
MAX_POSE_ID = 2.0**53
UNKNOWN_ID = -1
NO_VARIATION = 1e-6  # mm or deg
MIN_RANGED = 10  # contacts: fewer say nothing of ranges
METRES = 0.05  # positions that vary by less are hardly mm
RADIANS = {"pose": 6.3, "slide": 1.0}  # angles that vary by less are hardly degrees


class ImageLabels(NamedTuple):
    """The labels of N images, in their order."""

    poses: np.ndarray  # (N, 6) mm and degrees, NaN where unknown
    moves: np.ndarray  # (N, 6)
    pose_ids: np.ndarray  # (N,) int64, UNKNOWN_ID where unknown
    others: Mapping[str, np.ndarray]  # column: (N,) in its own unit, NaN where unknown

    @classmethod
    def make_unknown(cls, images: int) -> ImageLabels:
        unknown = np.full((images, 6), np.nan)
        return cls(unknown, unknown.copy(), np.full(images, UNKNOWN_ID, np.int64), {})

    @classmethod
    def join(cls, parts: Sequence[ImageLabels]) -> ImageLabels:
        """Join labels; columns that a part lacks are unknown there."""
        poses = np.concatenate([part.poses for part in parts])
        moves = np.concatenate([part.moves for part in parts])
        ids = np.concatenate([part.pose_ids for part in parts])
        counts = [len(part.pose_ids) for part in parts]
        return cls(poses, moves, ids, join_columns([part.others for part in parts], counts))

    @property
    def are_known(self) -> bool:
        """Whether any image has any label."""
        is_known = np.isfinite(self.poses).any() or np.isfinite(self.moves).any()
        return bool(is_known or (self.pose_ids != UNKNOWN_ID).any() or self.others)


def join_columns(
    parts: Sequence[Mapping[str, np.ndarray]], counts: Sequence[int]
) -> dict[str, np.ndarray]:
    """Join columns by name, of `counts` rows each; they are NaN where a part lacks them."""
    unknown = [np.full(count, np.nan) for count in counts]
    columns = {}
    for name in dict.fromkeys(name for part in parts for name in part):
        own = [part.get(name, rows) for part, rows in zip(parts, unknown, strict=True)]
        columns[name] = np.concatenate(own)
    return columns


def name_labels(
    poses: np.ndarray | None, moves: np.ndarray | None, others: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return columns (N,) of labels by the names of targets; others keep their own names."""
    fields = {"pose": poses, "move": moves}
    named = {
        name: values[:, column]
        for name, (field, column) in (RECORDED_FIELDS | LABELLED_SLIDES).items()
        if (values := fields[field]) is not None
    }
    return {**named, **others}


def normalise_text(text: str) -> str:
    """Return a name in the one form of Unicode in which names are compared."""
    return unicodedata.normalize("NFC", text)


def normalise_name(path: str) -> str:
    """Return the name of a file without its folders, to compare it with others."""
    return normalise_text(re.split(r"[/\\]", path)[-1])


def read_targets(table: LabelTable, names: Sequence[str]) -> tuple[ImageLabels, list[LabelProblem]]:
    """Read the labels of images of these names, and list the problems of the table.

    Raises UserError if the table names no images.
    """
    keys = [normalise_name(name) for name in names]
    column = _find_image_column(table, set(keys))
    numbers_by_name, problems = _index_rows(table, column, set(keys))
    numbers = [numbers_by_name.get(key) for key in keys]
    unlabelled = [name for name, number in zip(names, numbers, strict=True) if number is None]
    if missing := [name for name in unlabelled if not _is_reference(name)]:
        text = (
            f"has no row for {len(missing)} of {len(names)} images, "
            f"the first {missing[0]}: poses unknown"
        )
        problems.append(LabelProblem.with_place(table.file, text))
    poses, bad_poses = _read_six(table, numbers, POSE_COLUMNS, "pose")
    moves, bad_moves = _read_six(table, numbers, MOVE_COLUMNS, "slide")
    ids, bad_ids = _read_pose_ids(table, numbers)
    others = _read_others(table, numbers)
    return ImageLabels(poses, moves, ids, others), problems + bad_poses + bad_moves + bad_ids


def _is_reference(name: str) -> bool:
    return Path(name).stem.lower() == REFERENCE


def _find_image_column(table: LabelTable, known: set[str]) -> str:
    """Find the column that names images: by its own name, or by what is in its cells."""
    for column in IMAGE_COLUMNS:
        if column in table.columns:
            return column

    def count_names(column: str) -> int:
        return sum(normalise_name(row[column]) in known for row in table.rows.values())

    column = max(table.columns, key=count_names)
    if not count_names(column):
        text = f"has no column {' or '.join(IMAGE_COLUMNS)}, nor one that names these images"
        raise make_table_error(table.file, f"{text}: its poses are not used", table.heading)
    return column


def _index_rows(
    table: LabelTable, column: str, known: set[str]
) -> tuple[dict[str, int], list[LabelProblem]]:
    """Return the row of each image, without images of which two rows differ, and the problems."""
    numbers: dict[str, int] = {}
    absent, repeated, ambiguous = dict[int, str](), dict[int, str](), set[str]()
    for number, cells in table.rows.items():
        name = normalise_name(cells[column])
        if _is_reference(name):
            continue
        first = numbers.setdefault(name, number)
        if name not in known:
            absent[number] = f"there is no image {format_cell(name)} in this folder"
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
    """Read six columns (N, 6) by the naming of the file; a row is NaN unless it has all it can.

    What no row has is 0, as a robot of four axes does not turn about x and y.
    """
    values, bad = np.zeros((len(numbers), 6)), dict[int, str]()
    columns, absent = _find_six(table, namings)
    if not columns:
        text = f"has no column {', '.join(absent.values())}: {what}s are not known"
        return np.full_like(values, np.nan), [LabelProblem.with_place(table.file, text)]
    for i, number in enumerate(numbers):
        if number is None:
            values[i] = np.nan
            continue
        cells = table.rows[number]
        row = {axis: _parse_label(cells[name]) for axis, name in columns.items()}
        if wrong := [columns[axis] for axis, value in row.items() if value is None]:
            cell = format_cell(cells[wrong[0]])
            bad[number] = f"{wrong[0]} is {cell}, no usable number: this {what} is unknown"
            values[i] = np.nan
        else:
            values[i, list(row)] = list(row.values())
    problems = _summarise_problems(table, bad) + _find_unit_problems(table, values, what)
    if absent:
        axes = ", ".join(AXES[axis] for axis in absent)
        text = f"has no column {', '.join(absent.values())}: {axes} of each {what} is taken as 0"
        problems.append(LabelProblem.with_place(table.file, text))
    return values, problems


def _find_six(
    table: LabelTable, namings: tuple[tuple[str, ...], ...]
) -> tuple[dict[int, str], dict[int, str]]:
    """Find the columns of the axes, in the naming of the file, and the names of those it lacks.

    A column without any number is lacking; without any such column all of them are.
    """
    by_name = {name.lower(): name for name in reversed(table.columns)}
    names = max(namings, key=lambda naming: len({*map(str.lower, naming)} & by_name.keys()))
    columns, absent = dict[int, str](), dict[int, str]()
    for axis, name in enumerate(names):
        column = by_name.get(name.lower())
        has_cells = column and any(
            row[column].lower() not in ("", "nan") for row in table.rows.values()
        )
        if column and (has_cells or not table.rows):
            columns[axis] = column
        else:
            absent[axis] = name
    return columns, absent


def _find_unit_problems(table: LabelTable, values: np.ndarray, what: str) -> list[LabelProblem]:
    """Find labels (N, 6) that vary as those in metres or radians do."""
    problems = []
    limits = ("positions", "mm", "metres", METRES), ("angles", "degrees", "radians", RADIANS[what])
    for columns, (name, unit, other, limit) in zip((slice(3), slice(3, 6)), limits, strict=True):
        span = compute_span(values[:, columns])
        if NO_VARIATION < span < limit:
            text = f"{name} of {what}s vary by {span:.3g} at most, but are to be in {unit}"
            text += f": convert them if they are in {other}"
            problems.append(LabelProblem.with_place(table.file, text))
    return problems


def compute_span(values: np.ndarray) -> float:
    """Compute how far the column of (N, K) that varies most does; 0 if too few rows are known."""
    known = values[np.isfinite(values).all(axis=1)]
    return float(np.ptp(known, axis=0).max()) if len(known) >= MIN_RANGED else 0.0


def _read_others(table: LabelTable, numbers: Sequence[int | None]) -> dict[str, np.ndarray]:
    """Read the other columns (N,) with numbers, as forces and torques."""
    own = {name.lower() for naming in (*POSE_COLUMNS, *MOVE_COLUMNS) for name in naming}
    others = {}
    for column in table.columns:
        if not column or column.lower() in (*own, "pose_id"):
            continue
        cells = [None if number is None else table.rows[number][column] for number in numbers]
        values = np.array([_parse_label(cell) if cell else None for cell in cells], float)
        if np.isfinite(values).any():
            others[column] = values
    return others


def _read_pose_ids(
    table: LabelTable, numbers: Sequence[int | None]
) -> tuple[np.ndarray, list[LabelProblem]]:
    ids, bad = np.full(len(numbers), UNKNOWN_ID, np.int64), dict[int, str]()
    for i, number in enumerate(numbers):
        cell = "" if number is None else table.rows[number].get("pose_id", "")
        if number is None or not cell:
            continue
        pose_id = _parse_label(cell, MAX_POSE_ID)
        if pose_id is None or pose_id < 0 or pose_id % 1:
            bad[number] = f"pose_id is {format_cell(cell)}, not an integer"
        else:
            ids[i] = int(pose_id)
    return ids, _summarise_problems(table, bad)


def _parse_label(cell: str, limit: float = MAX_LABEL) -> float | None:
    try:
        number = parse_number(cell)
    except ValueError:
        return None
    return number if abs(number) < limit else None


class ImagePair(NamedTuple):
    """The names of a slide's image and of its tap's."""

    slide: str
    tap: str


def read_pair_table(file: str | Path) -> dict[int, ImagePair]:
    """Read a table with columns `slide` and `tap` of images that belong together, by row.

    Raises UserError, by file and row, for a table without them, a row of another length or with an
    empty cell, and a slide that has two taps.
    """
    table = read_table(Path(file))
    for name in ImagePair._fields:
        if name not in table.columns:
            text = f"there is no column '{name}': pairs need the columns slide and tap"
            raise make_table_error(table.file, text, table.heading)
    if table.uneven:
        number, cells = next(iter(table.uneven.items()))
        text = f"{cells} cells where the heading has {len(table.columns)}"
        raise make_table_error(table.file, text, number)
    if not table.rows:
        raise make_table_error(
            table.file, "names no pairs: give a row for each slide, with its tap"
        )
    first: dict[str, int] = {}
    pairs = {}
    for number, row in table.rows.items():
        pair = ImagePair(normalise_text(row["slide"]), normalise_text(row["tap"]))
        if not pair.slide or not pair.tap:
            text = f"the {'tap' if pair.slide else 'slide'} is not named"
            raise make_table_error(table.file, text, number)
        if pair.slide in first:
            text = f"{pair.slide} has a tap already, in row {first[pair.slide]}"
            raise make_table_error(table.file, text, number)
        first[pair.slide] = number
        pairs[number] = pair
    return pairs
