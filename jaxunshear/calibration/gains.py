"""What a refit changed, and what each change alone gains on contacts that it never saw."""

from dataclasses import replace
from typing import NamedTuple

from jaxunshear.calibration.calibrated import Calibrated, value_of, with_value
from jaxunshear.calibration.folders import Aligned, Folder, align, compare, frame_names
from jaxunshear.calibration.held_out import among
from jaxunshear.calibration.labels import Frame
from jaxunshear.calibration.refit import UNITS, Point, refit, slopes_of
from jaxunshear.calibration.validation import KINDS, Compared, Row, rows_of
from jaxunshear.progress import Progress
from jaxunshear.storage import Json


class Scored(NamedTuple):
    """A folder, how it is aligned, and its contacts compared."""

    folder: Folder
    aligned: Aligned
    compared: Compared


def refitted(
    folders: list[Folder], before: Calibrated, used: tuple[str, ...], aligned: list[Aligned], as_labelled: bool
) -> Point:
    """`before`, refitted to the images that align the folders, which its `used` names beside those given, and the frames."""
    framed = frame_names(as_labelled)
    with Progress("refit", slopes_of(len(folders), framed=framed), unit="slopes") as progress:
        matters, frames = [folder.matter for folder in folders], [one.frame for one in aligned]
        found = refit(matters, before, frames, framed=framed, advance=progress.advance)
        progress.advance(progress.total - progress.done)
    names = [name for folder in folders for name in folder.aligned_by]
    fresh = [name for name, seen in zip(names, among(names, used), strict=True) if not seen]
    return found._replace(known=replace(found.known, name=f"{before.name}, refitted", used=(*used, *fresh)))


def gains(
    before: list[Scored], after: list[Scored], calibrated: Calibrated, known: Calibrated, as_labelled: bool
) -> list[Row]:
    """Values before (`calibrated`) and after the refit (`known`), and R2 gained on compared contacts: by each value alone with the
    frame found anew, by finding the frame (`frame`, before the refit), and by all together."""
    first, last = _r2([part.compared for part in before]), _r2([part.compared for part in after])
    rows = [_row(f"before.r2.{kind}", *first[kind]) for kind in first]
    for name, unit in UNITS.items():
        rows += [
            {"name": f"{when}.{name}", "unit": unit, "value": value_of(one, name), "contacts": None}
            for when, one in (("before", calibrated), ("after", known))
        ]
    frames = [part.aligned.frame for part in before]
    with Progress("gains", len(UNITS), unit="values") as progress:
        for name in UNITS:
            alone = with_value(calibrated, name, value_of(known, name))
            rows += _gained(name, first, _r2(_compared(before, alone, as_labelled, frames)))
            progress.advance()
    if not as_labelled:
        begin = [part.folder.start for part in before]
        rows += _gained("frame", _r2(_compared(before, calibrated, True, begin)), first)
    return rows + _gained("all", first, last)


def gains_table(rows: list[Row]) -> str:
    """A line for each value: before, after, and what it gains alone."""
    from jaxunshear.table import plain_table

    known = {str(row["name"]): row["value"] for row in rows}
    lines: list[Json] = []
    for name in (*UNITS, "frame", "all"):
        line = {"changed": name, "before": known.get(f"before.{name}"), "after": known.get(f"after.{name}")}
        reported = {f"r2 gained, {kind}s": known.get(f"gain.r2.{kind}.{name}") for kind in KINDS}
        lines += [line | reported] if any(value is not None for value in reported.values()) else []
    return plain_table(lines, ("changed", "before", "after", *(f"r2 gained, {kind}s" for kind in KINDS)))


Scores = dict[str, tuple[float, int]]  # of taps and slides: R2, contacts


def _compared(parts: list[Scored], known: Calibrated, as_labelled: bool, begin: list[Frame]) -> list[Compared]:
    found = []
    for part, frame in zip(parts, begin, strict=True):
        compared, _ = compare(part.folder, align(part.folder, known, as_labelled, frame), known)
        found += [] if compared is None else [compared]
    return found


def _r2(parts: list[Compared]) -> Scores:
    rows = {str(row["name"]): row for row in rows_of(parts)}
    found = {kind: rows[f"r2.{kind}"] for kind in KINDS if f"r2.{kind}" in rows}
    return {kind: (float(row["value"] or 0), int(row["contacts"] or 0)) for kind, row in found.items()}


def _row(name: str, value: float, contacts: int) -> Row:
    return {"name": name, "unit": "1", "value": value, "contacts": contacts}


def _gained(name: str, first: Scores, last: Scores) -> list[Row]:
    both = [kind for kind in first if kind in last]
    return [_row(f"gain.r2.{kind}.{name}", last[kind][0] - first[kind][0], last[kind][1]) for kind in both]
