"""Add simulated slides to recorded taps, from the labels of the taps alone.

view = fit_label_view(taps, lattice, size, calibration)
motion, converged = simulate_shear(view, taps.pose, moves, friction)  # (N, P, 2) px, slide less tap

Only the difference of two simulated contacts is used, so errors of the simulator that a tap and a
slide share do not enter.
"""

from typing import NamedTuple

import numpy as np

from jaxunshear.calibration.alignment import Alignment, align
from jaxunshear.calibration.pin_statistics import compute_camera_rotation, make_observation
from jaxunshear.calibration.prediction import (
    Calibration,
    SensorValues,
    find_solutions,
    fit_positions,
    project_positions,
    simulate_displacements,
)
from jaxunshear.errors import UserError
from jaxunshear.perception.lattice import Lattice

ALIGNED_BY = 100  # most taps from which the frame is found
MIN_TAPS = 20


class RecordedTaps(NamedTuple):
    """Recorded taps: pins (N, P, 2) px as (column, row), poses (N, 6) mm and deg as labelled."""

    pins: np.ndarray
    pose: np.ndarray


class LabelView(NamedTuple):
    """How a recording's labels, its object and its camera go together."""

    alignment: Alignment
    turn: np.ndarray  # (2, 2): recorded px @ turn are px of a camera that is not mirrored
    flat: np.ndarray  # (P, 2) mm of arc from the apex, where the recorded pins stand
    size: int  # px of the images
    values: SensorValues


def fit_label_view(
    taps: RecordedTaps, lattice: Lattice, size: int, calibration: Calibration
) -> LabelView:
    """Find how labels, object and camera go together, from up to ALIGNED_BY of the taps.

    Raises UserError if there are too few taps, or if their labels do not fit their pins.
    """
    rows = np.flatnonzero(np.isfinite(taps.pins).all((1, 2)) & np.isfinite(taps.pose).all(1))
    rows = np.random.default_rng(0).permutation(rows)[:ALIGNED_BY]
    if len(rows) < MIN_TAPS:
        raise UserError(
            f"{len(rows)} taps have a label and all pins: "
            f"at least {MIN_TAPS} are needed to place a simulated slide"
        )
    values, pose = calibration.values, taps.pose[rows].astype(np.float64)
    positions = taps.pins[rows].astype(np.float64) - lattice.centre
    alignment = align(make_observation(size, lattice, positions), pose, None, values)
    if alignment is None:
        raise UserError(
            "the taps' labels do not go with their images: no slide to them can be simulated"
        )
    turn = compute_camera_rotation(alignment.angle, alignment.mirrored)
    contacts = alignment.place_contacts(pose, None)
    displacement = simulate_displacements(values, contacts, alignment.side)
    rows = np.flatnonzero(find_solutions(displacement))
    flat = fit_positions(values, size, positions[rows] @ turn, displacement[rows])
    return LabelView(alignment, turn, flat, size, values)


def simulate_shear(
    view: LabelView, pose: np.ndarray, moves: np.ndarray, friction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate by how many px (N, P, 2) a slide moves each pin further than a tap does.

    Args:
        view: How labels, object and camera go together.
        pose: (N, 6) mm and deg, at which the taps and the slides end.
        moves: (N, 6) mm and deg, the slides.
        friction: (N,).

    Returns:
        The motion, and which contacts (N,) were within reach and converged; NaN for others.
    """
    tap = _simulate_pins(view, pose, None, friction)
    shear = _simulate_pins(view, pose, moves, friction) - tap
    return (shear @ view.turn.T).astype(np.float32), np.isfinite(shear).all((1, 2))


def _simulate_pins(
    view: LabelView, pose: np.ndarray, moves: np.ndarray | None, friction: np.ndarray
) -> np.ndarray:
    """Simulate the pins (N, P, 2) px of labelled contacts; NaN for those without a solution."""
    contacts = view.alignment.place_contacts(np.asarray(pose, np.float64), moves)
    displacement = simulate_displacements(
        view.values, contacts, view.alignment.side, friction=friction
    )
    return project_positions(view.values, view.size, view.flat, displacement)
