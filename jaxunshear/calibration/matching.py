"""How labels and images go together, read off the images: the side of the edge, the sense of the slide, the turn of the camera.

Simulated contacts are moved as each reading of the labels says; the right one moves its pins as the recorded ones moved, up to one
turn (and mirroring) of the camera. A reading that matches none is reported, not forced.
"""

from itertools import product
from typing import NamedTuple

import numpy as np

from jaxunshear.calibration.labels import Motions, motions
from jaxunshear.calibration.prediction import Values, displacements, place_of
from jaxunshear.calibration.statistics import Seen, ring_motion, ring_radii
from jaxunshear.image.lattice import shells
from jaxunshear.settings.sensor import Sensor

IMAGES = 48
DEEPEST = (0.12, 0.22)  # of the contacts over the dome's radius, to begin with: the depth axis' origin is fitted later
CREDIBLE = 0.5  # least correlation of simulated and recorded ring motion
MARGIN = 0.03  # by which a reading must beat those before it


class Reading(NamedTuple):
    """One way to read a group's labels."""

    contacts: Motions
    sign: int  # of the slides: +1 as they are labelled, -1 the other way round
    side: int  # see `labels.to_paths`
    surface_mm: float
    mirrored: bool
    angle: float  # rad, see `statistics.Seen.turned`
    match: float  # correlation of ring motion, simulated and recorded


def read_labels(
    seen: Seen, poses: np.ndarray, moves: np.ndarray | None, start: Values, sensor: Sensor
) -> Reading | None:
    """The reading of labels (N, 6) of N images that agrees best with them; None where none does."""
    some = np.random.default_rng(0).permutation(np.flatnonzero(seen.sure))[:IMAGES]
    shell, places = seen.lattice.shell, seen.take(some).place
    recorded = ring_motion(shell, places - seen.rest)
    widths = ring_radii(shell, places, seen.rest)
    slid = moves is not None and bool(np.any(np.abs(moves) > 1e-6))
    best, best_score = None, -np.inf
    # Cameras see the pins from behind, so that mirrored is the usual case and comes first.
    for sign in (1, -1) if slid else (1,):
        contacts = motions(poses, None if moves is None else sign * moves)
        part = contacts.take(some)
        for side, deepest in product((1, -1, 0) if contacts.across else (0,), DEEPEST):
            surface = float(-contacts.tip[:, 1, 2].min()) - deepest * sensor.dome_radius_mm
            moved, converged = displacements(sensor, part, side, start.friction, surface, start.skin_to_gel)
            if not converged.any():
                continue
            place, rest = place_of(start, sensor, seen.size, np.where(converged[:, None, None], moved, np.nan))
            simulated = ring_motion(shells(sensor), place - rest)
            wide = ring_radii(shells(sensor), place, rest)
            for mirrored in (True, False):
                turn, match = _turn(recorded[converged], simulated[converged], mirrored)
                score = match + 0.5 * _correlation(widths[converged], wide[converged])
                if score > best_score + MARGIN:
                    best, best_score = Reading(contacts, sign, side, surface, mirrored, turn, match), score
    return best if best is not None and best.match >= CREDIBLE else None


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
