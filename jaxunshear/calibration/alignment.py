"""How the object lies in the labels' frame, from pins: its height, the place of its edge, the tilt of its top.

Gauss-Newton on the motion of every pin. Robots are set up by hand: on real edges the edge lay more than a millimetre, and the top
nearly two degrees, from where the labels have them, which explained a third of what the simulator got wrong.
"""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from jaxunshear.calibration.labels import Frame, Motions, framed
from jaxunshear.calibration.prediction import Simulate, Values, displacements
from jaxunshear.calibration.statistics import Seen, camera_turn
from jaxunshear.calibration.validation import centred, r2, settled
from jaxunshear.settings.sensor import Sensor

STEPS = {"surface_mm": 0.2, "across_mm": 0.5, "tilt_x_deg": 1.5, "tilt_y_deg": 1.5}  # of forward differences
FARTHEST = 4.0  # steps that a round may go
ROUNDS = 6
DAMPING = 0.02  # of the normal matrix' diagonal
ENOUGH = 0.003  # of R2: a round that gains less is the last
SHORTER = (1.0, 0.5, 0.25)


class Matter(NamedTuple):
    """Recorded contacts and the simulator that is to follow them."""

    seen: Seen
    contacts: Motions
    side: int
    values: Values
    sensor: Sensor
    simulate: Simulate = displacements

    def moved(self, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        """As `prediction.displacements`."""
        values = self.values
        contacts = framed(self.contacts, frame)
        return self.simulate(self.sensor, contacts, self.side, values.friction, 0.0, values.skin_to_gel)

    def compared(self, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        """Recorded and simulated motions (N, P, 2) px as `centred` gives them, zero where one is not known; the simulated ones are
        turned as the camera is."""
        moved, fine = self.moved(frame)
        recorded, simulated = np.zeros((2, *self.seen.place.shape))
        if fine.any():
            one, other = (np.nan_to_num(motion) for motion in self._centred(moved, fine))
            recorded[fine], simulated[fine] = one, other @ camera_turn(turn_between(one, other))
        return recorded, simulated

    def turn(self, frame: Frame) -> float:
        """The turn (rad) from column towards row that is left between recorded and simulated motions."""
        return turn_between(*self._centred(*self.moved(frame)))

    def _centred(self, moved: np.ndarray, fine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        here = self.seen.take(np.flatnonzero(fine))
        _, place = settled(self.values, self.sensor, here.size, here.place, moved[fine])
        return centred(here.place, place)


def turn_between(recorded: np.ndarray, simulated: np.ndarray) -> float:
    """The turn (rad), from column towards row, that brings simulated motions (N, P, 2) nearest to recorded ones."""
    one, other = (np.nan_to_num(motion) @ np.array([1, 1j]) for motion in (recorded, simulated))
    return float(np.angle(np.sum(one * np.conj(other))))


def find_frame(matter: Matter, start: Frame, names: Collection[str] = tuple(STEPS)) -> Frame:
    """The frame in which the simulator explains most of the recorded motion; what is not among `names` keeps its start."""
    names = [name for name in names if name != "across_mm" or matter.side]
    frame, (recorded, simulated) = start, matter.compared(start)
    score = r2(recorded, simulated)
    for _ in range(ROUNDS):
        step = _step(matter, frame, names, recorded, simulated)
        for share in SHORTER:
            there = along(frame, dict(zip(names, share * step, strict=True)))
            tried = matter.compared(there)
            if r2(*tried) > score:
                break
        else:
            return frame
        gain = r2(*tried) - score
        frame, (recorded, simulated), score = there, tried, score + gain
        if gain < ENOUGH:
            break
    return frame


def along(frame: Frame, step: dict[str, float]) -> Frame:
    """The frame, moved on by numbers of STEPS."""
    return frame._replace(**{name: float(getattr(frame, name) + STEPS[name] * size) for name, size in step.items()})


def _step(matter: Matter, frame: Frame, names: list[str], recorded: np.ndarray, simulated: np.ndarray) -> np.ndarray:
    """Of Gauss-Newton, in units of STEPS."""
    slopes = np.array([(matter.compared(along(frame, {name: 1.0}))[1] - simulated).ravel() for name in names])
    normal = slopes @ slopes.T
    step = np.linalg.solve(normal + DAMPING * np.diag(np.diag(normal)), slopes @ (recorded - simulated).ravel())
    return np.clip(step, -FARTHEST, FARTHEST)
