"""Turns drawn outlines into stimuli, and stimuli into outlines to draw.

>>> stimulus = make_drawn_stimulus(np.array([[0.0, 0.0], [20.0, 0.0], [10.0, 15.0]]))
>>> lines = trace_outlines(stimulus, 32.0)                   # each (K, 2) mm in the target frame
"""

from functools import lru_cache, partial

import jax
import numpy as np
from skimage.measure import find_contours

from jaxunshear.config.outlines import simplify_curve
from jaxunshear.config.stimuli import Outline
from jaxunshear.simulator.stimuli import Stimulus, compute_signed_distance, make_stimulus

DRAWN_NAME = "drawn"
TREMBLE_MM = 0.15  # by which a hand's line is smoothed
GRID_MM = 0.4  # between the points that outlines are sought from


def make_drawn_stimulus(points: np.ndarray) -> Stimulus:
    """Make a stimulus of a closed curve through points (N, 2) mm of the target frame.

    Raises UserError if the points are no outline.
    """
    points = np.asarray(points, float).reshape(-1, 2)
    is_curve = len(points) and np.isfinite(points).all()
    corners = simplify_curve(points, TREMBLE_MM) if is_curve else points
    return make_stimulus(Outline(DRAWN_NAME, tuple(map(tuple, corners)), target=(0.0, 0.0, 0.0)))


@lru_cache(maxsize=32)
def trace_outlines(stimulus: Stimulus, half_mm: float) -> tuple[np.ndarray, ...]:
    """Trace the shape's edge within `half_mm` of its target point.

    Returns closed curves (K, 2) mm, cut at the border.
    """
    steps = round(2 * half_mm / GRID_MM)
    line = np.linspace(-half_mm, half_mm, steps + 1)
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), -1)
    compute_distance = jax.jit(partial(compute_signed_distance, stimulus))
    distances = np.asarray(compute_distance(grid.astype(np.float32)))
    distances = np.pad(distances, 1, constant_values=1.0)  # closes what goes on beyond the border
    curves = find_contours(distances, 0.0)
    return tuple((curve - 1) * (2 * half_mm / steps) - half_mm for curve in curves)
