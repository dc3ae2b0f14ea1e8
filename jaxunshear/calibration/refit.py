"""Values of sensor, camera and friction fitted to the motion of every pin, together with how the object lies in each folder's labels.

    known, frames = refit([folder.matter for folder in folders], SHIPPED, [folder.start for folder in folders])

Gauss-Newton with forward differences, in the logarithms of what is positive. Every folder counts alike: what is raised is the mean
of their R2. Contacts that a fit has seen may not be compared after it.
"""

from collections.abc import Callable, Collection
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from jaxunshear.calibration.alignment import DAMPING, ENOUGH, FARTHEST, SHORTER, STEPS, Matter, along
from jaxunshear.calibration.calibrated import Calibrated, value_of, with_value
from jaxunshear.calibration.folders import with_values
from jaxunshear.calibration.labels import Frame
from jaxunshear.calibration.validation import r2, settled
from jaxunshear.settings.types import own_rules

UNITS = {
    "friction": "1",
    "skin_to_gel": "1",
    "skin_mm": "mm",
    "pin_length_mm": "mm",
    "skin_poisson": "1",
    "gel_poisson": "1",
    "dome_radius_mm": "mm",
    "mm_across": "mm",
    "distance_mm": "mm",
}
LOG_STEPS = {  # of forward differences; for Poisson's ratios of what they lack of 0.5
    "friction": 0.2,
    "skin_to_gel": 0.3,
    "skin_mm": 0.1,
    "pin_length_mm": 0.2,
    "skin_poisson": 0.5,
    "gel_poisson": 0.5,
    "dome_radius_mm": 0.04,
    "mm_across": 0.03,
    "distance_mm": 0.15,
}
FACTOR = 10.0  # by which a value may go up or down, at most
LEAST = 1e-3  # of a value, or of what a Poisson's ratio lacks of 0.5
ROUNDS = 4


class Point(NamedTuple):
    """Where the fit is."""

    known: Calibrated
    frames: tuple[Frame, ...]  # of each folder


def refit(
    matters: list[Matter],
    start: Calibrated,
    frames: list[Frame],
    names: Collection[str] = tuple(UNITS),
    framed: Collection[str] = tuple(STEPS),
    advance: Callable[[], None] = lambda: None,
) -> Point:
    """The values `names` and, of each folder's frame, `framed` that explain most of the recorded motion. `advance` is called after each
    of at most `slopes_of` slopes."""
    names = [name for name in names if _free(name, value_of(start, name)) > 0]
    here = Point(start, tuple(frames))
    motions = _compared(matters, here)
    for _ in range(ROUNDS):
        step = _step(matters, here, start, names, framed, motions, advance)
        there, tried = here, motions
        for share in SHORTER:
            there = _along(here, start, names, framed, share * step)
            if not _can_be(there.known):
                continue
            tried = _compared(matters, there)
            if score(tried) > score(motions):
                break
        else:
            break
        gain = score(tried) - score(motions)
        here, motions = there, tried
        if gain < ENOUGH:
            break
    return here._replace(known=_framed_alike(matters, start, here))


def slopes_of(folders: int, names: Collection[str] = tuple(UNITS), framed: Collection[str] = tuple(STEPS)) -> int:
    """How many slopes a refit takes at most."""
    return ROUNDS * (len(names) + folders * len(framed))


def score(motions: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Mean R2 over folders of recorded and simulated motions (N, P, 2)."""
    return float(np.mean([r2(*pair) for pair in motions]))


def _compared(matters: list[Matter], point: Point) -> list[tuple[np.ndarray, np.ndarray]]:
    return [
        with_values(matter, point.known).compared(frame) for matter, frame in zip(matters, point.frames, strict=True)
    ]


def _step(
    matters: list[Matter],
    here: Point,
    start: Calibrated,
    names: list[str],
    framed: Collection[str],
    motions: list[tuple[np.ndarray, np.ndarray]],
    advance: Callable[[], None],
) -> np.ndarray:
    """Of Gauss-Newton within bounds, in units of LOG_STEPS for the values, then of STEPS for each folder's frame."""
    sizes = [float(np.linalg.norm(recorded)) for recorded, _ in motions]
    matrix = _slopes(matters, here, names, framed, motions, sizes, advance)
    off = np.concatenate([(one - two).ravel() / size for (one, two), size in zip(motions, sizes, strict=True)])
    normal = matrix @ matrix.T
    low, high = np.full(len(normal), -FARTHEST), np.full(len(normal), FARTHEST)
    for i, name in enumerate(names):
        low[i] = _size(here.known, start, name, -FARTHEST) - 1e-9
        high[i] = _size(here.known, start, name, FARTHEST) + 1e-9
    moves = np.diag(normal) > 0  # friction moves no pin of a tap, and a flat top has no edge
    lower = np.linalg.cholesky((normal + DAMPING * np.diag(np.diag(normal)))[np.ix_(moves, moves)])
    step = np.zeros(len(normal))
    step[moves] = lsq_linear(lower.T, np.linalg.solve(lower, (matrix @ off)[moves]), (low[moves], high[moves])).x
    return step


def _slopes(
    matters: list[Matter],
    here: Point,
    names: list[str],
    framed: Collection[str],
    motions: list[tuple[np.ndarray, np.ndarray]],
    sizes: list[float],
    advance: Callable[[], None],
) -> np.ndarray:
    """(K, M): how a step of each unknown changes all simulated motions, those of a folder over its size."""
    slopes = []
    for name in names:
        step = _size(here.known, here.known, name, 1.0) or np.inf
        there = _compared(matters, here._replace(known=_changed(here.known, here.known, name, 1.0)))
        pairs = zip(there, motions, sizes, strict=True)
        slopes.append(np.concatenate([(new[1] - old[1]).ravel() / size / step for new, old, size in pairs]))
        advance()
    for i, (matter, frame) in enumerate(zip(matters, here.frames, strict=True)):
        for name in framed:
            column = [np.zeros(recorded.size) for recorded, _ in motions]
            if name != "across_mm" or matter.side:
                simulated = with_values(matter, here.known).compared(along(frame, {name: 1.0}))[1]
                column[i] = (simulated - motions[i][1]).ravel() / sizes[i]
            slopes.append(np.concatenate(column))
            advance()
    return np.array(slopes)


def _along(here: Point, start: Calibrated, names: list[str], framed: Collection[str], step: np.ndarray) -> Point:
    known, frames = here.known, []
    for name, size in zip(names, step[: len(names)], strict=True):
        known = _changed(known, start, name, float(size))
    for frame, row in zip(here.frames, step[len(names) :].reshape(len(here.frames), -1), strict=True):
        frames.append(along(frame, dict(zip(framed, row, strict=True))))
    return Point(known, tuple(frames))


def _free(name: str, value: float) -> float:
    """What of a value is positive and has no upper end: also its own inverse."""
    return 0.5 - value if name.endswith("poisson") else value


def _size(known: Calibrated, start: Calibrated, name: str, size: float) -> float:
    """`size` in LOG_STEPS from a value, or as much of it as leaves the value within FACTOR of where it started."""
    first, now = _free(name, value_of(start, name)), _free(name, value_of(known, name))
    least, most = max(first / FACTOR, LEAST), first * FACTOR
    if name.endswith("poisson"):
        most = min(most, 0.5)
    ends = np.log(np.array([min(least, now), max(most, now)]) / now) / LOG_STEPS[name]
    return float(np.clip(size, *ends))


def _changed(known: Calibrated, start: Calibrated, name: str, size: float) -> Calibrated:
    """One value moved on, as far as `_size` lets it."""
    now = _free(name, value_of(known, name))
    free = now * np.exp(_size(known, start, name, size) * LOG_STEPS[name])
    return with_value(known, name, _free(name, float(free)))


def _framed_alike(matters: list[Matter], start: Calibrated, here: Point) -> Calibrated:
    """With pins as far apart, and as large, as the fitted camera must have them to see them where they are recorded."""
    spacings = []
    for matter, frame in zip(matters, here.frames, strict=True):
        moved, fine = with_values(matter, here.known).moved(frame)
        seen, rows = matter.seen, np.flatnonzero(fine)
        flat, _ = settled(here.known.values, here.known.sensor, seen.size, seen.place[rows], moved[rows])
        shell = seen.lattice.shell
        spacings.append(np.median(np.linalg.norm(flat, axis=-1)[shell > 0] / shell[shell > 0]))
    spacing = float(np.mean(spacings))
    radius = start.sensor.pin_radius_mm * spacing / start.sensor.pin_spacing_mm
    spaced = with_value(with_value(here.known, "pin_radius_mm", radius), "pin_spacing_mm", spacing)
    return spaced if _can_be(spaced) else here.known


def _can_be(known: Calibrated) -> bool:
    return all(holds for holds, _, _ in own_rules(known.sensor))
