"""Read outlines from files, and trace them from functions that give signed distances.

>>> read_outline(Path("shapes/gear.svg"))  # also .csv and .json; the file gives the name
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
from jaxunshear.files import explain_no_content, explain_os_error, read_json, read_points

FILES = (".svg", ".csv", ".json")
MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "in": 25.4}
SAMPLES = 64  # of a curved segment, before `simplify_curve` drops most of them
TOLERANCE_MM = 0.01  # of a simplified curve: what the contact's grid resolves
GRID_MM = 0.25  # spacing of the points at which a function is evaluated


def parse_stimulus(text: str) -> StimulusSetting:
    """Read the outline if a text names a file of one; else return the text, which must be a name.

    Raises UserError.
    """
    if Path(text).suffix.lower() in FILES:
        return read_outline(Path(text))
    return cast(StimulusName, text)


def read_outline(file: Path) -> Outline:
    """Read a drawing with one closed path, a table of x, y, or a JSON file. Raises UserError.

    The file gives the name. JSON is a list of [x, y], or an object with the fields of an Outline.
    A drawing's unit is a mm, unless its width (mm, cm, in) and viewBox say otherwise; its y, which
    goes down, is flipped.
    """
    if not file.is_file():
        raise UserError(
            f"outline {file} is no file: name a drawing (.svg) or points in mm (.csv, .json)"
        )
    try:
        reason = explain_no_content(file.read_bytes())
    except OSError as error:
        raise explain_os_error(file, error, "read") from error
    if reason:
        raise UserError(f"outline {file} cannot be read: {reason}")
    readers = {".svg": _read_svg, ".csv": _read_table, ".json": _read_json}
    fields = readers[file.suffix.lower()](file)
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
    """Trace the outline of a shape from its signed distance. Raises UserError.

    The settings hold the points where `distance` is zero, and no function.

    Args:
        distance: a function of points (N, 2) mm -> (N,) mm, negative inside.
        within_mm: the shape, one piece without holes, is less than this from the origin in x and y.
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
        problem = f"has {len(curves)} outlines" if curves else "is nowhere negative"
        raise UserError(
            f"outline '{name}': its function {problem} within {within_mm:g} mm: "
            "one piece without holes will do"
        )
    points = curves[0] * (2 * within_mm / steps) - within_mm
    return Outline(name, _to_points(simplify_curve(points, TOLERANCE_MM)), target, friction)


def simplify_curve(closed: np.ndarray, tolerance_mm: float) -> np.ndarray:
    """Drop points of a closed curve (N, 2) that are this close to a line between the others.

    The end, which repeats the start, is dropped, too.
    """
    from skimage.measure import approximate_polygon

    return approximate_polygon(np.vstack([closed, closed[:1]]), tolerance_mm)[:-1]


def _to_points(curve: np.ndarray) -> Points:
    """Round to 1e-5 mm, which is far below what a contact shows, and shorter to store."""
    return tuple((x, y) for x, y in np.round(curve, 5).tolist())


def _read_table(file: Path) -> dict[str, Any]:
    try:
        points = tuple(map(tuple, read_points(file)))
    except (OSError, ValueError) as error:
        raise UserError(
            f"outline {file} cannot be read ({error}): write x and y in mm, a point a line"
        ) from None
    return {"points": points}


def _read_json(file: Path) -> dict[str, Any]:
    stored = read_json(file)
    fields = stored if isinstance(stored, dict) else {"points": stored}
    if "points" not in fields or not fields.keys() <= {"name", "points", "target", "friction"}:
        raise UserError(
            f"outline {file} must be a list of [x, y], or have points, "
            "and may have name, target, friction"
        )
    return fields


def _read_svg(file: Path) -> dict[str, Any]:
    from fontTools.pens.recordingPen import RecordingPen
    from fontTools.svgLib.path import SVGPath

    pen = RecordingPen()
    try:
        drawing = SVGPath(str(file))
        scale = _compute_scale(drawing.root)
        drawing.draw(pen)
        curves = [curve for curve in _sample_paths(pen.value) if len(curve) > 1]
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
    return {"points": _to_points(simplify_curve(curves[0] * [scale, -scale], TOLERANCE_MM))}


def _compute_scale(root: Element) -> float:
    """Compute the mm of a drawing's unit. Raises ValueError."""
    width = re.fullmatch(r"\s*([0-9.eE+-]+)\s*(mm|cm|in)\s*", root.attrib.get("width", ""))
    if not width or "viewBox" not in root.attrib:
        return 1.0
    units = float(re.split(r"[,\s]+", root.attrib["viewBox"].strip())[2])
    return float(width[1]) * MM_PER_UNIT[width[2]] / units


def _sample_paths(commands: list[tuple[str, tuple]]) -> Iterator[np.ndarray]:
    """Yield points (N, 2) of each path that fontTools has recorded, in the drawing's units."""
    points: list[np.ndarray] = []
    for command, arguments in commands:
        if command in ("endPath", "closePath"):
            yield np.vstack(points)
            continue
        corners = np.array(arguments, float)
        if command == "moveTo":
            points = [corners]
        elif len(corners) == 1:  # a line
            points.append(corners)
        else:
            points.append(_sample_bezier(points[-1][-1], corners))


def _sample_bezier(start: np.ndarray, controls: np.ndarray) -> np.ndarray:
    """Sample a Bezier curve (SAMPLES, 2) by de Casteljau's algorithm, without its start."""
    share = np.linspace(0, 1, SAMPLES + 1)[1:, None]
    ends = [np.tile(end, (SAMPLES, 1)) for end in (start, *controls)]
    while len(ends) > 1:
        ends = [(1 - share) * a + share * b for a, b in pairwise(ends)]
    return ends[0]
