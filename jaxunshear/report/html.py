"""HTML pieces of a page, from the macros in page.html.

All text is escaped; only `Markup` is taken as HTML.
"""

import base64
import html
import re
from collections.abc import Callable, Iterable, Mapping

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from jaxunshear.perception.drawing import encode_png
from jaxunshear.results.run import Scores, Span

SMALLEST = 9  # level of zlib
_ENVIRONMENT = Environment(
    loader=PackageLoader("jaxunshear", "report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
)
_MACROS = _ENVIRONMENT.get_template("page.html").module


def get_macro(name: str) -> Callable[..., Markup]:
    """Return a macro of page.html."""
    return getattr(_MACROS, name)


page, opening, contents, compared = map(get_macro, ("page", "opening", "contents", "compared"))
section, card, cards, table = map(get_macro, ("section", "card", "cards", "table"))
montage, caption, figure = map(get_macro, ("montage", "caption", "figure"))
folded, listed, row, soft, code = map(get_macro, ("folded", "listed", "row", "soft", "code"))
recovery = get_macro("recovery")


def build_contents(sections: Iterable[Markup]) -> Markup:
    """Build links to the headings of sections."""
    headings = re.findall(r'<h2 id="(.*?)">(.*?)</h2>', "".join(sections))
    return contents([(html.unescape(place), html.unescape(heading)) for place, heading in headings])


def embed_svg(svg: str, text: str) -> Markup:
    """Embed an SVG as an image that `text` describes.

    The names inside two drawings cannot collide then.
    """
    address = "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()
    points = re.findall(r'(?:width|height)="([\d.]+)pt"', svg[: svg.index(">")])
    return figure(address, text, [round(float(size) * 4 / 3) for size in points])


def make_png_address(png: bytes) -> str:
    """Return a `data:` address of a PNG, so that the page needs no second file."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


def encode_pixels(pixels: np.ndarray) -> str:
    """Return a `data:` address of a PNG of pixels (H, W) or (H, W, 3) uint8."""
    return make_png_address(encode_png(pixels, SMALLEST))


def format_number(value: float | None, digits: int = 2) -> str:
    """Format a number with fixed digits; a dash stands for no value."""
    return "\u2013" if value is None else f"{value:.{digits}f}"


def format_with_interval(value: float | None, interval: Span, digits: int) -> str:
    """Format a number above its interval, if it has one."""
    if value is None or interval is None:
        return format_number(value, digits)
    low, high = format_number(interval[0], digits), format_number(interval[1], digits)
    return Markup("{} <small>[{}, {}]</small>").format(format_number(value, digits), low, high)


def format_cells(
    values: Scores, intervals: Mapping[str, Span], digits: Mapping[str, int]
) -> list[str]:
    """Format the cells of a table's row: a number and its interval for each name in `digits`."""
    return [
        format_with_interval(values.get(name), intervals.get(name), count)
        for name, count in digits.items()
    ]


def format_paper_cells(values: Scores, names: Iterable[str]) -> list[str]:
    """Format the cells of a table's row with the paper's figures."""
    return [format_number(values.get(name)) for name in names]


def format_paper_headings(headings: Iterable[str]) -> list[Markup]:
    """Format the headings of columns with the paper's figures."""
    return [Markup("{}<br>paper").format(heading) for heading in headings]
