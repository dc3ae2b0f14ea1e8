"""Tables: every figure on its line in a pipe, and nothing lost in a narrow terminal."""

import io
import re
from contextlib import redirect_stdout

import pytest

from jaxunshear.text_table import format_text_table

ROWS = [
    {"": "tap [red]:smile:", "mm": 1.23456},
    {"": "x" * 150, "mm": 2, "a kind of error": "0.31 [0.29, 0.33]"},
]
COLUMNS = ("", "mm", "a kind of error")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("variable", ["FORCE_COLOR", "TTY_COMPATIBLE", "NONE"])
def test_a_pipe_gets_a_row_a_line_without_colours_or_frames(monkeypatch, variable):
    monkeypatch.setenv(variable, "1")
    monkeypatch.setenv("COLUMNS", "40")
    heading, *lines = format_text_table(ROWS, COLUMNS).splitlines()
    assert heading.split() == ["mm", "a", "kind", "of", "error"] and heading.index("mm") == 154
    assert lines[0].split() == ["tap", "[red]:smile:", "1.23", "-"]
    assert lines[1] == "x" * 150 + "     2  0.31 [0.29, 0.33]"


def test_a_narrow_terminal_folds_cells_and_loses_nothing(monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("TERM", "xterm")
    with redirect_stdout(Terminal()):
        lines = re.sub(r"\x1b\[[\d;]*m", "", format_text_table(ROWS, COLUMNS)).splitlines()
    assert max(map(len, lines)) <= 40
    text = "".join(lines)
    assert text.count("x") == 150 and "1.23" in text and "…" not in text
