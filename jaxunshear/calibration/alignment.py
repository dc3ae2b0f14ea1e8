"""How labels and images of a recording go together, found from the pins.

`read_labels` finds the side of the edge, the sign of the slides and the rotation of the camera. It
simulates contacts for each possible reading of the labels. The right reading moves the simulated
pins as the recorded pins moved, up to one rotation (and mirroring) of the camera.

`find_frame` finds how the object lies in the frame of the labels: its height, the position of its
edge and the tilt of its top, by Gauss-Newton on the motion of every pin. Robots are set up by hand.
On real edges the edge was more than a millimetre, and the top nearly two degrees, from where the
labels have them, which explained a third of the simulator's error.
"""

from collections.abc import Collection
from itertools import product
from typing import NamedTuple

import numpy as np

from jaxunshear.calibration.labels import LabelFrame, LabelledMotions, apply_frame, read_motions
from jaxunshear.calibration.pin_statistics import (
    PinObservation,
    compute_camera_rotation,
    compute_ring_motion,
    compute_ring_radii,
)
from jaxunshear.calibration.prediction import (
    SensorValues,
    Simulate,
    predict_positions,
    simulate_displacements,
)
from jaxunshear.calibration.validation import centre_motions, compute_r2, fit_positions
from jaxunshear.config.sensor import Sensor
from jaxunshear.perception.lattice import compute_rings

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


class LabelReading(NamedTuple):
    """One reading of a group's labels."""

    contacts: LabelledMotions
    sign: int  # of the slides: +1 as they are labelled, -1 reversed
    side: int  # see `labels.make_paths`
    surface_mm: float
    mirrored: bool
    angle: float  # rad, see `pin_statistics.PinObservation.rotate`
    correlation: float  # of simulated and recorded ring motion


class _RingMeasures(NamedTuple):
    motion: np.ndarray  # (N, rings + 1), column + i row
    radii: np.ndarray  # (N, rings)


def read_labels(
    observation: PinObservation,
    poses: np.ndarray,
    moves: np.ndarray | None,
    start: SensorValues,
    sensor: Sensor,
) -> LabelReading | None:
    """Find the reading of labels (N, 6) that agrees best with N images.

    Returns None if no reading agrees with them.
    """
    identified = np.flatnonzero(observation.identified)
    rows = np.random.default_rng(0).permutation(identified)[:IMAGES]
    recorded = _measure_rings(
        observation.lattice.ring, observation.take(rows).positions, observation.rest
    )
    size, ring = observation.size, compute_rings(sensor)
    has_slides = moves is not None and bool(np.any(np.abs(moves) > 1e-6))
    best, best_score = None, -np.inf
    for sign in (1, -1) if has_slides else (1,):
        contacts = read_motions(poses, None if moves is None else sign * moves)
        sample = contacts.take(rows)
        lowest = float(-contacts.tip[:, 1, 2].min())
        for side, depth in product((1, -1, 0) if contacts.across else (0,), DEPTH_FRACTIONS):
            surface_mm = lowest - depth * sensor.dome_radius_mm
            displacement, converged = simulate_displacements(
                sensor, sample, side, start.friction, surface_mm, start.skin_to_gel
            )
            if not converged.any():
                continue
            displacement = np.where(converged[:, None, None], displacement, np.nan)
            simulated = _measure_rings(ring, *predict_positions(start, sensor, size, displacement))
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
                    best = LabelReading(
                        contacts, sign, side, surface_mm, mirrored, angle, correlation
                    )
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


class AlignmentProblem(NamedTuple):
    """Recorded contacts, and the simulator that has to reproduce them."""

    observation: PinObservation
    contacts: LabelledMotions
    side: int
    values: SensorValues
    sensor: Sensor
    simulate: Simulate = simulate_displacements

    def simulate_motion(self, frame: LabelFrame) -> tuple[np.ndarray, np.ndarray]:
        """Simulate the contacts in a frame; returns what `simulate_displacements` returns."""
        contacts = apply_frame(self.contacts, frame)
        friction, ratio = self.values.friction, self.values.skin_to_gel
        return self.simulate(self.sensor, contacts, self.side, friction, 0.0, ratio)

    def compare_motions(self, frame: LabelFrame) -> tuple[np.ndarray, np.ndarray]:
        """Compute recorded and simulated motions (N, P, 2) px, centred as by `centre_motions`.

        Unknown motions are zero. The simulated motions are rotated as the camera is.
        """
        displacement, converged = self.simulate_motion(frame)
        recorded, simulated = np.zeros((2, *self.observation.positions.shape))
        if converged.any():
            centred = self._centre_motions(displacement, converged)
            recorded[converged] = np.nan_to_num(centred[0])
            simulated[converged] = np.nan_to_num(centred[1])
            angle = estimate_rotation(recorded[converged], simulated[converged])
            simulated[converged] = simulated[converged] @ compute_camera_rotation(angle)
        return recorded, simulated

    def measure_rotation(self, frame: LabelFrame) -> float:
        """Measure the rotation (rad, column to row) left between recorded and simulated motions."""
        return estimate_rotation(*self._centre_motions(*self.simulate_motion(frame)))

    def _centre_motions(
        self, displacement: np.ndarray, converged: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        observation = self.observation.take(np.flatnonzero(converged))
        _, simulated = fit_positions(
            self.values,
            self.sensor,
            observation.size,
            observation.positions,
            displacement[converged],
        )
        return centre_motions(observation.positions, simulated)


def estimate_rotation(recorded: np.ndarray, simulated: np.ndarray) -> float:
    """Estimate the rotation (rad, column to row) of simulated (N, P, 2) to recorded motions."""
    as_complex = np.array([1, 1j])
    a, b = np.nan_to_num(recorded) @ as_complex, np.nan_to_num(simulated) @ as_complex
    return float(np.angle(np.sum(a * np.conj(b))))


def find_frame(
    problem: AlignmentProblem, start: LabelFrame, names: Collection[str] = tuple(STEPS)
) -> LabelFrame:
    """Find the frame in which the simulator explains most of the recorded motion.

    Fields that are not among `names` keep their start.
    """
    names = [name for name in names if name != "across_mm" or problem.side]
    frame = start
    recorded, simulated = problem.compare_motions(start)
    score = compute_r2(recorded, simulated)
    for _ in range(ROUNDS):
        step = _compute_step(problem, frame, names, recorded, simulated)
        for fraction in STEP_FRACTIONS:
            trial = move_frame(frame, dict(zip(names, fraction * step, strict=True)))
            motions = problem.compare_motions(trial)
            if compute_r2(*motions) > score:
                break
        else:
            return frame
        gain = compute_r2(*motions) - score
        frame, score = trial, score + gain
        recorded, simulated = motions
        if gain < MIN_R2_GAIN:
            break
    return frame


def move_frame(frame: LabelFrame, step: dict[str, float]) -> LabelFrame:
    """Move fields of the frame by a number of STEPS each."""
    fields = {name: float(getattr(frame, name) + STEPS[name] * size) for name, size in step.items()}
    return frame._replace(**fields)


def _compute_step(
    problem: AlignmentProblem,
    frame: LabelFrame,
    names: list[str],
    recorded: np.ndarray,
    simulated: np.ndarray,
) -> np.ndarray:
    """Compute the Gauss-Newton step in units of STEPS."""
    slopes = []
    for name in names:
        _, shifted = problem.compare_motions(move_frame(frame, {name: 1.0}))
        slopes.append((shifted - simulated).ravel())
    jacobian = np.array(slopes)
    normal = jacobian @ jacobian.T
    step = np.linalg.solve(
        normal + DAMPING * np.diag(np.diag(normal)), jacobian @ (recorded - simulated).ravel()
    )
    return np.clip(step, -MAX_STEPS, MAX_STEPS)
