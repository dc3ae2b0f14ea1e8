"""Small pieces of HTML: text in, text out, everything escaped. The page needs no script and no second file."""

import base64
import re
from collections.abc import Sequence
from html import escape

STYLE = """
:root { --ink: #1c2330; --soft: #5b6575; --line: #dfe3ea; --paper: #f4f5f8; --good: #1a7f4b; --bad: #b3261e; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.5 system-ui, "Segoe UI", Roboto, sans-serif; }
main { max-width: 1240px; margin: 0 auto; padding: 28px 20px 60px; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 4px; }
h2 { font-size: 1.15rem; margin: 0 0 4px; }
p { margin: 0 0 12px; max-width: 76ch; }
.soft, figcaption, small { color: var(--soft); }
td small { display: block; font-weight: 400; }
section { background: #fff; border: 1px solid var(--line); border-radius: 10px; padding: 18px 20px; margin-top: 18px; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(190px, 1fr)); gap: 12px; margin-top: 18px; }
.cards.many { grid-template-columns: repeat(auto-fit, minmax(300px, 1fr)); }
.card { line-height: 1.35; background: #fff; border: 1px solid var(--line); border-radius: 10px; padding: 14px 16px; }
.card b { display: block; font-size: 1.25rem; line-height: 1.5; font-variant-numeric: tabular-nums; white-space: nowrap; }
.card b i { font-style: normal; font-weight: 400; color: var(--soft); }
.good { color: var(--good); font-weight: 600; } .bad { color: var(--bad); font-weight: 600; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .94rem; font-variant-numeric: tabular-nums; margin: 8px 0; }
th, td { padding: 5px 12px 5px 0; text-align: right; vertical-align: top; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
thead th { font-weight: 600; vertical-align: bottom; } tbody th { font-weight: 400; min-width: 9em; }
th { white-space: normal; }
.real { color: #6b5a2b; background: #fbf7ea; padding-left: 12px; padding-right: 12px; }
.strong td, .strong th { font-weight: 650; }
table.montage td, table.montage th { border: 0; padding: 3px; text-align: center; vertical-align: top; font-size: .85rem; }
table.montage th:first-child { text-align: left; padding-right: 12px; vertical-align: middle; }
table.montage img { width: 164px; height: 164px; display: block; background: #000; border-radius: 4px; }
.row { display: flex; flex-wrap: wrap; gap: 12px 28px; align-items: flex-start; }
figure { margin: 8px 0; max-width: 100%; } figure img { max-width: 100%; height: auto; }
.key { display: inline-block; width: .8em; height: .8em; border-radius: 2px; margin: 0 .3em 0 .8em; }
details { margin-top: 8px; } summary { cursor: pointer; }
code, pre { font: .85rem/1.45 ui-monospace, Consolas, monospace; } pre { overflow-x: auto; margin: 6px 0; }
@media print { section, .card { break-inside: avoid; } body { background: #fff; } }
"""

ABREAST = 5  # cards that fit a row


def page(title: str, *body: str) -> str:
    """A complete document; `title` is plain text, `body` is HTML."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(body)
        + "\n</main>\n</body>\n</html>\n"
    )


def section(heading: str, lead: str, *body: str) -> str:
    """A part of the page with its heading and one sentence that says how to read it (both plain text)."""
    return (
        f"<section>\n<h2>{escape(heading)}</h2>\n<p class=soft>{escape(lead)}</p>\n" + "\n".join(body) + "\n</section>"
    )


def card(label: str, before: str, after: str, note: str, ok: bool | None = None) -> str:
    """A headline figure: what it is, its value before and after, and a note that says whether it clears its bar."""
    mark = {None: "", True: "<span class=good>passed</span> · ", False: "<span class=bad>missed</span> · "}[ok]
    arrow = f"<i>{escape(before)} &rarr;</i> " if before else ""
    value = f"<b>{arrow}{escape(after)}</b>"
    return f"<div class=card><span class=soft>{escape(label)}</span>{value}<small>{mark}{escape(note)}</small></div>"


def cards(*each: str) -> str:
    """In a row if they fit, else three abreast."""
    kind = '"cards many"' if len(each) > ABREAST else "cards"
    return f"<div class={kind}>\n" + "\n".join(each) + "\n</div>"


def table(
    head: Sequence[str], rows: Sequence[Sequence[str]], real: Sequence[int] = (), strong: Sequence[int] = ()
) -> str:
    """A table of HTML cells, the first of each row its heading; columns `real` are tinted, rows `strong` are bold."""
    top = "".join(f"<th{_tint(index in real)}>{cell}</th>" for index, cell in enumerate(head))
    lines = []
    for number, (first, *rest) in enumerate(rows):
        cells = "".join(f"<td{_tint(index in real)}>{cell}</td>" for index, cell in enumerate(rest, 1))
        lines.append(f"<tr{' class=strong' if number in strong else ''}><th>{first}</th>{cells}</tr>")
    body = "\n".join(lines)
    return f"<div class=wide><table><thead><tr>{top}</tr></thead><tbody>\n{body}\n</tbody></table></div>"


def _tint(real: bool) -> str:
    return " class=real" if real else ""


def drawing(svg: str, text: str) -> str:
    """An SVG as a picture, so that the names inside one drawing cannot meet those of another; `text` describes it."""
    address = "data:image/svg+xml;base64," + base64.b64encode(svg.encode()).decode()
    points = re.findall(r'(?:width|height)="([\d.]+)pt"', svg[: svg.index(">")])
    width, height = (round(float(size) * 4 / 3) for size in points)
    return f'<figure><img src="{address}" width={width} height={height} alt="{escape(text)}"></figure>'


def number(value: float | None, digits: int = 2) -> str:
    """Fixed digits; a dash where there is no value."""
    return "\u2013" if value is None else f"{value:.{digits}f}"


def spanned(value: float | None, interval: Sequence[float] | None, digits: int) -> str:
    """A figure with its interval below, as HTML; without one where there is none."""
    if value is None or interval is None:
        return number(value, digits)
    return f"{number(value, digits)} <small>[{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]</small>"
