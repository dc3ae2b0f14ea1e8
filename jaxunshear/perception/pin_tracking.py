"""Assign the identities of a sensor's lattice to the detected pins of a binary image.

A slide moves pins by more than their spacing, so the nearest lattice point is the wrong one. But
the skin is smooth: taken together, the pins move by a low polynomial of their rest position, to
well below half a spacing. Mean and spread of all detected pins give a first affine motion; pairs of
mutually nearest pins then refine polynomials of rising degree, and last each pin follows its
neighbours. Identities that are not smooth in the end are erased and grown anew from the pins
around; what is not smooth then leaves the image unidentified.

Where pins have left the view, mean and spread mislead. Then the identified images help: motions of
one sensor differ in two or three ways (slides along x and y, and the depth), so a grid over these
is compared with the detected pins, and the best are refined.

    lattice = fit_lattice([detect_pin_centres(image) for image in images], make_layout(TACTIP_331))
    tracks = track_all(lattice, [detect_pins(image) for image in images])
    motion = tracks[0].motion  # (P, 2) px from the lattice, NaN where a pin is missing

Networks that take pins use `track_images`, or `measure_motions`.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage
from scipy.spatial import cKDTree

from jaxunshear.angles import rotation_2d
from jaxunshear.perception.lattice import POLYNOMIAL_DEGREES, Lattice
from jaxunshear.perception.pin_detection import DetectedPins, detect_pins
from jaxunshear.perception.pin_track import (
    PinTrack,
    assess_track,
    rate_identities,
    refine_track,
    repair_identities,
)
from jaxunshear.perception.worn_dome import AROUND, assess_worn_track

MIN_DETECTED_SHARE = 0.7  # of the lattice's pins
MAX_MATCH_DISTANCE = 0.75  # of the spacing: beyond it a detected pin is another one
# Fits of a polynomial, fewer if the distance of pairs falls by less than this ratio.
REPEATS = 3
CONVERGED_RATIO = 0.9
NEIGHBOUR_REPEATS = 4
FIRST_TURNS_DEG = (4, -4, 8, -8)  # of the first motion, tried if no prior is known
WORN_TURNS_DEG = (0, 4, -4)
MAX_WORN_FAULT_SHARE = 0.25  # of the pins: identities with more faults are not repaired
MIN_STEP_SHARE = 0.7  # of the pins, which a step puts near others' places if it fits the lattice
MAX_STEP_DISTANCE = 0.3  # of the spacing
MIN_WORN_MARGIN = 2  # pins and dots without a partner, by which other identities must be worse
MIN_PRIOR_FRAMES = 10  # identified images that a prior is fitted to, at least
MODES = 3
STEP = 0.6  # of the spacing: the largest difference at a pin between neighbours on the grid
GRID = 15  # points along a mode, at most
TRIED_MOTIONS = 6  # of the grid's motions
MAX_FAULT_SHARE = 0.1  # of the pins: identities with more faults are repaired last
MAX_REPAIRED = 2  # of those


class MotionPrior(NamedTuple):
    """How the pins of a set of images usually move."""

    motion: np.ndarray  # (M, P, 2) px, a grid over the modes of motion
    view: float  # px from the lattice's centre within which pins are visible


class TrackedPins(NamedTuple):
    """The pins of N images by identity."""

    # (N, P, 2) px from the lattice; NaN where a pin is missing, or its image is not identified
    motion: np.ndarray
    identified: np.ndarray  # (N,) bool


def track_images(
    lattice: Lattice, images: Sequence[np.ndarray] | np.ndarray, independent: bool = False
) -> TrackedPins:
    """Track the pins of binary images (S, S) of one camera.

    `independent`: each image by itself, as a robot takes them; else the identified ones help with
    the others.
    """
    detected = [detect_pins(image) for image in images]
    if independent:
        tracks = [track_worn_pins(lattice, each, track_pins(lattice, each)) for each in detected]
    else:
        tracks = track_all(lattice, detected)
    identified = np.array([track.identified for track in tracks], bool)
    motion = np.array([track.motion for track in tracks]).reshape(-1, *lattice.rest.shape)
    return TrackedPins(np.where(identified[:, None, None], motion, np.nan), identified)


def measure_motions(
    lattice: Lattice, images: Sequence[np.ndarray] | np.ndarray
) -> Float[np.ndarray, "N P 2"]:
    """Measure pin motions px in images (N, S, S), with missing pins filled in.

    Images that are not identified have NaN.
    """
    motion, identified = track_images(lattice, images)
    for row in np.flatnonzero(identified):
        motion[row] = lattice.fill_missing(motion[row])
    return motion


def track_all(lattice: Lattice, frames: list[DetectedPins]) -> list[PinTrack]:
    """Track the pins of images of one camera, in order; the identified help with the others."""
    tracks = [track_pins(lattice, detected) for detected in frames]
    prior = fit_motion_prior(lattice, tracks)
    if prior is not None:
        tracks = [
            track if track.identified else track_pins(lattice, detected, prior)
            for track, detected in zip(tracks, frames, strict=True)
        ]
    return [
        track_worn_pins(lattice, detected, track)
        for track, detected in zip(tracks, frames, strict=True)
    ]


def track_worn_pins(lattice: Lattice, detected: DetectedPins, track: PinTrack) -> PinTrack:
    """Track the pins of an image again as those of a worn dome, unless `track` is identified.

    Return `track` if that does not identify them.
    """
    if track.identified or len(detected.pins) < MIN_DETECTED_SHARE * len(lattice.rest):
        return track
    if lattice.intact is not None:
        return _add_lost(
            lattice, track_worn_pins(lattice.intact, detected, _drop_lost(lattice, track))
        )
    motions = _propose_worn_motions(lattice, detected.pins)
    first = next(_find_worn_tracks(lattice, detected.pins, motions), None)
    if first is None:
        return track
    # a regular lattice of which the housing hides a side may fit one place further as well
    moved = [lattice.fill_missing(first.motion) + step for step in _find_steps(lattice)]
    tracks = [first, *_find_worn_tracks(lattice, detected.pins, moved)]
    tracks.sort(key=lambda worn: worn.missed + worn.extra)
    best = tracks[0]
    is_sure = all(
        np.array_equal(each.identity, best.identity)
        or each.missed + each.extra >= best.missed + best.extra + MIN_WORN_MARGIN
        for each in tracks[1:]
    )
    return best if is_sure else track


def _find_steps(lattice: Lattice) -> list[np.ndarray]:
    """Find the steps px from a pin to the next by which the lattice moves onto itself."""
    middle = np.argmin(np.linalg.norm(lattice.rest - lattice.centre, axis=-1))
    steps = lattice.rest[lattice.neighbours[middle, :AROUND]] - lattice.rest[middle]
    tree, near = cKDTree(lattice.rest), MAX_STEP_DISTANCE * lattice.spacing
    shares = [np.mean(tree.query(lattice.rest + step)[0] < near) for step in steps]
    return [step for step, share in zip(steps, shares, strict=True) if share >= MIN_STEP_SHARE]


def _find_worn_tracks(
    lattice: Lattice, detected: np.ndarray, motions: Iterable[np.ndarray]
) -> Iterator[PinTrack]:
    """Yield the identified ones of the tracks that start from first motions (P, 2) px."""
    tree, max_faults = cKDTree(detected), MAX_WORN_FAULT_SHARE * len(lattice.rest)
    for motion in motions:
        identity = _match_iteratively(lattice, detected, motion)
        if rate_identities(lattice, detected, identity).fault_count > max_faults:
            continue
        identity = repair_identities(lattice, detected, tree, identity)
        worn = assess_worn_track(lattice, detected, identity)
        if worn.identified:
            yield worn


def _drop_lost(lattice: Lattice, track: PinTrack) -> PinTrack:
    left = lattice.left
    return track._replace(motion=track.motion[left], identity=track.identity[left])


def _add_lost(lattice: Lattice, track: PinTrack) -> PinTrack:
    """Add the pins that are lost to a track of the others, as missing."""
    motion, identity = np.full(lattice.rest.shape, np.nan), np.full(len(lattice.rest), -1)
    motion[lattice.left], identity[lattice.left] = track.motion, track.identity
    return track._replace(motion=motion, identity=identity)


def track_pins(
    lattice: Lattice, detected: DetectedPins, prior: MotionPrior | None = None
) -> PinTrack:
    """Track the pins of one image, with the help of a prior if there is one."""
    if lattice.intact is not None:
        if prior is not None:
            prior = prior._replace(motion=prior.motion[:, lattice.left])
        return _add_lost(lattice, track_pins(lattice.intact, detected, prior))
    pins, count = len(lattice.rest), len(detected.pins)
    missing = np.full((pins, 2), np.nan)
    best = PinTrack(missing, np.full(pins, -1), float("inf"), pins, count, False)
    if count < MIN_DETECTED_SHARE * pins:
        return best
    tree, postponed = cKDTree(detected.pins), []
    for motion in _propose_motions(lattice, detected.pins, prior):
        identity = _match_iteratively(lattice, detected.pins, motion)
        fault_count = rate_identities(lattice, detected.pins, identity).fault_count
        if fault_count > MAX_FAULT_SHARE * pins:
            postponed.append((fault_count, identity))
            continue
        best = _choose_better(best, _finish_track(lattice, detected, tree, identity))
        if best.identified:
            return best
    for _, identity in sorted(postponed, key=lambda pair: pair[0])[:MAX_REPAIRED]:
        best = _choose_better(best, _finish_track(lattice, detected, tree, identity))
        if best.identified:
            break
    return best


def _finish_track(
    lattice: Lattice, detected: DetectedPins, tree: cKDTree, identity: np.ndarray
) -> PinTrack:
    """Repair identities, the rows (P,) of the detected pins, and measure doubtful pins again."""
    identity = repair_identities(lattice, detected.pins, tree, identity)
    motion = np.where(identity[:, None] >= 0, detected.pins[identity] - lattice.rest, np.nan)
    track = assess_track(lattice, motion, identity, len(detected.pins))
    return refine_track(lattice, track, detected)


def _choose_better(first: PinTrack, second: PinTrack) -> PinTrack:
    return min(
        (first, second), key=lambda track: (not track.identified, track.missed, track.max_offset)
    )


def fit_motion_prior(lattice: Lattice, tracks: list[PinTrack]) -> MotionPrior | None:
    """Fit a prior to the identified ones of some tracks; None if they are too few."""
    motions = [track.motion for track in tracks if track.identified]
    if len(motions) < MIN_PRIOR_FRAMES:
        return None
    full = np.array([lattice.fill_missing(motion) for motion in motions])
    mean = full.mean(axis=0)
    left, size, right = np.linalg.svd((full - mean).reshape(len(full), -1), full_matrices=False)
    amounts = (left * size).T[:MODES]
    modes = right[:MODES].reshape(-1, *mean.shape)
    axes = []
    for amount, mode in zip(amounts, modes, strict=True):
        low, high = 1.3 * amount.min(), 1.3 * amount.max()
        reach = (high - low) * np.linalg.norm(mode, axis=-1).max() / lattice.spacing
        axes.append(np.linspace(low, high, int(np.clip(np.ceil(reach / STEP) + 1, 2, GRID))))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    grid = mean + np.tensordot(points, modes, 1)
    distance = np.linalg.norm(lattice.rest + np.array(motions) - _compute_centre(lattice), axis=-1)
    return MotionPrior(grid.astype(np.float32), float(np.nanmax(distance)) + 0.1 * lattice.spacing)


def _compute_centre(lattice: Lattice) -> np.ndarray:
    return (lattice.rest.max(axis=0) + lattice.rest.min(axis=0)) / 2


def _propose_motions(
    lattice: Lattice, detected: np.ndarray, prior: MotionPrior | None
) -> Iterator[np.ndarray]:
    """Propose motions (P, 2) px to start from, the likeliest affine one first.

    The best ones of the prior follow, or turned ones if there is no prior.
    """
    likeliest = _fit_affine(lattice, detected, max(len(lattice.rest) - len(detected), 0))
    yield likeliest - lattice.rest
    if prior is not None:
        yield from _search_prior(lattice, detected, prior)
        return
    middle = likeliest.mean(axis=0)
    for angle in np.radians(FIRST_TURNS_DEG):
        yield (likeliest - middle) @ rotation_2d(-angle) + middle - lattice.rest


def _propose_worn_motions(lattice: Lattice, detected: np.ndarray) -> Iterator[np.ndarray]:
    """Propose motions (P, 2) px of pins of which some are lost, anywhere."""
    unseen = len(lattice.rest) - len(detected)
    for hidden in sorted({0, max(unseen, 0) // 2, max(unseen, 0)}):
        likeliest = _fit_affine(lattice, detected, hidden)
        middle = likeliest.mean(axis=0)
        for angle in np.radians(WORN_TURNS_DEG):
            yield (likeliest - middle) @ rotation_2d(-angle) + middle - lattice.rest


def _search_prior(lattice: Lattice, detected: np.ndarray, prior: MotionPrior) -> np.ndarray:
    """Find the prior motions (TRIED_MOTIONS, P, 2) that put the lattice nearest to the pins.

    The cost of a pin is its distance to the nearest detected one, half a spacing at most; a pin too
    many or too few in view costs as much. Distances are looked up on a map at half a pixel, so that
    the entire grid costs little more than one image.
    """
    low = detected.min(axis=0) - 2 * lattice.spacing
    high = detected.max(axis=0) + 2 * lattice.spacing
    empty = np.ones(np.ceil(2 * (high - low)).astype(int)[::-1] + 1, bool)
    column, row = np.round(2 * (detected - low)).astype(int).T
    empty[row, column] = False
    distance = ndimage.distance_transform_edt(empty) / (2 * lattice.spacing)
    cost_map = np.minimum(distance, 0.5).astype(np.float32)
    position = lattice.rest.astype(np.float32) + prior.motion
    in_view = np.linalg.norm(position - _compute_centre(lattice), axis=-1) < prior.view
    cell = np.clip(np.round(2 * (position - low)).astype(int), 0, np.array(empty.shape)[::-1] - 1)
    pin_cost = (cost_map[cell[..., 1], cell[..., 0]] * in_view).sum(-1)
    cost = pin_cost + 0.5 * np.abs(in_view.sum(-1) - len(detected))
    return prior.motion[np.argsort(cost)[:TRIED_MOTIONS]].astype(float)


def _fit_affine(lattice: Lattice, detected: np.ndarray, hidden: int) -> np.ndarray:
    """Move the pins (P, 2) to the mean and covariance of the detected ones, without a turn.

    Where a side of the pins has left the view, the outermost, as many as are `hidden`, are left out
    of the comparison.
    """
    rest, middle, spread = lattice.rest, detected.mean(axis=0), np.cov(detected.T)
    compared = np.arange(len(rest))
    for _ in range(5):
        subset = rest[compared]
        root = _root(np.cov(subset.T))
        inverse = np.linalg.inv(root)
        stretch = inverse @ _root(root @ spread @ root) @ inverse
        position = (rest - subset.mean(axis=0)) @ stretch + middle
        distance = np.linalg.norm(position - _compute_centre(lattice), axis=-1)
        inner = np.sort(np.argsort(distance)[: len(rest) - hidden])
        if np.array_equal(inner, compared):
            break
        compared = inner
    return position


def _root(matrix: np.ndarray) -> np.ndarray:
    """Return the square root of a symmetric matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T


def _match_iteratively(lattice: Lattice, detected: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Match pins to the rows (P,) of the detected ones, -1 for none, from a first motion (P, 2)."""
    pairs = _pair_nearest(lattice.rest + motion, detected)
    for degree in POLYNOMIAL_DEGREES:
        for _ in range(REPEATS):
            middle = _compute_middle(pairs.distance)
            motion = _fit_polynomial(lattice, detected, pairs, degree)
            pairs = _pair_nearest(lattice.rest + motion, detected)
            if _compute_middle(pairs.distance) > CONVERGED_RATIO * middle:
                break
    return _follow_neighbours(lattice, detected, pairs, motion)


class _Pairs(NamedTuple):
    """Pairs of an expected and a detected pin that are each other's nearest."""

    pin: np.ndarray  # (N,) rows of the expected pins
    detected: np.ndarray  # (N,) rows of the detected pins
    distance: np.ndarray  # (N,) px


def _fit_polynomial(
    lattice: Lattice, detected: np.ndarray, pairs: _Pairs, degree: int
) -> np.ndarray:
    """Fit a motion (P, 2) px, a polynomial of the rest position, to pairs; far ones count less."""
    scale = max(2.5 * _compute_middle(pairs.distance), 0.06 * lattice.spacing)
    share = 1 / (1 + (pairs.distance / scale) ** 2)
    powers = lattice.powers[degree]
    paired = powers[pairs.pin]
    weighted = paired.T * share
    normal = weighted @ paired + 1e-3 * np.eye(powers.shape[1])
    motion = detected[pairs.detected] - lattice.rest[pairs.pin]
    return powers @ np.linalg.solve(normal, weighted @ motion)


def _follow_neighbours(
    lattice: Lattice, detected: np.ndarray, pairs: _Pairs, motion: np.ndarray
) -> np.ndarray:
    """Match pins to detected ones (P,) while each pin follows the motion of its neighbours."""
    identity = np.full(len(lattice.rest), -1)
    for _ in range(NEIGHBOUR_REPEATS):
        near = pairs.distance <= MAX_MATCH_DISTANCE * lattice.spacing
        before, identity = identity, np.full(len(lattice.rest), -1)
        identity[pairs.pin[near]] = pairs.detected[near]
        if np.array_equal(before, identity):
            break
        matched = np.where(identity[:, None] >= 0, detected[identity] - lattice.rest, motion)
        motion = lattice.neighbour_weights @ matched
        pairs = _pair_nearest(lattice.rest + motion, detected)
    return identity


def _compute_middle(values: np.ndarray) -> float:
    """Return the median, or the next above it.

    `numpy.median` spends most of its time on checks, and this runs a dozen times an image.
    """
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def _pair_nearest(expected: np.ndarray, detected: np.ndarray) -> _Pairs:
    """Pair the expected and detected pins that are each other's nearest."""
    # For some hundred pins all distances at once take less time than trees do.
    middle = detected.mean(axis=0)
    here, there = (expected - middle).astype(np.float32), (detected - middle).astype(np.float32)
    squares = here @ (-2 * there.T)
    squares += (here**2).sum(axis=1)[:, None]
    squares += (there**2).sum(axis=1)
    nearest = squares.argmin(axis=1)
    rows = np.flatnonzero(squares.argmin(axis=0)[nearest] == np.arange(len(expected)))
    columns = nearest[rows]
    return _Pairs(rows, columns, np.hypot(*(expected[rows] - detected[columns]).T))
