"""Puts a result into docs/results: `python -m docs.keep NAME FILE`.

A file of several runs is made by
`python -m docs.keep NAME 'standard, seed 0=FILE' 'standard, seed 1=FILE'`.

A result that cannot be published is refused: one without a checksum or a commit, one of code that
was not committed, and one that names a path of one machine.

A result is stored on one line, with what pages show and quote (`shorten`). Left out are:

* digits after the sixth, but for settings;
* of a sweep: figures of a single shape, and those of UNREAD; seeds of all figures but SEEDED;
  UNREAD_COSTS; the notes on metrics in all cells but the first, if they are equal;
* of a run: errors by shape and depth; further tests, but not the tests of a run about tasks;
* of rows: UNREAD_FIELDS, as the meaning of a measure, which the code has.

Nothing else changes, the command least of all. A new checksum seals what is left.

A picture, NAME.png, is stored with a palette of 32 colours, at most 800 px wide:
`python -m docs.keep NAME FILE.png`.
"""

import io
import json
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from docs.provenance import RESULTS, list_parts, list_sources
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
GROUPS = {"metrics", "difference", "ablation"}  # of figures, in a cell
SETTINGS = ("base", "settings")  # not rounded: a command must give them again
COLOURS = 32
MOST_WIDTH_PX = 800
# names of figures in the cells of a sweep, without the test before the colon
UNREAD = re.compile(
    r"pin_error/(true_slide/.*|tap/rms_mm|.*/(missed|extra)_per_image)"
    r"|(swap/)?D[CS]\(.*\)/(mse|ssim).*|.* \(linear\)/.*"
    r"|(half_width|coverage)/(tap|sheared|partner)/.*|(pose_recovery|read/\w+)/partner/.*"
)
UNREAD_IN_TESTS = re.compile(r"(read/pins|swap)/.*")  # of further tests
UNREAD_DIFFERENCES = re.compile(r"(read|swap|pin_error)/.*|(\w+/)+(tap|sheared)(/.*)?")
SEEDED = re.compile(r"(pose|pins|coverage|difference|ms_ssim)/.*")
UNREAD_COSTS = ("images_per_second", "peak_memory_bytes", "device", "host", "p95")
UNREAD_PARTS = ("pose_by_stimulus", "pose_by_depth", "tests", "efficient")
UNREAD_FIELDS = ("scene", "metric", "sense", "iou_felt", "height_rms_mm", "level", "object", "way")


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
        small = picture.convert("RGB")
        small.thumbnail((MOST_WIDTH_PX, 10 * MOST_WIDTH_PX), Image.Resampling.LANCZOS)
        palette = small.quantize(COLOURS, dither=Image.Dither.NONE)
    palette.save(buffer, "PNG", optimize=True)
    write_bytes(out, buffer.getvalue())
    return out


def write_result(path: Path, result: Json) -> None:
    """Write a result on one line."""
    write_text(path, json.dumps(result, separators=(",", ":")) + "\n")


def shorten(result: Json) -> Json:
    """Return a result without what no page reads; see the module's docstring."""
    unread = set(UNREAD_PARTS) - ({"tests"} if result.get("frames") else set())
    short = {name: value for name, value in _round(result).items() if name not in unread}
    cells = short.get("cells", [])
    for cell in cells:
        for group in GROUPS & cell.keys():
            cell[group] = _select_figures(cell[group], group)
        cell["costs"] = _drop_fields(cell.get("costs", {}), UNREAD_COSTS)
        if cell is not cells[0] and cell.get("metric") == cells[0].get("metric"):
            cell.pop("metric", None)
    for part in list_parts(short):
        if "rows" in part:
            part["rows"] = [_drop_fields(row, UNREAD_FIELDS) for row in part["rows"]]
    return short


def _drop_fields(record: Json, names: Sequence[str]) -> Json:
    """Return a record without these fields, however deep they lie."""
    return {
        name: _drop_fields(value, names) if isinstance(value, dict) else value
        for name, value in record.items()
        if name not in names
    }


def _select_figures(figures: Json, group: str) -> Json:
    """Return the figures of a cell that a page may read."""
    selected = {}
    for name, figure in figures.items():
        test, _, figure_name = name.rpartition(": ")
        unread = [UNREAD]
        if test:
            unread.append(UNREAD_IN_TESTS)
        if group == "difference":
            unread.append(UNREAD_DIFFERENCES)
        of_shape = test.rpartition(", ")[2] in SHAPES
        if of_shape or any(pattern.fullmatch(figure_name) for pattern in unread):
            continue
        if group == "difference" or (group == "metrics" and not SEEDED.fullmatch(figure_name)):
            figure.pop("per_seed", None)
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
