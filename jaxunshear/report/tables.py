"""Tables of a page as CSV and LaTeX files, for a paper."""

import csv
import io
import re
from html.parser import HTMLParser
from pathlib import Path

from jaxunshear.files import write_text

LATEX = {  # a character that LaTeX would not print: what prints it
    **{each: f"\\{each}" for each in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "\u2013": "--",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
}


class _TableParser(HTMLParser):
    """Collects the tables of a page: the id of the heading above each, and its rows of text."""

    def __init__(self) -> None:
        super().__init__()
        self.tables: list[tuple[str, list[list[str]]]] = []
        self.heading = ""
        self.in_cell = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "h2":
            self.heading = dict(attrs).get("id") or ""
        elif tag == "table":
            self.tables.append((self.heading, []))
        elif tag == "tr" and self.tables:
            self.tables[-1][1].append([])
        elif tag in ("td", "th") and self.tables:
            self.tables[-1][1][-1].append("")
            self.in_cell = True
        elif tag == "br":
            self.handle_data(" ")

    def handle_endtag(self, tag: str) -> None:
        self.in_cell = self.in_cell and tag not in ("td", "th")

    def handle_data(self, data: str) -> None:
        if self.in_cell:
            self.tables[-1][1][-1][-1] += data


def write_tables(page: Path, folder: Path) -> list[Path]:
    """Write every table of a page into a folder, as NAME.csv and NAME.tex; return the files.

    NAME is the heading above the table, with a number if there are several. The LaTeX needs the
    package booktabs.
    """
    parser = _TableParser()
    parser.feed(page.read_text())
    written = []
    names: dict[str, int] = {}
    for heading, cells in parser.tables:
        names[heading] = count = names.get(heading, 0) + 1
        name = f"{heading or 'table'}{f'-{count}' if count > 1 else ''}"
        head, *rows = map(_strip_cells, cells)
        sheet = io.StringIO()
        csv.writer(sheet, lineterminator="\n").writerows([head, *rows])
        for path, text in (
            (folder / f"{name}.csv", sheet.getvalue()),
            (folder / f"{name}.tex", format_latex(head, rows)),
        ):
            write_text(path, text)
            written.append(path)
    return written


def _strip_cells(cells: list[str]) -> list[str]:
    return [" ".join(cell.split()) for cell in cells]


def format_latex(head: list[str], rows: list[list[str]]) -> str:
    """Format a table as LaTeX: the first column left-aligned, the others right-aligned."""
    lines = [" & ".join(map(escape_latex, row)) + r" \\" for row in (head, *rows)]
    return "\n".join(
        (
            f"\\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}",
            *(r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"),
            "\\end{tabular}\n",
        )
    )


def escape_latex(text: str) -> str:
    """Escape what LaTeX would take for its own."""
    return re.sub("|".join(map(re.escape, LATEX)), lambda match: LATEX[match[0]], text)
