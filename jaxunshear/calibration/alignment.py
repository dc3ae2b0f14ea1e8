"""How labels and images go together, read off the pins.

`read_labels`: the side of the edge, the sense of the slide, the turn of the camera. Simulated contacts are moved as each reading of
the labels says; the right one moves its pins as the recorded ones moved, up to one turn (and mirroring) of the camera. A reading that
matches none is reported, not forced.

`find_frame`: how the object lies in the labels' frame, its height, the place of its edge, the tilt of its top, by Gauss-Newton on the
motion of every pin. Robots are set up by hand: on real edges the edge lay more than a millimetre, and the top nearly two degrees, from
where the labels have them, which explained a third of what the simulator got wrong.
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

STEPS = {
    "surface_mm": 0.2,
    "across_mm": 0.5,
    "tilt_x_deg": 1.5,
    "tilt_y_deg": 1.5,
}  # of forward differences
MAX_STEPS = 4.0  # steps that a round may go
ROUNDS = 6
DAMPING = 0.02  # of the normal matrix' diagonal
MIN_R2_GAIN = 0.003  # of R2: a round that gains less is the last
STEP_FRACTIONS = (1.0, 0.5, 0.25)
IMAGES = 48  # that labels are read by
DEPTH_FRACTIONS = (
    0.12,
    0.22,
)  # of the contacts over the dome's radius, to begin with: the depth axis' origin is fitted later
MIN_CORRELATION = 0.5  # least correlation of simulated and recorded ring motion
MIN_LEAD = 0.03  # by which a reading must beat those before it


class LabelReading(NamedTuple):
    """One way to read a group's labels."""

    contacts: LabelledMotions
    sign: int  # of the slides: +1 as they are labelled, -1 the other way round
    side: int  # see `labels.make_paths`
    surface_mm: float
    mirrored: bool
    angle: float  # rad, see `pin_statistics.PinObservation.turned`
    correlation: float  # correlation of ring motion, simulated and recorded


def read_labels(
    seen: PinObservation,
    poses: np.ndarray,
    moves: np.ndarray | None,
    start: SensorValues,
    sensor: Sensor,
) -> LabelReading | None:
    """The reading of labels (N, 6) of N images that agrees best with them; None where none does."""
    some = np.random.default_rng(0).permutation(np.flatnonzero(seen.identified))[:IMAGES]
    shell, places = seen.lattice.ring, seen.take(some).positions
    recorded = compute_ring_motion(shell, places - seen.rest)
    widths = compute_ring_radii(shell, places, seen.rest)
    slid = moves is not None and bool(np.any(np.abs(moves) > 1e-6))
    best, best_score = None, -np.inf
    # Cameras see the pins from behind, so that mirrored is the usual case and comes first.
    for sign in (1, -1) if slid else (1,):
        contacts = read_motions(poses, None if moves is None else sign * moves)
        part = contacts.take(some)
        for side, deepest in product((1, -1, 0) if contacts.across else (0,), DEPTH_FRACTIONS):
            surface = float(-contacts.tip[:, 1, 2].min()) - deepest * sensor.dome_radius_mm
            moved, converged = simulate_displacements(
                sensor, part, side, start.friction, surface, start.skin_to_gel
            )
            if not converged.any():
                continue
            place, rest = predict_positions(
                start, sensor, seen.size, np.where(converged[:, None, None], moved, np.nan)
            )
            simulated = compute_ring_motion(compute_rings(sensor), place - rest)
            wide = compute_ring_radii(compute_rings(sensor), place, rest)
            for mirrored in (True, False):
                turn, match = _turn(recorded[converged], simulated[converged], mirrored)
                score = match + 0.5 * _correlation(widths[converged], wide[converged])
                if score > best_score + MIN_LEAD:
                    best, best_score = (
                        LabelReading(contacts, sign, side, surface, mirrored, turn, match),
                        score,
                    )
    return best if best is not None and best.correlation >= MIN_CORRELATION else None


def _turn(recorded: np.ndarray, simulated: np.ndarray, mirrored: bool) -> tuple[float, float]:
    """The turn (rad) that brings recorded ring motions onto simulated ones, and their correlation after it."""
    recorded = np.where(np.isfinite(recorded), np.conj(recorded) if mirrored else recorded, 0)
    shared = np.sum(np.conj(recorded) * simulated)
    size = np.sqrt(np.sum(np.abs(recorded) ** 2) * np.sum(np.abs(simulated) ** 2))
    return float(np.angle(shared)), float(np.abs(shared) / max(size, 1e-12))


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Of the rings' radii over images, each less its mean."""
    a, b = (np.nan_to_num(x - np.nanmean(x, axis=0)) for x in (a, b))
    return float(np.sum(a * b) / max(np.sqrt(np.sum(a**2) * np.sum(b**2)), 1e-12))


class AlignmentProblem(NamedTuple):
    """Recorded contacts and the simulator that is to follow them."""

    observation: PinObservation
    contacts: LabelledMotions
    side: int
    values: SensorValues
    sensor: Sensor
    simulate: Simulate = simulate_displacements

    def simulate_motion(self, frame: LabelFrame) -> tuple[np.ndarray, np.ndarray]:
        """As `prediction.simulate_displacements`."""
        values = self.values
        contacts = apply_frame(self.contacts, frame)
        return self.simulate(
            self.sensor, contacts, self.side, values.friction, 0.0, values.skin_to_gel
        )

    def compare_motions(self, frame: LabelFrame) -> tuple[np.ndarray, np.ndarray]:
        """Recorded and simulated motions (N, P, 2) px as `centre_motions` gives them, zero where one is not known; the simulated ones are
        turned as the camera is."""
        moved, fine = self.simulate_motion(frame)
        recorded, simulated = np.zeros((2, *self.observation.positions.shape))
        if fine.any():
            one, other = (np.nan_to_num(motion) for motion in self._centre_motions(moved, fine))
            recorded[fine], simulated[fine] = (
                one,
                other @ compute_camera_rotation(estimate_rotation(one, other)),
            )
        return recorded, simulated

    def measure_rotation(self, frame: LabelFrame) -> float:
        """The turn (rad) from column towards row that is left between recorded and simulated motions."""
        return estimate_rotation(*self._centre_motions(*self.simulate_motion(frame)))

    def _centre_motions(self, moved: np.ndarray, fine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        here = self.observation.take(np.flatnonzero(fine))
        _, place = fit_positions(self.values, self.sensor, here.size, here.positions, moved[fine])
        return centre_motions(here.positions, place)


def estimate_rotation(recorded: np.ndarray, simulated: np.ndarray) -> float:
    """The turn (rad), from column towards row, that brings simulated motions (N, P, 2) nearest to recorded ones."""
    one, other = (np.nan_to_num(motion) @ np.array([1, 1j]) for motion in (recorded, simulated))
    return float(np.angle(np.sum(one * np.conj(other))))


def find_frame(
    problem: AlignmentProblem, start: LabelFrame, names: Collection[str] = tuple(STEPS)
) -> LabelFrame:
    """The frame in which the simulator explains most of the recorded motion; what is not among `names` keeps its start."""
    names = [name for name in names if name != "across_mm" or problem.side]
    frame, (recorded, simulated) = start, problem.compare_motions(start)
    score = compute_r2(recorded, simulated)
    for _ in range(ROUNDS):
        step = _frame_step(problem, frame, names, recorded, simulated)
        for share in STEP_FRACTIONS:
            there = move_frame(frame, dict(zip(names, share * step, strict=True)))
            tried = problem.compare_motions(there)
            if compute_r2(*tried) > score:
                break
        else:
            return frame
        gain = compute_r2(*tried) - score
        frame, (recorded, simulated), score = there, tried, score + gain
        if gain < MIN_R2_GAIN:
            break
    return frame


def move_frame(frame: LabelFrame, step: dict[str, float]) -> LabelFrame:
    """The frame, moved on by numbers of STEPS."""
    return frame._replace(
        **{name: float(getattr(frame, name) + STEPS[name] * size) for name, size in step.items()}
    )


def _frame_step(
    matter: AlignmentProblem,
    frame: LabelFrame,
    names: list[str],
    recorded: np.ndarray,
    simulated: np.ndarray,
) -> np.ndarray:
    """Of Gauss-Newton, in units of STEPS."""
    slopes = np.array(
        [
            (matter.compare_motions(move_frame(frame, {name: 1.0}))[1] - simulated).ravel()
            for name in names
        ]
    )
    normal = slopes @ slopes.T
    step = np.linalg.solve(
        normal + DAMPING * np.diag(np.diag(normal)), slopes @ (recorded - simulated).ravel()
    )
    return np.clip(step, -MAX_STEPS, MAX_STEPS)
