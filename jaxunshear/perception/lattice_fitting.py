"""Fit the lattice of a camera's images to them, however the camera frames and turns them."""

from collections.abc import Sequence
from itertools import product, starmap
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from jaxunshear.angles import rotation_2d
from jaxunshear.config.sensor import Camera, Preprocess, Sensor
from jaxunshear.errors import UserError
from jaxunshear.perception.lattice import (
    Lattice,
    check_pin_numbers,
    compute_rings,
    make_lattice,
    measure_spacing,
)
from jaxunshear.perception.pin_detection import DetectedPins, find_hull
from jaxunshear.perception.pin_track import PinTrack
from jaxunshear.perception.pin_tracking import track_all
from jaxunshear.perception.worn_dome import find_lost_pins
from jaxunshear.simulator.camera import project, to_image_px
from jaxunshear.simulator.pin_layout import compute_pin_lattice, compute_pin_tips

RADIAL_BENDS = (-0.1, 0.0, 0.1, 0.2)  # of a lens or a dome: by how much the middle is drawn in
TURN_DEG = 1.5
# How much worse a turn may match and still be the lattice turned by its own symmetry.
MAX_MATCH_RATIO = 1.1
MIN_PIN_SHARE = 0.7  # of a layout's pins: images that show fewer are not used
MAX_IMAGES = 60  # images, evenly spaced: more do not change the mean
GUESS_IMAGES = 10
FOLDS = (6, 4, 3, 2)  # turns by a share of a circle that may leave a layout alike
MAX_FOLD_ERROR = 0.3  # of the spacing, by which pins of a layout then miss others
# directions in which the width of an outline is measured
DIRECTIONS = np.stack([np.cos(np.arange(18) * np.pi / 18), np.sin(np.arange(18) * np.pi / 18)])
MIN_TRACKED_SHARE = 0.9  # of the pins, in any image
MAX_EXTRA_SHARE = 0.1  # detected pins without an identity, over the pins


class MarkerLayout(NamedTuple):
    """The pins on the skin rolled out flat, in any unit."""

    name: str
    flat: np.ndarray  # (P, 2) about the middle
    ring: np.ndarray  # (P,) 0 in the middle
    symmetry_deg: float  # turned by this it looks alike, and no image shows which turn it has
    dark: bool = False  # whether markers are dark on a light ground


def make_layout(sensor: Sensor) -> MarkerLayout:
    """Return the pins of a sensor, in its order. Raises UserError for one that cannot be."""
    name, flat = f"sensor '{sensor.name}' ({sensor.layout})", compute_pin_lattice(sensor)
    flat = flat - (flat.max(axis=0) + flat.min(axis=0)) / 2
    return MarkerLayout(name, flat, compute_rings(sensor), _find_symmetry(flat), sensor.is_dark)


def _find_symmetry(flat: np.ndarray) -> float:
    """Find the least angle, degrees, by which pins can be turned onto each other."""
    tree, limit = cKDTree(flat), MAX_FOLD_ERROR * measure_spacing(flat)
    for fold in FOLDS:
        if tree.query(flat @ rotation_2d(2 * np.pi / fold))[0].max() < limit:
            return 360.0 / fold
    return 360.0


def fit_lattice(
    frames: list[Float[np.ndarray, "_ 2"]], layout: MarkerLayout, without: Sequence[int] = ()
) -> Lattice:
    """Fit the lattice that images of one camera share: the mean position of each pin.

    `frames` holds the detected pins px of each image. Pins that none of ten or more images shows
    are lost, and those named by `without`. Raises UserError if these do not appear to be pins of
    this layout.
    """
    check_pin_numbers(without, len(layout.flat))
    full = [pins for pins in frames if len(pins) >= MIN_PIN_SHARE * len(layout.flat)]
    if not full:
        most = max((len(pins) for pins in frames), default=0)
        raise UserError(
            f"at most {most} pins are found in an image, where {layout.name} has {len(layout.flat)}"
        )
    frames = full[:: -(-len(full) // MAX_IMAGES)]
    rest, lost = _guess_rest(frames, layout), without
    for _ in range(2):
        lattice = make_lattice(rest, layout.ring, lost)
        tracks = track_all(lattice, [DetectedPins(pins) for pins in frames])
        mean_motion = _measure_mean_motion(lattice, tracks)
        if mean_motion is None:
            raise UserError(
                f"the pins of these images do not form the lattice of {layout.name} with "
                f"{len(rest)} pins: about {np.median([len(pins) for pins in frames]):.0f} pins "
                "are found; name another sensor"
            )
        rest, lost = rest + mean_motion, without or find_lost_pins(tracks)
    return make_lattice(rest, layout.ring, lost)


def _measure_mean_motion(lattice: Lattice, tracks: list[PinTrack]) -> np.ndarray | None:
    """Measure the mean motion (P, 2) px of the pins; None if they do not match the lattice.

    Pins that no image shows follow the mean motion of their neighbours.
    """
    identified = [track for track in tracks if track.identified]
    motion = np.array([track.motion for track in identified or tracks])
    count = np.isfinite(motion[..., 0]).sum(axis=0)
    extra = np.median([track.extra for track in tracks])
    if np.mean(count > 0) < MIN_TRACKED_SHARE or extra > MAX_EXTRA_SHARE * len(lattice.rest):
        return None
    mean = np.nansum(motion, axis=0) / np.maximum(count, 1)[:, None]
    return lattice.fill_missing(np.where(count[:, None] > 0, mean, np.nan))


def _guess_rest(frames: list[np.ndarray], layout: MarkerLayout) -> np.ndarray:
    """Guess rest positions (P, 2) px: the flat lattice, bent in radius, on the rim of all pins.

    It is turned to match the outer rings, by the least turn of those that match about equally well:
    in a lattice of some symmetry noise must not choose which pin is which.
    """
    flat = layout.flat / np.linalg.norm(layout.flat, axis=-1).max()
    radius = np.linalg.norm(flat, axis=-1, keepdims=True)
    outlines = []
    for pins in frames:
        corners = find_hull(pins)
        outlines.append(pins[corners] if len(corners) else pins)
    hulls = np.concatenate(outlines)
    centre = (np.percentile(hulls, 2, axis=0) + np.percentile(hulls, 98, axis=0)) / 2
    widths = np.subtract(*np.percentile(hulls @ DIRECTIONS, (98, 2), axis=0))
    rim = float(np.mean(widths) / np.mean(np.ptp(flat @ DIRECTIONS, axis=0)))
    outer = layout.ring >= layout.ring.max() - 2
    step = max(1, len(frames) // GUESS_IMAGES)
    trees = [cKDTree(pins) for pins in frames[::step][:GUESS_IMAGES]]

    def place(turn: float, bend: float) -> np.ndarray:
        return centre + rim * (1 + bend * (1 - radius**2)) * flat @ rotation_2d(-turn)

    def measure_distance(turn: float, bend: float) -> float:
        expected = place(turn, bend)[outer]
        return float(np.mean([np.median(tree.query(expected)[0]) for tree in trees]))

    turns = np.radians(np.arange(-layout.symmetry_deg / 2, layout.symmetry_deg / 2, TURN_DEG))
    distances = list(starmap(measure_distance, product(turns, RADIAL_BENDS)))
    distance = np.reshape(distances, (len(turns), len(RADIAL_BENDS)))
    near_best = np.flatnonzero(distance.min(axis=1) <= MAX_MATCH_RATIO * distance.min())
    best = near_best[np.argmin(np.abs(turns[near_best]))]
    return place(turns[best], RADIAL_BENDS[np.argmin(distance[best])])


def compute_rest_lattice(sensor: Sensor, camera: Camera, preprocess: Preprocess) -> Lattice:
    """Compute the lattice, px of the prepared image, of a sensor that touches nothing."""
    px = project(camera, jnp.asarray(compute_pin_tips(sensor), jnp.float32), sensor)
    rest = np.asarray(to_image_px(camera, preprocess, px), float)
    return make_lattice(rest, compute_rings(sensor))
