"""Outlines from files, and from signed distances that are functions of one's own.

>>> read_outline(Path("shapes/gear.svg"))                  # also .csv and .json; named by the file
>>> trace_outline("ring", lambda xy: np.hypot(*xy.T) - 12, within_mm=20)
"""

import re
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, cast
from xml.etree.ElementTree import Element

import numpy as np

from jaxunshear.config.stimuli import (
    ABS_FRICTION,
    Outline,
    Points,
    StimulusName,
    StimulusSetting,
    Target,
)
from jaxunshear.errors import UserError
from jaxunshear.files import read_json

FILES = (".svg", ".csv", ".json")
MM = {"mm": 1.0, "cm": 10.0, "in": 25.4}
SAMPLES = 64  # of a curved segment, before those that a straight line replaces are left out
CLOSE_MM = 0.01  # of that line to the curve: what the contact's grid resolves
GRID_MM = 0.25  # between the points at which a function is asked


def parse_stimulus(text: str) -> StimulusSetting:
    """What a text means where a stimulus is named: the outline in a file, or else a name, right or wrong. Raises UserError."""
    return (
        read_outline(Path(text)) if Path(text).suffix.lower() in FILES else cast(StimulusName, text)
    )


def read_outline(file: Path) -> Outline:
    """A drawing with one closed path, a table of x, y, or a JSON list of [x, y] or what an Outline takes, called as the file is.

    A drawing's unit is a mm, unless its width (mm, cm, in) and viewBox say otherwise; its y, which goes down, is turned up.
    Raises UserError.
    """
    if not file.is_file():
        raise UserError(
            f"outline {file} is no file: name a drawing (.svg) or points in mm (.csv, .json)"
        )
    fields = {".svg": _read_svg, ".csv": _read_table, ".json": _read_json}[file.suffix.lower()](
        file
    )
    try:
        return Outline(**{"name": file.stem, **fields})
    except UserError as error:
        raise UserError(f"{file}: {error}") from None


def trace_outline(
    name: str,
    distance: Callable[[np.ndarray], Any],
    within_mm: float,
    target: Target | None = None,
    friction: float = ABS_FRICTION,
) -> Outline:
    """The outline of a shape whose signed distance, negative inside, is a function of points (N, 2) mm -> (N,) mm.

    The shape must be one piece without holes, less than `within_mm` from the origin in x and y. Only where the function is zero matters:
    the settings hold those points, and no function. Raises UserError.
    """
    from skimage.measure import find_contours

    steps = max(round(2 * within_mm / GRID_MM), 8)
    line = np.linspace(-within_mm, within_mm, steps + 1)
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)
    values = np.asarray(distance(grid.reshape(-1, 2)), float)
    if values.shape != (len(line) ** 2,) or not np.isfinite(values).all():
        raise UserError(
            f"outline '{name}': its function must give one finite number for each row x, y"
        )
    values = values.reshape(len(line), -1)
    if min(values[[0, -1]].min(), values[:, [0, -1]].min()) <= 0:
        raise UserError(f"outline '{name}' goes beyond within_mm = {within_mm:g}: raise it")
    curves = find_contours(values, 0.0)
    if len(curves) != 1:
        what = f"has {len(curves)} outlines" if curves else "is nowhere negative"
        raise UserError(
            f"outline '{name}': its function {what} within {within_mm:g} mm: one piece without holes will do"
        )
    points = curves[0] * (2 * within_mm / steps) - within_mm
    return Outline(name, _plain(simplify_curve(points, CLOSE_MM)), target, friction)


def simplify_curve(closed: np.ndarray, close_mm: float) -> np.ndarray:
    """A closed curve (N, 2) without the points that lie this close to a straight line between others, and without its end."""
    from skimage.measure import approximate_polygon

    return approximate_polygon(np.vstack([closed, closed[:1]]), close_mm)[:-1]


def _plain(points: np.ndarray) -> Points:
    """To a hundredth of a micrometre: far below what a contact sees, and shorter to store."""
    return tuple((x, y) for x, y in np.round(points, 5).tolist())


def _read_table(file: Path) -> dict[str, Any]:
    try:
        lines = [line.strip() for line in file.read_text().splitlines()]
        rows = [re.split(r"[,;\s]+", line) for line in lines if line and not line.startswith("#")]
        rows = rows[1:] if rows and re.match(r"[A-Za-z]", rows[0][0]) else rows  # a head
        return {"points": tuple(tuple(float(value) for value in row) for row in rows)}
    except (OSError, ValueError) as error:
        raise UserError(
            f"outline {file} cannot be read ({error}): write x and y in mm, a point a line"
        ) from None


def _read_json(file: Path) -> dict[str, Any]:
    found = read_json(file)
    fields = found if isinstance(found, dict) else {"points": found}
    odd = sorted(fields.keys() - {"name", "points", "target", "friction"})
    if odd or "points" not in fields:
        raise UserError(
            f"outline {file} must be a list of [x, y], or have points, and may have name, target, friction"
        )
    return fields


def _read_svg(file: Path) -> dict[str, Any]:
    from fontTools.pens.recordingPen import RecordingPen
    from fontTools.svgLib.path import SVGPath

    pen = RecordingPen()
    try:
        drawing = SVGPath(str(file))
        scale = _mm_a_unit(drawing.root)
        drawing.draw(pen)
        curves = [curve for curve in _curves(pen.value) if len(curve) > 1]
    except Exception as error:  # of the XML parser, or of any path in it
        raise UserError(
            f"outline {file} is no drawing that can be read ({' '.join(str(error).split())})"
        ) from None
    if any("transform" in part.attrib for part in drawing.root.iter()):
        raise UserError(
            f"outline {file} has transforms: apply them in the drawing program, as by ungrouping"
        )
    if len(curves) != 1:
        raise UserError(
            f"outline {file} has {len(curves)} paths: leave the one that goes around the shape"
        )
    return {"points": _plain(simplify_curve(curves[0] * [scale, -scale], CLOSE_MM))}


def _mm_a_unit(root: Element) -> float:
    """Raises ValueError."""
    width = re.fullmatch(r"\s*([0-9.eE+-]+)\s*(mm|cm|in)\s*", root.attrib.get("width", ""))
    if not width or "viewBox" not in root.attrib:
        return 1.0
    return (
        float(width[1])
        * MM[width[2]]
        / float(re.split(r"[,\s]+", root.attrib["viewBox"].strip())[2])
    )


def _curves(drawn: list[tuple[str, tuple]]) -> Iterator[np.ndarray]:
    """Points of each path (N, 2), in the drawing's units; `drawn` is what fontTools records."""
    share = np.linspace(0, 1, SAMPLES + 1)[1:, None]
    points: list[np.ndarray] = []
    for word, given in drawn:
        if word == "moveTo":
            points = [np.array(given, float)]
        elif word in ("endPath", "closePath"):
            yield np.vstack(points)
        else:  # a line, or a curve of Bezier, by de Casteljau
            ends = [np.tile(end, (SAMPLES, 1)) for end in (points[-1][-1], *np.array(given, float))]
            while len(ends) > 1:
                ends = [(1 - share) * a + share * b for a, b in pairwise(ends)]
            points.append(ends[0] if len(given) > 1 else np.array(given, float))
