"""Small pieces of HTML, of the macros in page.html: text in, HTML out. All text is escaped; only `Markup` is taken for HTML."""

import base64
import re
from collections.abc import Callable, Sequence

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

_ENVIRONMENT = Environment(
    loader=PackageLoader("jaxunshear", "report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
)
_MACROS = _ENVIRONMENT.get_template("page.html").module


def _piece(name: str) -> Callable[..., Markup]:
    return getattr(_MACROS, name)


page, opening, section = _piece("page"), _piece("opening"), _piece("section")
compared = _piece("compared")
card, cards, table = _piece("card"), _piece("cards"), _piece("table")
montage, caption, figure = _piece("montage"), _piece("caption"), _piece("figure")
folded, listed, row, soft, code = map(_piece, ("folded", "listed", "row", "soft", "code"))


def embed_svg(svg: str, text: str) -> Markup:
    """An SVG as a picture, so that the names inside one drawing cannot meet those of another; `text` describes it."""
    address = "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()
    points = re.findall(r'(?:width|height)="([\d.]+)pt"', svg[: svg.index(">")])
    return figure(address, text, [round(float(size) * 4 / 3) for size in points])


def format_number(value: float | None, digits: int = 2) -> str:
    """Fixed digits; a dash where there is no value."""
    return "\u2013" if value is None else f"{value:.{digits}f}"


def format_with_interval(value: float | None, interval: Sequence[float] | None, digits: int) -> str:
    """A figure with its interval below; without one where there is none."""
    if value is None or interval is None:
        return format_number(value, digits)
    low, high = (format_number(end, digits) for end in interval)
    return Markup("{} <small>[{}, {}]</small>").format(format_number(value, digits), low, high)


def address_of(png: bytes) -> str:
    """Return a `data:` address of a PNG, so that the page needs no second file."""
    return "data:image/png;base64," + base64.b64encode(png).decode()
