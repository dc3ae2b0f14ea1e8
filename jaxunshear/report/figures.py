"""Panels and formats that the figures of reports share."""

import io

from matplotlib.axes import Axes
from matplotlib.figure import Figure


def make_panels(
    count: int,
    columns: int,
    panel_in: tuple[float, float],
    title_in: float = 0.0,
    dpi: float | None = None,
) -> tuple[Figure, list[Axes]]:
    """Make a figure of `count` panels in rows of `columns`; the last row may have blanks."""
    rows = -(-count // columns)
    width, height = panel_in
    size = (width * columns, height * rows + title_in)
    figure = Figure(figsize=size, layout="constrained", dpi=dpi)
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes in panels[count:]:
        axes.set_axis_off()
    return figure, panels[:count]


def encode_svg(figure: Figure) -> str:
    """Encode a figure as an SVG without its date: the same drawing gives the same text."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    text = buffer.getvalue()
    return text[text.index("<svg") :]
