"""Add simulated slides to recorded taps, from the labels of the taps alone.

view = fit_label_view(taps, lattice, size, calibration)
motion, converged = simulate_shear(view, taps.pose, moves, friction)  # (N, P, 2) px, slide less tap

Only the difference of two simulated contacts is used, so errors of the simulator that a tap and a
slide share do not enter.
"""

from typing import NamedTuple

import numpy as np

from jaxunshear.calibration.alignment import AlignmentProblem, find_frame, read_labels
from jaxunshear.calibration.calibration_result import Calibration
from jaxunshear.calibration.labels import LabelFrame, apply_frame, read_motions
from jaxunshear.calibration.pin_statistics import PinObservation, compute_camera_rotation
from jaxunshear.calibration.prediction import simulate_displacements
from jaxunshear.calibration.validation import fit_positions, project_positions
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

    frame: LabelFrame
    side: int  # see `labels.make_paths`
    turn: np.ndarray  # (2, 2): recorded px @ turn are px of a camera that is not mirrored
    flat: np.ndarray  # (P, 2) mm of arc from the apex, where the recorded pins stand
    size: int  # px of the images
    calibration: Calibration


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
    values, sensor = calibration.values, calibration.sensor
    pins, pose = taps.pins[rows].astype(np.float64), taps.pose[rows].astype(np.float64)
    observation = _make_observation(pins, lattice, size)
    reading = read_labels(observation, pose, None, values, sensor)
    if reading is None:
        raise UserError(
            "the taps' labels do not go with their images: no slide to them can be simulated"
        )
    rotated = observation.rotate(reading.mirrored, reading.angle)
    problem = AlignmentProblem(rotated, reading.contacts, reading.side, values, sensor)
    frame = find_frame(problem, LabelFrame(reading.surface_mm))
    angle = reading.angle - problem.measure_rotation(frame)
    turn = compute_camera_rotation(angle, reading.mirrored)
    view = LabelView(frame, reading.side, turn, np.zeros((pins.shape[1], 2)), size, calibration)
    displacement, converged = _simulate_contacts(view, pose, None, calibration.friction)
    positions = (pins[converged] - lattice.centre) @ turn
    flat, _ = fit_positions(values, sensor, size, positions, displacement[converged])
    return view._replace(flat=flat)


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
        The motion, and which contacts (N,) were within reach and converged.
    """
    tap, tap_converged = _simulate_contacts(view, pose, None, friction)
    slide, slide_converged = _simulate_contacts(view, pose, moves, friction)
    shear = _project_pins(view, slide) - _project_pins(view, tap)
    return (shear @ view.turn.T).astype(np.float32), tap_converged & slide_converged


def _project_pins(view: LabelView, displacement: np.ndarray) -> np.ndarray:
    calibration = view.calibration
    return project_positions(
        calibration.values, calibration.sensor, view.size, view.flat, displacement
    )


def _simulate_contacts(
    view: LabelView, pose: np.ndarray, moves: np.ndarray | None, friction: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate labelled contacts; returns what `simulate_displacements` returns."""
    contacts = apply_frame(read_motions(np.asarray(pose, np.float64), moves), view.frame)
    sensor, ratio = view.calibration.sensor, view.calibration.values.skin_to_gel
    return simulate_displacements(sensor, contacts, view.side, friction, 0.0, ratio)


def _make_observation(pins: np.ndarray, lattice: Lattice, size: int) -> PinObservation:
    """Make an observation of pins (N, P, 2) px alone."""
    unknown = np.full(pins.shape[:2], np.nan)
    zeros = np.zeros(len(pins))
    identified = np.ones(len(pins), bool)
    return PinObservation(
        size, lattice, pins - lattice.centre, unknown, zeros, identified, zeros, zeros, zeros
    )
