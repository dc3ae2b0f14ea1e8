"""Which pin is which: found pins of a binary image get the identities of the sensor's lattice.

A slide moves central pins by more than half their spacing, so the nearest lattice point is the wrong one. But the rim hardly moves
and neighbours move alike: identities are settled shell by shell from the rim inwards, each shell where the motion of those outside it
says, then checked and mended against all neighbours.

    lattice = fit_lattice([find_pins(image) for image in images[:30]], TACTIP_331)
    track = follow_pins(lattice, find_pins(images[0]))
    motion = track.motion  # (P, 2) px from the lattice, NaN where a pin was not found
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import ConvexHull, cKDTree

from jaxunshear.errors import UserError
from jaxunshear.scene.sensor import Sensor, pin_lattice

NEIGHBOURS = 12  # pins that tell where another one is
SURE = 0.22  # of the spacing: how far from its neighbours' motion a pin may stand; one mistaken for the next stands at 0.26 or more


class Lattice(NamedTuple):
    """Where the pins stand in an image before they move, with what following them needs."""

    place: np.ndarray  # (P, 2) px as (column, row), in the order of `pin_lattice`
    shell: np.ndarray  # (P,) 0 in the middle, `rings` on the rim
    spacing: float  # px, usual distance between neighbours
    inwards: tuple[
        np.ndarray, ...
    ]  # for shell k, (pins of it, P): weights of the pins outside that extrapolate a motion
    around: np.ndarray  # (P, P): weights of the nearest other pins

    @property
    def middle(self) -> np.ndarray:
        """(2,) px of the outermost shell, which a touch moves least."""
        return self.place[self.shell == self.shell.max()].mean(axis=0)


class Track(NamedTuple):
    """One image's pins by identity."""

    motion: np.ndarray  # (P, 2) px from the lattice; NaN for pins that were not found
    which: np.ndarray  # (P,) row of the found pins; -1 for those not found
    doubt: (
        float  # largest distance of a pin from where its neighbours put it, over the spacing; inf if too few are found
    )
    missed: int
    extra: int

    @property
    def sure(self) -> bool:
        return self.doubt <= SURE


def shells(sensor: Sensor) -> np.ndarray:
    """(P,) index of the shell of each pin, 0 for the one in the middle."""
    return np.repeat(np.arange(sensor.rings + 1), [1] + [6 * k for k in range(1, sensor.rings + 1)])


def make_lattice(place: np.ndarray, sensor: Sensor) -> Lattice:
    """A lattice from the places (P, 2) px of its pins."""
    shell = shells(sensor)
    spacing = float(np.median(cKDTree(place).query(place, k=2)[0][:, 1]))
    inwards = []
    for k in range(sensor.rings):
        outside = np.flatnonzero((shell > k) & (shell <= k + 3))
        inwards.append(_weights(place, np.flatnonzero(shell == k), outside, spacing))
    everyone = np.arange(len(place))
    return Lattice(place, shell, spacing, tuple(inwards), _weights(place, everyone, everyone, spacing))


def _weights(place: np.ndarray, wanted: np.ndarray, known: np.ndarray, spacing: float) -> np.ndarray:
    """(len(wanted), P): an affine motion fitted to the nearest of `known` (without the pin itself), read at each of `wanted`."""
    weights = np.zeros((len(wanted), len(place)))
    tree = cKDTree(place[known])
    for row, pin in enumerate(wanted):
        near = known[tree.query(place[pin], k=min(NEIGHBOURS + 1, len(known)))[1]]
        near = near[near != pin][:NEIGHBOURS]
        offset = (place[near] - place[pin]) / spacing
        share = 1 / (1 + (offset**2).sum(-1))
        design = np.column_stack([np.ones(len(near)), offset])
        ridge = np.diag([0.0, 0.05, 0.05])
        weights[row, near] = np.linalg.solve(design.T @ (share[:, None] * design) + ridge, design.T * share)[0]
    return weights


def fit_lattice(frames: list[np.ndarray], sensor: Sensor) -> Lattice:
    """The lattice that the found pins (N, 2) px of some images of one camera share: the mean place of each pin.

    Raises UserError where they do not look like this sensor's pins.
    """
    place = _first_guess(frames, sensor)
    for _ in range(2):
        lattice = make_lattice(place, sensor)
        tracks = [follow_pins(lattice, found) for found in frames]
        motion = np.array([track.motion for track in tracks if track.sure] or [track.motion for track in tracks])
        count = np.isfinite(motion[..., 0]).sum(axis=0)
        if np.mean(count > 0) < 0.9 or np.median([track.extra for track in tracks]) > 0.1 * sensor.pins:
            break
        mean = np.nansum(motion, axis=0) / np.maximum(count, 1)[:, None]
        place = place + np.where(count[:, None] > 0, mean, lattice.around @ mean)
    else:
        return make_lattice(place, sensor)
    raise UserError(
        f"the pins of these images do not form the lattice of sensor '{sensor.name}' ({sensor.pins} pins, "
        f"{sensor.layout}): about {np.median([len(found) for found in frames]):.0f} pins are found; name another sensor"
    )


def _first_guess(frames: list[np.ndarray], sensor: Sensor) -> np.ndarray:
    """Places (P, 2) px: the flat lattice, bent in radius, on the rim of the pins of all frames, turned to match their outer shells."""
    flat = pin_lattice(sensor)
    flat = flat / np.linalg.norm(flat, axis=-1).max()
    outline = np.concatenate([found[ConvexHull(found).vertices] for found in frames])
    centre = (np.percentile(outline, 2, axis=0) + np.percentile(outline, 98, axis=0)) / 2
    rim = float(np.median(np.linalg.norm(outline - centre, axis=-1)))
    outer = shells(sensor) >= sensor.rings - 2
    some = frames[:: max(1, len(frames) // 10)][:10]
    best, place = np.inf, flat
    for bend in (-0.1, 0.0, 0.1, 0.2):
        for turn in np.radians(np.arange(0, 60, 1.5)):
            cos, sin = np.cos(turn), np.sin(turn)
            radius = np.linalg.norm(flat, axis=-1, keepdims=True)
            guess = centre + rim * (1 + bend * (1 - radius**2)) * flat @ np.array([[cos, sin], [-sin, cos]])
            off = np.mean([np.median(cKDTree(found).query(guess[outer])[0]) for found in some])
            if off < best:
                best, place = float(off), guess
    return place


def follow_pins(lattice: Lattice, found: np.ndarray) -> Track:
    """Identities for found pins (N, 2) px as (column, row)."""
    pins = len(lattice.place)
    motion = np.zeros((pins, 2))
    index = np.full(pins, -1)
    if len(found) < 0.7 * pins:
        return Track(np.full((pins, 2), np.nan), index, float("inf"), pins - len(found), 0)
    rim = lattice.shell.max()
    free = np.ones(len(found), bool)
    for k in range(rim, -1, -1):
        here = np.flatnonzero(lattice.shell == k)
        expected = lattice.inwards[k] @ motion if k < rim else np.zeros((len(here), 2))
        rows, columns = _assign(lattice.place[here] + expected, found[free], 0.75 * lattice.spacing)
        motion[here] = expected
        chosen = np.flatnonzero(free)[columns]
        index[here[rows]] = chosen
        motion[here[rows]] = found[chosen] - lattice.place[here[rows]]
        free[chosen] = False
    for _ in range(3):
        expected = lattice.around @ motion
        rows, columns = _assign(lattice.place + expected, found, 0.75 * lattice.spacing)
        before, index = index, np.full(pins, -1)
        index[rows] = columns
        motion = np.where(index[:, None] >= 0, found[index] - lattice.place, expected)
        if np.array_equal(before, index):
            break
    seen = index >= 0
    off = np.linalg.norm(motion - lattice.around @ motion, axis=-1)[seen] / lattice.spacing
    return Track(
        np.where(seen[:, None], motion, np.nan),
        index,
        float(off.max(initial=0.0)) if seen.mean() > 0.9 else float("inf"),
        int(pins - seen.sum()),
        int(len(found) - seen.sum()),
    )


def _assign(expected: np.ndarray, found: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of (expected, found) with the least sum of squares, none beyond `limit`."""
    distance = np.linalg.norm(expected[:, None] - found[None], axis=-1)
    rows, columns = linear_sum_assignment(np.minimum(distance, 2 * limit) ** 2)
    near = distance[rows, columns] <= limit
    return rows[near], columns[near]
