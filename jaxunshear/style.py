"""The style of figures. Imports no Matplotlib."""

import contextlib
import io
from collections.abc import Iterator
from contextvars import ContextVar
from textwrap import wrap
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxunshear.config.networks import (
    DISENTANGLED,
    ENTANGLED,
    ENTANGLED_LARGE,
    POSENET,
    POSENET_SHEARED,
    UNET,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

INK, FAINT = "#1c2330", "#8a93a3"
COLOURS = {
    DISENTANGLED: "#1f6feb",
    ENTANGLED: "#d9822b",
    ENTANGLED_LARGE: "#b3554d",
    UNET: "#8250df",
    POSENET: "#2a9d6f",
    POSENET_SHEARED: "#7c8b3d",
}
STYLE: Any = {  # Any, as matplotlib types the names as a closed list
    "svg.hashsalt": "jaxunshear",
    "svg.fonttype": "none",  # text stays text: small, and set in the reader's font
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.titlesize": 10,
    "text.color": INK,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.grid": True,
    "grid.color": "#e6e9ef",
    "axes.axisbelow": True,
    "legend.frameon": False,
}
# panels side by side, and their size, such that a page shows a picture at full size
ABREAST, PANEL_IN, DPI = 3, 3.5, 110
HEAD, LABEL = 9, 8  # points, of titles and of smaller text


def wrap_title(text: str, columns: int) -> str:
    """Wrap a title to the width of `columns` panels."""
    return "\n".join(wrap(text, 48 * columns))


class DrawnFigure(NamedTuple):
    """A figure, and its SVG or PNG."""

    encoded: bytes
    figure: "Figure"


_drawn: ContextVar[list[DrawnFigure] | None] = ContextVar("drawn", default=None)


@contextlib.contextmanager
def collect_figures() -> Iterator[list[DrawnFigure]]:
    """Collect the figures that are encoded within this context."""
    drawn: list[DrawnFigure] = []
    token = _drawn.set(drawn)
    try:
        yield drawn
    finally:
        _drawn.reset(token)


def _collect(encoded: bytes, figure: "Figure") -> None:
    if (drawn := _drawn.get()) is not None:
        drawn.append(DrawnFigure(encoded, figure))


def encode_png(figure: "Figure", software: str = "") -> bytes:
    """Encode a PNG without the version of Matplotlib: the same drawing gives the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": software})
    _collect(buffer.getvalue(), figure)
    return buffer.getvalue()


def encode_svg(figure: "Figure") -> str:
    """Encode a figure as an SVG without its date: the same drawing gives the same text."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    text = buffer.getvalue()
    svg = text[text.index("<svg") :]
    _collect(svg.encode(), figure)
    return svg


def label_log_axis(axis: "Axis") -> None:
    """Label a logarithmic axis, whose data are drawn, with plain numbers."""
    import numpy as np
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

    low, high = axis.get_view_interval()
    steps = [1, 2, 5, 10]
    # 1, 2, 5, 10 would leave a shorter axis with a label or none
    axis.set_major_locator(
        LogLocator(subs=(1, 2, 5)) if high > 5 * low else MaxNLocator(4, steps=steps)
    )
    axis.set_major_formatter(
        FuncFormatter(lambda value, _: np.format_float_positional(float(f"{value:.6g}"), trim="-"))
    )
    axis.set_minor_formatter(NullFormatter())


def make_panels(
    count: int,
    columns: int,
    panel_in: tuple[float, float],
    title_in: float = 0.0,
    dpi: float | None = None,
) -> "tuple[Figure, list[Axes]]":
    """Make a figure of `count` panels in rows of `columns`; the last row may have blanks."""
    from matplotlib.figure import Figure

    rows = -(-count // columns)
    width, height = panel_in
    size = (width * columns, height * rows + title_in)
    figure = Figure(figsize=size, layout="constrained", dpi=dpi)
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes in panels[count:]:
        axes.set_axis_off()
    return figure, panels[:count]
