"""Labels by name, with what is wrong named by file and row; and tables of pairs."""

import numpy as np
import pytest

from jaxunshear.data.labels import (
    MOVE_COLUMNS,
    POSE_COLUMNS,
    read_pair_table,
    read_targets,
)
from jaxunshear.data.tables import LabelProblem, read_table
from jaxunshear.errors import UserError

HEADING = ",".join(["sensor_image", "pose_id", *POSE_COLUMNS[0], *MOVE_COLUMNS[0]])
NAMES = [f"image_{i}.png" for i in range(1, 4)]


def line(name, number=1, first="0.5"):
    return ",".join([name, str(number), first, *(str(i) for i in range(11))])


LINES = [HEADING, *(line(name, i) for i, name in enumerate(NAMES))]


def written(tmp_path, text):
    file = tmp_path / "targets.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return file


def targets_of(tmp_path, lines):
    return read_targets(read_table(written(tmp_path, "\n".join(lines))), NAMES)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_a_sound_table(tmp_path, end, mark):
    targets, problems = read_targets(read_table(written(tmp_path, mark + end.join(LINES))), NAMES)
    np.testing.assert_array_equal(targets.poses, [[0.5, 0, 1, 2, 3, 4]] * 3)
    np.testing.assert_array_equal(targets.moves, [[5, 6, 7, 8, 9, 10]] * 3)
    np.testing.assert_array_equal(targets.pose_ids, [0, 1, 2])
    assert problems == []


def replaced(row, by):
    return [*LINES[: row - 1], by, *LINES[row:]]


@pytest.mark.parametrize(
    ("lines", "row", "says", "unknown"),
    [
        (replaced(3, line(NAMES[1], 1, "abc")), 3, "pose_1 is 'abc', no usable number", [1]),
        (replaced(4, line(NAMES[2], 1, "nan")), 4, "pose_1 is 'nan'", [2]),
        (replaced(2, line(NAMES[0], 1, "-inf")), 2, "pose_1 is '-inf'", [0]),
        (replaced(2, line(NAMES[0], 1, "1e300")), 2, "pose_1 is '1e300'", [0]),
        (replaced(2, line(NAMES[0], 1, "")), 2, "pose_1 is empty", [0]),
        (replaced(3, "image_2.png,1,2"), 3, "3 cells where the heading has 14", [1]),
        (replaced(3, LINES[2] + ",5"), 3, "15 cells where the heading has 14", [1]),
        (
            [*LINES, line(NAMES[1], 1, "9")],
            5,
            "image_2.png has another row, 3, that differs: neither is used",
            [1],
        ),
        ([*LINES, LINES[2]], 5, "image_2.png has the same row already, 3", []),
        ([*LINES, line("image_9.png")], 5, "there is no image 'image_9.png' in this folder", []),
        (
            [LINES[0], "", *LINES[1:], line("b"), line("a")],
            6,
            "no image 'b' in this folder (2 such rows)",
            [],
        ),
        (replaced(3, line(NAMES[1], "x")), 3, "pose_id is 'x', not an integer", []),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_wrong_is_named_by_row(tmp_path, lines, row, says, unknown):
    targets, problems = targets_of(tmp_path, lines)
    reported = [problem for problem in problems if says in problem]
    assert len(reported) == 1
    assert (reported[0].place, reported[0].row) == (tmp_path / "targets.csv", row)
    assert reported[0].startswith(f"{tmp_path / 'targets.csv'}, row {row}: ")
    assert np.flatnonzero(np.isnan(targets.poses).any(axis=1)).tolist() == unknown


def test_a_row_of_two_lines_does_not_shift_the_count(tmp_path):
    lines = [f"{HEADING},note", f'{LINES[1]},"two\nlines"', f"{LINES[2]},"]
    lines.append(f"{line(NAMES[2], 1, 'abc')},")
    _, problems = targets_of(tmp_path, lines)
    assert [problem.row for problem in problems] == [5]  # as an editor counts


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is empty"),
        ("\n\n  \n", "is empty"),
        ("\n".join(LINES).encode() + b"\nimage_\xff", ", row 5: this is not UTF-8"),
        ("\n".join(LINES).encode("utf-16"), ", row 1: this is not UTF-8"),
        (f"a,b,a\n{LINES[1]}", ", row 1: the heading names column 'a' twice"),
        (HEADING + "\n" + "x" * 200_000, ", row 2: this is not CSV"),
    ],
    ids=["empty", "blank", "latin1", "utf16", "twice", "endless"],
)
def test_what_is_no_table_is_refused(tmp_path, text, says):
    with pytest.raises(UserError, match=f"targets.csv.*{says}"):
        read_table(written(tmp_path, text))


def test_a_problem_can_be_printed_whatever_the_name():
    problem = LabelProblem.with_place("caf\udce9\n.csv", "is  odd", 3)
    assert problem.encode() == b"caf\\udce9 .csv, row 3: is odd"


def test_pairs(tmp_path):
    file = written(tmp_path, "tap,note,slide\na/1.png,,b/1.png\na/1.png,,b/2.png\n")
    assert read_pair_table(file) == {2: ("b/1.png", "a/1.png"), 3: ("b/2.png", "a/1.png")}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("slide,tip\na,b", "row 1: there is no column 'tap'"),
        ("slide,tap\na,b\nc", "row 3: 1 cells where the heading has 2"),
        ("slide,tap\na,b\nc,", "row 3: the tap is not named"),
        ("slide,tap\n,b", "row 2: the slide is not named"),
        ("slide,tap\na,b\nc,d\na,e", "row 4: a has a tap already, in row 2"),
        ("slide,tap\n", "names no pairs"),
        ("", "is empty"),
    ],
    ids=["column", "short", "tap", "slide", "twice", "none", "empty"],
)
def test_pairs_that_are_none(tmp_path, text, says):
    with pytest.raises(UserError, match=f"targets.csv.*{says}"):
        read_pair_table(written(tmp_path, text))
    with pytest.raises(UserError, match=r"absent.csv: cannot be read \(No such file"):
        read_pair_table(tmp_path / "absent.csv")
