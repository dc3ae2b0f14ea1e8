"""What a slide would have added to recorded taps: the simulator follows it, from the taps' labels alone.

view = fit_label_view(taps, lattice, size, known)                 # how labels, object and camera go together
motion, converged = simulate_shear(view, taps, moves, friction)     # (N, P, 2) px of every recorded pin, a slide less a tap

Only the difference of two simulated contacts is used, so that what the simulator gets wrong of a tap does not enter.
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

ALIGNED_BY = 100  # taps that the frame is found from
MIN_TAPS = 20  # of them


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
    known: Calibration


def fit_label_view(
    taps: RecordedTaps, lattice: Lattice, size: int, known: Calibration
) -> LabelView:
    """From up to ALIGNED_BY of the taps. Raises UserError where they are too few, or their labels do not go with their pins."""
    rows = np.flatnonzero(np.isfinite(taps.pins).all((1, 2)) & np.isfinite(taps.pose).all(1))
    rows = np.random.default_rng(0).permutation(rows)[:ALIGNED_BY]
    if len(rows) < MIN_TAPS:
        raise UserError(
            f"{len(rows)} taps have a label and all pins: at least {MIN_TAPS} are needed to place a simulated slide"
        )
    pins, pose = taps.pins[rows].astype(np.float64), taps.pose[rows].astype(np.float64)
    seen = _make_observation(pins, lattice, size)
    reading = read_labels(seen, pose, None, known.values, known.sensor)
    if reading is None:
        raise UserError(
            "the taps' labels do not go with their images: no slide to them can be simulated"
        )
    matter = AlignmentProblem(
        seen.rotate(reading.mirrored, reading.angle),
        reading.contacts,
        reading.side,
        known.values,
        known.sensor,
    )
    frame = find_frame(matter, LabelFrame(reading.surface_mm))
    angle = reading.angle - matter.measure_rotation(frame)
    turn = compute_camera_rotation(angle, reading.mirrored)
    view = LabelView(frame, reading.side, turn, np.zeros((pins.shape[1], 2)), size, known)
    moved, fine = _simulate_motion(view, pose, None, known.friction)
    flat, _ = fit_positions(
        known.values, known.sensor, size, (pins[fine] - lattice.centre) @ turn, moved[fine]
    )
    return view._replace(flat=flat)


def simulate_shear(
    view: LabelView, pose: np.ndarray, moves: np.ndarray, friction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """By how many px (N, P, 2) a slide `moves` (N, 6) mm and deg that ends at `pose` (N, 6) moves each pin further than a tap there
    does, and which contacts were reached and converged (N,). `friction` (N,)."""
    tapped, fine = _simulate_motion(view, pose, None, friction)
    slid, converged = _simulate_motion(view, pose, moves, friction)
    values, sensor = view.known.values, view.known.sensor
    apart = project_positions(values, sensor, view.size, view.flat, slid) - project_positions(
        values, sensor, view.size, view.flat, tapped
    )
    return (apart @ view.turn.T).astype(np.float32), fine & converged


def _simulate_motion(
    view: LabelView, pose: np.ndarray, moves: np.ndarray | None, friction: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """As `prediction.simulate_displacements`."""
    contacts = apply_frame(read_motions(np.asarray(pose, np.float64), moves), view.frame)
    ratio = view.known.values.skin_to_gel
    return simulate_displacements(view.known.sensor, contacts, view.side, friction, 0.0, ratio)


def _make_observation(pins: np.ndarray, lattice: Lattice, size: int) -> PinObservation:
    """Pins (N, P, 2) px of whose images nothing else is known."""
    unknown, count = np.full(pins.shape[:2], np.nan), len(pins)
    zeros = np.zeros(count)
    return PinObservation(
        size,
        lattice,
        pins - lattice.centre,
        unknown,
        zeros,
        np.ones(count, bool),
        zeros,
        zeros,
        zeros,
    )
