"""How figures are styled. Imports no Matplotlib."""

from textwrap import wrap
from typing import Any

from jaxunshear.settings.registry import DISENTANGLED, ENTANGLED, ENTANGLED_LARGE, POSENET, POSENET_SHEARED, UNET

INK, FAINT = "#1c2330", "#8a93a3"
COLOURS = {
    DISENTANGLED: "#1f6feb",
    ENTANGLED: "#d9822b",
    ENTANGLED_LARGE: "#b3554d",
    UNET: "#8250df",
    POSENET: "#2a9d6f",
    POSENET_SHEARED: "#7c8b3d",
}
STYLE: Any = {  # the names are a closed list of matplotlib's
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
ABREAST, PANEL_IN, DPI = 3, 3.5, 110  # panels side by side: what a report's page shows without making them smaller
HEAD, LABEL = 9, 8  # points: of titles, and of all that is smaller


def headed(text: str, columns: int) -> str:
    """A title over `columns` panels, in as many lines as it takes."""
    return "\n".join(wrap(text, 48 * columns))
