"""Puts a result into docs/results: `python -m docs.keep NAME FILE`.

A file of several runs is made by
`python -m docs.keep NAME 'standard, seed 0=FILE' 'standard, seed 1=FILE'`.

A result that cannot be published is refused: one without a checksum or a commit, one of code that
was not committed, and one that names a path of one machine.

A result is stored on one line, as small as the pages allow (`shorten`). Left out are:

* digits after the sixth, but for settings;
* of a sweep: figures of a single shape; of code swaps, all but MS-SSIM; pins missed and pins too
  many; differences of the ridge and of code swaps between cells; the notes on metrics in all cells
  but the first, if they are equal;
* of the stability check: the Python text of each scene, which `verification/stability.py` has.

Nothing else changes, the command least of all. A new checksum seals what is left.

A picture, NAME.png, is stored with a palette of 128 colours: `python -m docs.keep NAME FILE.png`.
"""

import io
import json
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from docs.provenance import RESULTS, list_sources
from jaxunshear.errors import UserError
from jaxunshear.files import (
    CHECKSUM_FIELD,
    Json,
    add_checksum,
    read_object,
    write_bytes,
    write_text,
)
from jaxunshear.simulator.stimuli import SHAPES

MACHINE_PATH = re.compile(r"(?:^|[\s'=])/\w[\w.-]*/")
DIGITS = 6
SETTINGS = ("base", "settings")  # not rounded: a command must give them again
COLOURS = 128
# names of figures in the cells of a sweep, without the test before the colon
UNREAD = re.compile(r"pin_error/.*/(?:missed|extra)_per_image|(?:swap/)?D[CS]\(.*\)/(?:mse|ssim)")
UNREAD_DIFFERENCES = re.compile(r"(?:read|swap|pin_error)/.*")


def keep(name: str, files: Sequence[str], folder: Path = RESULTS) -> Path:
    """Write folder/<name>.json: FILE itself, or the files by label. Raises UserError."""
    if len(files) == 1 and files[0].endswith(".png"):
        return keep_picture(name, Path(files[0]), folder)
    out = folder / f"{name}.json"
    labelled = {}
    for each in files:
        label, _, file = each.rpartition("=")
        labelled[label] = Path(file)
    if len(labelled) < len(files) or ("" in labelled and len(files) > 1):
        raise UserError("several files need labels, each its own: LABEL=FILE LABEL=FILE")
    results = {label: _read_publishable(path) for label, path in labelled.items()}
    write_result(out, add_checksum(shorten(results.get("", {"runs": results}))))
    return out


def keep_picture(name: str, file: Path, folder: Path = RESULTS) -> Path:
    """Write folder/<name>.png with a palette."""
    out = folder / f"{name}.png"
    buffer = io.BytesIO()
    with Image.open(file) as picture:
        palette = picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    palette.save(buffer, "PNG", optimize=True)
    write_bytes(out, buffer.getvalue())
    return out


def write_result(path: Path, result: Json) -> None:
    """Write a result on one line."""
    write_text(path, json.dumps(result, separators=(",", ":")) + "\n")


def shorten(result: Json) -> Json:
    """Return a result without what no page reads; see the module's docstring."""
    short = _round(result)
    for cell in short.get("cells", []):
        for group in ("metrics", "difference", "ablation"):
            if group in cell:
                cell[group] = _select_figures(cell[group], group)
        if cell is not short["cells"][0] and cell["metric"] == short["cells"][0]["metric"]:
            del cell["metric"]
    for row in short.get("rows", []):
        row.pop("scene", None)
    return short


def _select_figures(figures: Json, group: str) -> Json:
    """Return the figures of a cell that a page may read."""
    selected = {}
    for name, figure in figures.items():
        test, colon, figure_name = name.rpartition(": ")
        of_shape = colon and test.rpartition(", ")[2] in SHAPES
        unread = UNREAD.fullmatch(figure_name)
        if group == "difference":
            unread = unread or UNREAD_DIFFERENCES.fullmatch(figure_name)
        if not of_shape and not unread:
            selected[name] = figure
    return selected


def _round(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, dict):
        return {name: each if name in SETTINGS else _round(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_round(each) for each in value]
    return value


def _read_publishable(path: Path) -> Json:
    result = read_object(path)
    if CHECKSUM_FIELD not in json.loads(path.read_text()):
        raise UserError(
            f"{path} bears no {CHECKSUM_FIELD}: it was edited, or is older than checksums; "
            "make it again"
        )
    sources = list_sources(result)
    if not sources or any(source.commit is None or not source.clean for source in sources):
        raise UserError(f"{path} was made with code that no commit has: commit, then make it again")
    if machine_path := next(filter(MACHINE_PATH.search, _list_texts(result)), None):
        raise UserError(
            f"{path} names a place of one machine, {machine_path}: "
            "make it again with paths from where you stand"
        )
    return result


def _list_texts(value: object) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _list_texts(each)


if __name__ == "__main__":
    try:
        print(keep(sys.argv[1], sys.argv[2:]))
    except (UserError, IndexError) as error:
        sys.exit(str(error) if isinstance(error, UserError) else __doc__)
