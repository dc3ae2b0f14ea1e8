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

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from jaxunshear.angles import rotation_2d
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.pin_detection import DetectedPins, detect_pins
from jaxunshear.perception.pin_matching import compute_middle, fit_affine, match_iteratively
from jaxunshear.perception.pin_track import (
    MIN_DETECTED_SHARE,
    PinTrack,
    Rating,
    add_lost_pins,
    assess_track,
    refine_track,
    repair_identities,
)
from jaxunshear.perception.worn_dome import track_worn_pins

FIRST_TURNS_DEG = (4, -4, 8, -8)  # of the first motion, tried if no prior is known
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
            track if track.is_final else track_pins(lattice, detected, prior)
            for track, detected in zip(tracks, frames, strict=True)
        ]
    return [
        track_worn_pins(lattice, detected, track)
        for track, detected in zip(tracks, frames, strict=True)
    ]


def track_pins(
    lattice: Lattice, detected: DetectedPins, prior: MotionPrior | None = None
) -> PinTrack:
    """Track the pins of one image, with the help of a prior if there is one."""
    if lattice.intact is not None:
        if prior is not None:
            prior = prior._replace(motion=prior.motion[:, lattice.remaining])
        return add_lost_pins(lattice, track_pins(lattice.intact, detected, prior))
    pins, count = len(lattice.rest), len(detected.pins)
    missing = np.full((pins, 2), np.nan)
    best = PinTrack(missing, np.full(pins, -1), float("inf"), pins, count, False)
    if count < MIN_DETECTED_SHARE * pins:
        return best
    tried: set[bytes] = set()
    for rating in _match_in_turn(lattice, detected.pins, prior):
        key = rating.identity.tobytes()
        if key in tried:
            continue  # equal identities end as before
        tried.add(key)
        best = _choose_better(best, _finish_track(lattice, detected, rating))
        if best.is_final:
            break
    return best


def _match_in_turn(
    lattice: Lattice, detected: np.ndarray, prior: MotionPrior | None
) -> Iterator[Rating]:
    """Yield rated identities from each first motion, those with many faults last."""
    postponed = []
    for motion in _propose_motions(lattice, detected, prior):
        rating = match_iteratively(lattice, detected, motion)
        if rating.fault_count > MAX_FAULT_SHARE * len(lattice.rest):
            postponed.append(rating)
        else:
            yield rating
    yield from sorted(postponed, key=lambda rating: rating.fault_count)[:MAX_REPAIRED]


def _finish_track(lattice: Lattice, detected: DetectedPins, rating: Rating) -> PinTrack:
    """Repair rated identities, and measure doubtful pins again."""
    identity = repair_identities(lattice, detected.pins, rating)
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
    distance = np.linalg.norm(lattice.rest + np.array(motions) - compute_middle(lattice), axis=-1)
    return MotionPrior(grid.astype(np.float32), float(np.nanmax(distance)) + 0.1 * lattice.spacing)


def _propose_motions(
    lattice: Lattice, detected: np.ndarray, prior: MotionPrior | None
) -> Iterator[np.ndarray]:
    """Propose motions (P, 2) px to start from, the likeliest affine one first.

    The best ones of the prior follow, or turned ones if there is no prior.
    """
    likeliest = fit_affine(lattice, detected, max(len(lattice.rest) - len(detected), 0))
    yield likeliest - lattice.rest
    if prior is not None:
        yield from _search_prior(lattice, detected, prior)
        return
    middle = likeliest.mean(axis=0)
    for angle in np.radians(FIRST_TURNS_DEG):
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
    in_view = np.linalg.norm(position - compute_middle(lattice), axis=-1) < prior.view
    cell = np.clip(np.round(2 * (position - low)).astype(int), 0, np.array(empty.shape)[::-1] - 1)
    pin_cost = (cost_map[cell[..., 1], cell[..., 0]] * in_view).sum(-1)
    cost = pin_cost + 0.5 * np.abs(in_view.sum(-1) - len(detected))
    return prior.motion[np.argsort(cost)[:TRIED_MOTIONS]].astype(float)
