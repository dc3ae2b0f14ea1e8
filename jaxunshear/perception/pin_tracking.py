"""Which pin is which: found pins of a binary image get the identities of the sensor's lattice.

A slide moves pins by more than their spacing, so the nearest lattice point is the wrong one. But the skin is smooth: taken together, the
pins move by a low polynomial of their place, to well below half a spacing. Mean and spread of all found pins give a first affine
motion; pairs of mutually nearest pins then refine polynomials of rising degree, and last each pin follows its neighbours. What is
not smooth in the end is taken back there and grown anew from the pins around; what is not smooth then is reported as doubt.

Where pins have left the view, mean and spread mislead. Then the frames that went well help: motions of one sensor differ in two or
three ways (slides along x and y, and the depth), so a grid over these is laid on the found pins, and the best are refined.

    lattice = fit_lattice([find_pins(image) for image in images], layout_of(TACTIP_331))
    tracks = track_all(lattice, [detect_pins(image) for image in images])
    motion = tracks[0].motion  # (P, 2) px from the lattice, NaN where a pin is not seen

What reads pins takes `track_images` images, or their `measure_motions`.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage
from scipy.spatial import cKDTree

from jaxunshear.angles import rotation_2d
from jaxunshear.perception.identity_repair import fill_missing, rate_identities, repair_identities
from jaxunshear.perception.lattice import POLYNOMIAL_DEGREES, Lattice
from jaxunshear.perception.pin_detection import DetectedPins, detect_pins
from jaxunshear.perception.pin_refinement import refine_track
from jaxunshear.perception.pin_track import PinTrack, assess_track

MAX_MATCH_DISTANCE = 0.75  # of the spacing: beyond it a found pin is another one
REPEATS = 3  # of a polynomial's fit, fewer where pairs come no nearer than
CONVERGED_RATIO = 0.9  # of their distance before
MIN_PRIOR_FRAMES = 10  # sure frames, at least
MODES = 3
STEP = 0.6  # of the spacing, by which neighbours on the grid of motions may differ at a pin
GRID = 15  # points along a mode, at most
TRIED_MOTIONS = 6  # of the grid's motions
MAX_FAULT_SHARE = 0.1  # share of the pins that are at fault in a motion worth mending at once
MAX_REPAIRED = 2  # of the others


class MotionPrior(NamedTuple):
    """How the pins of a set usually move."""

    motion: np.ndarray  # (M, P, 2) px, a grid over the ways in which motions differ
    view: float  # px from the lattice's centre within which pins are seen


class TrackedPins(NamedTuple):
    """The pins of N images by identity."""

    # (N, P, 2) px from the lattice; NaN where a pin is not seen, and all of an image that is not sure
    motion: np.ndarray
    identified: np.ndarray  # (N,) whether the pins were identified for sure


def track_images(
    lattice: Lattice, images: Sequence[np.ndarray] | np.ndarray, independent: bool = False
) -> TrackedPins:
    """The pins of binary images (S, S) of one camera. `independent`: each image by itself, as a robot sees it; else the sure ones help with
    the others."""
    found = [detect_pins(image) for image in images]
    tracks = (
        [track_pins(lattice, each) for each in found] if independent else track_all(lattice, found)
    )
    sure = np.array([track.identified for track in tracks], bool)
    motion = np.array([track.motion for track in tracks]).reshape(-1, *lattice.rest.shape)
    return TrackedPins(np.where(sure[:, None, None], motion, np.nan), sure)


def measure_motions(
    lattice: Lattice, images: Sequence[np.ndarray] | np.ndarray
) -> Float[np.ndarray, "N P 2"]:
    """In px: motions of the pins in images (N, S, S), missing ones filled in; NaN rows where pins were not identified for sure."""
    motion, sure = track_images(lattice, images)
    for row in np.flatnonzero(sure):
        motion[row] = fill_missing(lattice, motion[row])
    return motion


def track_all(lattice: Lattice, frames: list[DetectedPins]) -> list[PinTrack]:
    """Every pin's identity and motion in frames of one camera, in their order; those that are sure help with the others."""
    tracks = [track_pins(lattice, found) for found in frames]
    usual = fit_motion_prior(lattice, tracks)
    if usual is None:
        return tracks
    return [
        track if track.identified else track_pins(lattice, found, usual)
        for track, found in zip(tracks, frames, strict=True)
    ]


def track_pins(
    lattice: Lattice, detected: DetectedPins, prior: MotionPrior | None = None
) -> PinTrack:
    """The same of one frame, with the help of how pins `prior`ly move where that is known."""
    found, pins = detected.pins, len(lattice.rest)
    best = PinTrack(
        np.full((pins, 2), np.nan), np.full(pins, -1), float("inf"), pins, len(found), False
    )
    if len(found) < 0.7 * pins:
        return best
    tree = cKDTree(found)
    left = []
    for motion in _first_motions(lattice, found, prior):
        which = _match_iteratively(lattice, found, motion)
        rating = rate_identities(lattice, found, which)
        if rating.fault_count > MAX_FAULT_SHARE * pins:
            left.append((rating.fault_count, which))
            continue
        best = min(best, _finish_track(lattice, detected, tree, which), key=_rank_track)
        if best.identified:
            return best
    for _, which in sorted(left, key=lambda pair: pair[0])[:MAX_REPAIRED]:
        best = min(best, _finish_track(lattice, detected, tree, which), key=_rank_track)
        if best.identified:
            break
    return best


def _finish_track(
    lattice: Lattice, seen: DetectedPins, tree: cKDTree, which: np.ndarray
) -> PinTrack:
    """From rows (P,) of the found pins: repaired, then measured where that leaves doubt."""
    which = repair_identities(lattice, seen.pins, tree, which)
    motion = np.where(which[:, None] >= 0, seen.pins[which] - lattice.rest, np.nan)
    return refine_track(lattice, assess_track(lattice, motion, which, len(seen.pins)), seen)


def _rank_track(track: PinTrack) -> tuple[bool, int, float]:
    return not track.identified, track.missed, track.max_offset


def fit_motion_prior(lattice: Lattice, tracks: list[PinTrack]) -> MotionPrior | None:
    """What the sure ones of some tracks have in common; None where there are too few."""
    sure = [track for track in tracks if track.identified]
    if len(sure) < MIN_PRIOR_FRAMES:
        return None
    known = np.array(
        [
            np.where(np.isnan(track.motion), fill_missing(lattice, track.motion), track.motion)
            for track in sure
        ]
    )
    mean = known.mean(axis=0)
    left, size, right = np.linalg.svd((known - mean).reshape(len(known), -1), full_matrices=False)
    axes = []
    for amount, mode in zip(
        (left * size).T[:MODES], right[:MODES].reshape(-1, *mean.shape), strict=True
    ):
        low, high = 1.3 * amount.min(), 1.3 * amount.max()
        reach = (high - low) * np.linalg.norm(mode, axis=-1).max() / lattice.spacing
        axes.append(np.linspace(low, high, int(np.clip(np.ceil(reach / STEP) + 1, 2, GRID))))
    amounts = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    grid = mean + np.tensordot(amounts, right[: len(axes)].reshape(-1, *mean.shape), 1)
    off = np.linalg.norm(
        lattice.rest + np.array([track.motion for track in sure]) - _centre(lattice), axis=-1
    )
    return MotionPrior(grid.astype(np.float32), float(np.nanmax(off)) + 0.1 * lattice.spacing)


def _centre(lattice: Lattice) -> np.ndarray:
    return (lattice.rest.max(axis=0) + lattice.rest.min(axis=0)) / 2


def _first_motions(
    lattice: Lattice, found: np.ndarray, usual: MotionPrior | None
) -> Iterator[np.ndarray]:
    """Motions (P, 2) px to start from: the likeliest affine one, then the best usual ones, or turned ones where none is known."""
    likeliest = _affine(lattice, found)
    yield likeliest - lattice.rest
    if usual is not None:
        yield from _search_prior(lattice, found, usual)
        return
    middle = likeliest.mean(axis=0)
    for angle in np.radians([4, -4, 8, -8]):
        yield (likeliest - middle) @ rotation_2d(-angle) + middle - lattice.rest


def _search_prior(lattice: Lattice, found: np.ndarray, usual: MotionPrior) -> np.ndarray:
    """The usual motions (TRIED, P, 2) that put the lattice nearest to the found pins.

    A pin counts as far off as the nearest found one, half a spacing at most; so does one too many or too few in view. Distances are read
    off a map at half a pixel, so that the entire grid costs little more than one frame.
    """
    low = found.min(axis=0) - 2 * lattice.spacing
    high = found.max(axis=0) + 2 * lattice.spacing
    empty = np.ones(np.ceil(2 * (high - low)).astype(int)[::-1] + 1, bool)
    column, row = np.round(2 * (found - low)).astype(int).T
    empty[row, column] = False
    off = np.minimum(ndimage.distance_transform_edt(empty) / (2 * lattice.spacing), 0.5).astype(
        np.float32
    )
    place = lattice.rest.astype(np.float32) + usual.motion
    inside = np.linalg.norm(place - _centre(lattice), axis=-1) < usual.view
    cell = np.clip(np.round(2 * (place - low)).astype(int), 0, np.array(empty.shape)[::-1] - 1)
    apart = (off[cell[..., 1], cell[..., 0]] * inside).sum(-1) + 0.5 * np.abs(
        inside.sum(-1) - len(found)
    )
    return usual.motion[np.argsort(apart)[:TRIED_MOTIONS]].astype(float)


def _affine(lattice: Lattice, found: np.ndarray) -> np.ndarray:
    """Places (P, 2) moved so that they have the mean and covariance of the found pins, without a turn.

    Where a side of the pins has left the view, those that stand farthest out are left out of the comparison.
    """
    place, middle, spread = lattice.rest, found.mean(axis=0), np.cov(found.T)
    kept = np.arange(len(place))
    for _ in range(5):
        here = place[kept]
        root = _root(np.cov(here.T))
        back = np.linalg.inv(root)
        moved = (place - here.mean(axis=0)) @ (back @ _root(root @ spread @ root) @ back) + middle
        inside = np.sort(
            np.argsort(np.linalg.norm(moved - _centre(lattice), axis=-1))[: len(found)]
        )
        if np.array_equal(inside, kept):
            break
        kept = inside
    return moved


def _root(matrix: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T


def _match_iteratively(lattice: Lattice, found: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """From a first motion (P, 2) to the rows (P,) of the found pins, -1 for none."""
    place, pins = lattice.rest, len(lattice.rest)
    pairs = _pairs(place + motion, found)
    for degree in POLYNOMIAL_DEGREES:
        for _ in range(REPEATS):
            rows, columns, off = pairs
            middle = _middle(off)
            share = 1 / (1 + (off / max(2.5 * middle, 0.06 * lattice.spacing)) ** 2)
            powers = lattice.powers[degree]
            weighted = powers[rows].T * share
            normal = weighted @ powers[rows] + 1e-3 * np.eye(powers.shape[1])
            motion = powers @ np.linalg.solve(normal, weighted @ (found[columns] - place[rows]))
            pairs = _pairs(place + motion, found)
            if _middle(pairs[2]) > CONVERGED_RATIO * middle:
                break
    which = np.full(pins, -1)
    for _ in range(4):
        rows, columns, off = pairs
        near = off <= MAX_MATCH_DISTANCE * lattice.spacing
        before, which = which, np.full(pins, -1)
        which[rows[near]] = columns[near]
        if np.array_equal(before, which):
            break
        motion = lattice.neighbour_weights @ np.where(
            which[:, None] >= 0, found[which] - place, motion
        )
        pairs = _pairs(place + motion, found)
    return which


def _middle(values: np.ndarray) -> float:
    """The median, or the next above it: `numpy.median` spends most of its time on checks, and this is asked for a dozen times a frame."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def _pairs(expected: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of (expected, found) that are each other's nearest, and their distances."""
    # for some hundred pins all distances at once take less time than trees of them do
    middle = found.mean(axis=0)
    here, there = (expected - middle).astype(np.float32), (found - middle).astype(np.float32)
    squares = here @ (-2 * there.T)
    squares += (here**2).sum(axis=1)[:, None]
    squares += (there**2).sum(axis=1)
    nearest = squares.argmin(axis=1)
    rows = np.flatnonzero(squares.argmin(axis=0)[nearest] == np.arange(len(expected)))
    columns = nearest[rows]
    return rows, columns, np.hypot(*(expected[rows] - found[columns]).T)
