"""How labels and images of a recording go together, found from the pins.

`read_labels` finds the side of the edge, the sign of the slides and the rotation of the camera. It
simulates contacts for each possible reading of the labels. The right reading moves the simulated
pins as the recorded pins moved, up to one rotation (and mirroring) of the camera.

`find_frame` finds how the object lies in the frame of the labels: its height, the position of its
edge and the tilt of its top, by Gauss-Newton on the motion of every pin. Robots are set up by hand.
On real edges the edge was more than a millimetre, and the top nearly two degrees, from where the
labels have them, which explained a third of the simulator's error.

`simulate_shear` adds simulated slides to recorded taps, from the labels of the taps alone. Only the
difference of two simulated contacts is used, so errors of the simulator that a tap and a slide
share do not enter.

    view = fit_label_view(taps, lattice, size, calibration)
    motion, converged = simulate_shear(view, taps.pose, moves, friction)  # (N, P, 2) px
"""

from itertools import product
from typing import NamedTuple

import numpy as np

from jaxunshear.calibration.labels import LabelFrame, LabelledMotions, apply_frame, read_motions
from jaxunshear.calibration.pin_statistics import (
    PinObservation,
    compute_camera_rotation,
    compute_ring_motion,
    compute_ring_radii,
    make_observation,
)
from jaxunshear.calibration.prediction import (
    Calibration,
    SensorValues,
    find_solutions,
    fit_positions,
    project_positions,
    project_rest,
    simulate_displacements,
)
from jaxunshear.calibration.validation import centre_motions, compute_r2
from jaxunshear.errors import UserError
from jaxunshear.perception.lattice import Lattice, compute_rings
from jaxunshear.simulator.pin_layout import compute_pin_lattice

# steps of the forward differences
STEPS = {"surface_mm": 0.2, "across_mm": 0.5, "tilt_x_deg": 1.5, "tilt_y_deg": 1.5}
MAX_STEPS = 4.0  # most steps in one round
ROUNDS = 6
DAMPING = 0.02  # of the normal matrix' diagonal
MIN_R2_GAIN = 0.003  # a round that gains less R2 is the last
STEP_FRACTIONS = (1.0, 0.5, 0.25)
IMAGES = 48  # images from which the reading of the labels is found
# Indentation depths over the dome's radius to start from; `find_frame` fits the depth later.
DEPTH_FRACTIONS = (0.12, 0.22)
MIN_CORRELATION = 0.5  # least correlation of simulated and recorded ring motion
MIN_LEAD = 0.03  # least lead in score of a reading over those before it
ALIGNED_BY = 100  # most taps from which the frame is found
MIN_TAPS = 20


class Alignment(NamedTuple):
    """How the labels, the object and the camera of a recording go together."""

    sign: int  # of the slides: +1 as they are labelled, -1 reversed
    side: int  # see `labels.make_paths`
    mirrored: bool
    angle: float  # rad, see `pin_statistics.PinObservation.rotate`
    frame: LabelFrame
    correlation: float  # of simulated and recorded ring motion

    def read_contacts(self, poses: np.ndarray, moves: np.ndarray | None) -> LabelledMotions:
        """Convert labels (N, 6) to contacts in the frame of the labels."""
        return read_motions(poses, None if moves is None else self.sign * moves)

    def place_contacts(self, poses: np.ndarray, moves: np.ndarray | None) -> LabelledMotions:
        """Convert labels (N, 6) to contacts in the object's frame."""
        return apply_frame(self.read_contacts(poses, moves), self.frame)


class _RingMeasures(NamedTuple):
    motion: np.ndarray  # (N, rings + 1), column + i row
    radii: np.ndarray  # (N, rings)


def read_labels(
    observation: PinObservation, poses: np.ndarray, moves: np.ndarray | None, start: SensorValues
) -> Alignment | None:
    """Find the reading of labels (N, 6) that agrees best with N images.

    The frame has the depth of the object's top alone. Returns None if no reading agrees with them.
    """
    identified = np.flatnonzero(observation.identified)
    rows = np.random.default_rng(0).permutation(identified)[:IMAGES]
    recorded = _measure_rings(
        observation.lattice.ring, observation.take(rows).positions, observation.rest
    )
    size, ring, flat = (
        observation.size,
        compute_rings(start.base),
        compute_pin_lattice(start.sensor),
    )
    rest = project_rest(start, size, flat)
    has_slides = moves is not None and bool(np.any(np.abs(moves) > 1e-6))
    best, best_score = None, -np.inf
    for sign in (1, -1) if has_slides else (1,):
        contacts = read_motions(poses, None if moves is None else sign * moves)
        sample = contacts.take(rows)
        lowest = float(-contacts.tip[:, 1, 2].min())
        for side, depth in product((1, -1, 0) if contacts.across else (0,), DEPTH_FRACTIONS):
            surface_mm = lowest - depth * start.base.dome_radius_mm
            displacement = simulate_displacements(start, sample, side, surface_mm)
            converged = find_solutions(displacement)
            if not converged.any():
                continue
            positions = project_positions(start, size, flat, displacement)
            simulated = _measure_rings(ring, positions, rest)
            radii_correlation = _correlate_radii(
                recorded.radii[converged], simulated.radii[converged]
            )
            # Cameras see the pins from behind, so mirrored is the usual case and comes first.
            for mirrored in (True, False):
                angle, correlation = _fit_rotation(
                    recorded.motion[converged], simulated.motion[converged], mirrored
                )
                score = correlation + 0.5 * radii_correlation
                if score > best_score + MIN_LEAD:
                    frame = LabelFrame(surface_mm)
                    best = Alignment(sign, side, mirrored, angle, frame, correlation)
                    best_score = score
    return best if best is not None and best.correlation >= MIN_CORRELATION else None


def _measure_rings(ring: np.ndarray, positions: np.ndarray, rest: np.ndarray) -> _RingMeasures:
    motion = compute_ring_motion(ring, positions - rest)
    return _RingMeasures(motion, compute_ring_radii(ring, positions, rest))


def _fit_rotation(
    recorded: np.ndarray, simulated: np.ndarray, mirrored: bool
) -> tuple[float, float]:
    """Fit the rotation (rad) of recorded to simulated ring motions, and correlate the two."""
    recorded = np.where(np.isfinite(recorded), np.conj(recorded) if mirrored else recorded, 0)
    shared = np.sum(np.conj(recorded) * simulated)
    size = np.sqrt(np.sum(np.abs(recorded) ** 2) * np.sum(np.abs(simulated) ** 2))
    return float(np.angle(shared)), float(np.abs(shared) / max(size, 1e-12))


def _correlate_radii(recorded: np.ndarray, simulated: np.ndarray) -> float:
    """Correlate the rings' radii over images, each less its mean."""
    a = np.nan_to_num(recorded - np.nanmean(recorded, axis=0))
    b = np.nan_to_num(simulated - np.nanmean(simulated, axis=0))
    return float(np.sum(a * b) / max(np.sqrt(np.sum(a**2) * np.sum(b**2)), 1e-12))


class FrameFit(NamedTuple):
    """A frame, and the motions px in it: each pin less its mean over contacts, 0 if unknown."""

    frame: LabelFrame
    recorded: np.ndarray  # (N, P, 2)
    simulated: np.ndarray  # (N, P, 2) rotated as the camera is
    angle: float  # rad, by which they are rotated

    @property
    def r2(self) -> float:
        return compute_r2(self.recorded, self.simulated)


class AlignmentProblem(NamedTuple):
    """Recorded contacts, and the simulator that has to reproduce them."""

    observation: PinObservation
    contacts: LabelledMotions
    side: int
    values: SensorValues

    def compare_motions(self, frame: LabelFrame) -> FrameFit:
        """Simulate the contacts in a frame, and compare the motions of the pins."""
        contacts = apply_frame(self.contacts, frame)
        displacement = simulate_displacements(self.values, contacts, self.side)
        rows = np.flatnonzero(find_solutions(displacement))
        recorded, simulated = np.zeros((2, *self.observation.positions.shape))
        if not len(rows):
            return FrameFit(frame, recorded, simulated, 0.0)
        size, observed = self.observation.size, self.observation.positions[rows]
        flat = fit_positions(self.values, size, observed, displacement[rows])
        predicted = project_positions(self.values, size, flat, displacement[rows])
        recorded[rows], simulated[rows] = map(np.nan_to_num, centre_motions(observed, predicted))
        angle = estimate_rotation(recorded[rows], simulated[rows])
        simulated[rows] = simulated[rows] @ compute_camera_rotation(angle)
        return FrameFit(frame, recorded, simulated, angle)


def estimate_rotation(recorded: np.ndarray, simulated: np.ndarray) -> float:
    """Estimate the rotation (rad, column to row) of simulated (N, P, 2) to recorded motions."""
    as_complex = np.array([1, 1j])
    a, b = recorded @ as_complex, simulated @ as_complex
    return float(np.angle(np.sum(a * np.conj(b))))


def find_frame(problem: AlignmentProblem, start: LabelFrame) -> FrameFit:
    """Find the frame in which the simulator explains most of the recorded motion."""
    best = problem.compare_motions(start)
    for _ in range(ROUNDS):
        step = _compute_step(problem, best)
        for fraction in STEP_FRACTIONS:
            trial = problem.compare_motions(
                LabelFrame(*(np.array(best.frame) + fraction * step).tolist())
            )
            if trial.r2 > best.r2:
                break
        else:
            return best
        gain, best = trial.r2 - best.r2, trial
        if gain < MIN_R2_GAIN:
            break
    return best


def _compute_step(problem: AlignmentProblem, best: FrameFit) -> np.ndarray:
    """Compute the Gauss-Newton step (4,) of the frame's fields; 0 for those that stay."""
    names = [name for name in STEPS if name != "across_mm" or problem.side]
    slopes = []
    for name in names:
        frame = best.frame._replace(**{name: getattr(best.frame, name) + STEPS[name]})
        slopes.append((problem.compare_motions(frame).simulated - best.simulated).ravel())
    jacobian = np.array(slopes)
    normal = jacobian @ jacobian.T
    residual = (best.recorded - best.simulated).ravel()
    step = np.linalg.solve(normal + DAMPING * np.diag(np.diag(normal)), jacobian @ residual)
    by_name = dict(zip(names, np.clip(step, -MAX_STEPS, MAX_STEPS), strict=True))
    return np.array([by_name.get(name, 0.0) * STEPS[name] for name in LabelFrame._fields])


def align(
    observation: PinObservation, poses: np.ndarray, moves: np.ndarray | None, values: SensorValues
) -> Alignment | None:
    """Find how labels (N, 6) go together with N images; None if they do not."""
    reading = read_labels(observation, poses, moves, values)
    if reading is None:
        return None
    rotated = observation.rotate(reading.mirrored, reading.angle)
    contacts = reading.read_contacts(poses, moves)
    best = find_frame(AlignmentProblem(rotated, contacts, reading.side, values), reading.frame)
    return reading._replace(frame=best.frame, angle=reading.angle - best.angle)


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
