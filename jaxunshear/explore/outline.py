"""Outlines of shapes: those that a hand draws become stimuli, and those of stimuli become lines to draw.

>>> stimulus = drawn(np.array([[0.0, 0.0], [20.0, 0.0], [10.0, 15.0]]))
>>> lines = outlines(stimulus, 32.0)                   # each (K, 2) mm in the target frame
"""

from functools import lru_cache, partial

import jax
import numpy as np
from skimage.measure import approximate_polygon, find_contours

from jaxunshear.errors import UserError
from jaxunshear.scene.shapes import polygon
from jaxunshear.scene.stimuli import Stimulus, signed_distance

DRAWN = "drawn"
TREMBLE_MM = 0.15  # by which a hand's line is smoothed
SMALLEST_MM2 = 9.0  # a shape of 3 mm; the contact's edges are rounded by 1 mm
MOST_CORNERS = 400
GRID_MM = 0.4  # between the points that outlines are sought from


def drawn(points: np.ndarray) -> Stimulus:
    """A closed curve through points (N, 2) mm of the target frame as a stimulus. Raises UserError where it is none."""
    points = np.asarray(points, float).reshape(-1, 2)
    if not np.isfinite(points).all():
        raise UserError("the drawn outline: its points are not finite")
    if len(points) < 3:
        raise UserError("the drawn outline is a point or a line: draw around an area")
    corners = approximate_polygon(np.vstack([points, points[:1]]), TREMBLE_MM)[:-1]
    x, y = corners.T
    if len(corners) < 3 or abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2 < SMALLEST_MM2:
        raise UserError(f"the drawn outline encloses less than {SMALLEST_MM2:g} mm²: draw a larger one")
    if len(corners) > MOST_CORNERS:
        raise UserError(f"the drawn outline has {len(corners)} corners: draw one of at most {MOST_CORNERS}")
    if _crosses(corners):
        raise UserError("the drawn outline crosses itself: draw one that does not")
    return Stimulus(DRAWN, polygon(corners), (0.0, 0.0, 0.0), float(np.linalg.norm(corners, axis=-1).max()))


def _crosses(corners: np.ndarray) -> bool:
    """Whether any two sides of a closed polygon (V, 2) that are not neighbours meet."""
    start, end = corners, np.roll(corners, -1, axis=0)

    def side(of: np.ndarray) -> np.ndarray:
        """(V, V): on which side of each line (first index) a point of each other side lies."""
        along, to = (end - start)[:, None], of[None] - start[:, None]
        return np.sign(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])

    apart = side(start) * side(end) <= 0
    number = np.arange(len(corners))
    gap = np.abs(number[:, None] - number)
    neighbours = (gap <= 1) | (gap == len(corners) - 1)
    return bool(np.any(apart & apart.T & ~neighbours))


@lru_cache(maxsize=32)
def outlines(stimulus: Stimulus, half_mm: float) -> tuple[np.ndarray, ...]:
    """Where the shape's edge runs within `half_mm` of its target point: closed curves around it, cut at the border, (K, 2) mm each."""
    steps = round(2 * half_mm / GRID_MM)
    line = np.linspace(-half_mm, half_mm, steps + 1)
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), -1)
    inside = np.asarray(jax.jit(partial(signed_distance, stimulus))(grid.astype(np.float32)))
    inside = np.pad(inside, 1, constant_values=1.0)  # so that what goes on beyond is closed, too
    curves = find_contours(inside, 0.0)
    return tuple((curve - 1) * (2 * half_mm / steps) - half_mm for curve in curves)
