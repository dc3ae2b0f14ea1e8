"""Plots of a page as PDF files, for a paper.

>>> with collect_figures() as drawn:
...     page = write_report(run_dir)
>>> write_figures(page, drawn, Path("figures"))
"""

import base64
import io
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

from jaxunshear.files import write_bytes
from jaxunshear.style import DrawnFigure


class _PictureParser(HTMLParser):
    """Collects the pictures of a page: the id of the heading above each, and its bytes."""

    def __init__(self) -> None:
        super().__init__()
        self.pictures: list[tuple[str, bytes]] = []
        self.heading = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "h2":
            self.heading = dict(attrs).get("id") or ""
        elif tag == "img":
            _, is_inlined, content = (dict(attrs).get("src") or "").partition(";base64,")
            if is_inlined:
                self.pictures.append((self.heading, base64.b64decode(content)))


def write_figures(page: Path, drawn: Sequence[DrawnFigure], folder: Path) -> list[Path]:
    """Write every plot of a page into a folder, as NAME.pdf; return the files.

    NAME is the heading above the plot, with a number if there are several. `drawn` are the figures
    that were drawn for the page. Pictures of pixels, such as the montage, are not among them.
    """
    figures = {each.encoded: each.figure for each in drawn}
    parser = _PictureParser()
    parser.feed(page.read_text())
    written = []
    names: dict[str, int] = {}
    for heading, encoded in parser.pictures:
        if encoded not in figures:
            continue
        names[heading] = count = names.get(heading, 0) + 1
        path = folder / f"{heading or 'figure'}{f'-{count}' if count > 1 else ''}.pdf"
        write_bytes(path, encode_pdf(figures[encoded]))
        written.append(path)
    return written


def encode_pdf(figure: Figure) -> bytes:
    """Encode a figure as a PDF without its date: the same drawing gives the same bytes."""
    buffer = io.BytesIO()
    with rc_context({"pdf.fonttype": 42}):  # text stays text, which journals ask for
        figure.savefig(buffer, format="pdf", metadata={"CreationDate": None})
    return buffer.getvalue()
