"""The lattice of a set of images, read off them: whatever the camera's framing and turn."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from jaxunshear.angles import rotation_2d
from jaxunshear.config.sensor import Sensor
from jaxunshear.errors import UserError
from jaxunshear.perception.lattice import Lattice, compute_rings, estimate_rings, make_lattice
from jaxunshear.perception.pin_detection import DetectedPins, find_hull
from jaxunshear.perception.pin_tracking import track_all
from jaxunshear.simulator.pin_layout import compute_pin_lattice

RADIAL_BENDS = (-0.1, 0.0, 0.1, 0.2)  # of a lens or a dome: how far the middle is drawn together
TURN_DEG = 1.5
MAX_MATCH_RATIO = (
    1.1  # how much worse a turn may match and still be the same lattice turned by its own symmetry
)
MIN_PIN_SHARE = 0.7  # of a layout's pins: images that show fewer say nothing of it
MAX_IMAGES = 60  # images, evenly spaced: more do not change the mean


class MarkerLayout(NamedTuple):
    """Pins on the skin rolled out flat, in any unit."""

    name: str
    flat: np.ndarray  # (P, 2) about the middle
    shell: np.ndarray  # (P,) 0 in the middle
    symmetry_deg: float  # turned by this it is the same again, and no image shows which


def make_layout(sensor: Sensor) -> MarkerLayout:
    """The pins of a sensor, in its order."""
    return MarkerLayout(
        f"sensor '{sensor.name}' ({sensor.layout})",
        compute_pin_lattice(sensor),
        compute_rings(sensor),
        60.0,
    )


def read_layout(file: Path) -> MarkerLayout:
    """A user's layout: two numbers a line, x and y of a pin in any unit, a heading allowed. Raises `UserError` by file and line."""
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"--layout {file} cannot be read: {error}") from error
    rows = []
    for number, line in enumerate(lines, 1):
        words = line.replace(",", " ").split()
        heading = number == 1 and not any(map(_is_number, words))
        if heading or not line.strip():
            continue
        if len(words) != 2 or not all(map(_is_number, words)):
            raise UserError(
                f"--layout {file}, line {number}: '{line.strip()}' is not two numbers, x and y"
            )
        rows.append([float(word) for word in words])
    flat = np.array(rows).reshape(-1, 2)
    if len(flat) < 20 or not np.isfinite(flat).all():
        raise UserError(
            f"--layout {file}: {len(flat)} pins with finite places; at least 20 are needed to distinguish them"
        )
    if len(np.unique(flat, axis=0)) < len(flat):
        raise UserError(f"--layout {file}: two pins stand at the same place")
    flat = flat - (flat.max(axis=0) + flat.min(axis=0)) / 2
    return MarkerLayout(f"layout {file.name}", flat, estimate_rings(flat), 360.0)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def fit_lattice(frames: list[Float[np.ndarray, "_ 2"]], layout: MarkerLayout) -> Lattice:
    """The lattice that the found pins px of images of one camera share: the mean place of each pin.

    Raises UserError where they do not appear to be pins of this layout.
    """
    full = [found for found in frames if len(found) >= MIN_PIN_SHARE * len(layout.flat)]
    if not full:
        most = max((len(found) for found in frames), default=0)
        raise UserError(
            f"at most {most} pins are found in an image, where {layout.name} has {len(layout.flat)}"
        )
    frames = full[:: -(-len(full) // MAX_IMAGES)]
    place = _first_guess(frames, layout)
    for _ in range(2):
        lattice = make_lattice(place, layout.shell)
        tracks = track_all(lattice, [DetectedPins(pins) for pins in frames])
        motion = np.array(
            [track.motion for track in tracks if track.identified]
            or [track.motion for track in tracks]
        )
        count = np.isfinite(motion[..., 0]).sum(axis=0)
        if np.mean(count > 0) < 0.9 or np.median([track.extra for track in tracks]) > 0.1 * len(
            place
        ):
            break
        mean = np.nansum(motion, axis=0) / np.maximum(count, 1)[:, None]
        place = place + np.where(count[:, None] > 0, mean, lattice.neighbour_weights @ mean)
    else:
        return make_lattice(place, layout.shell)
    raise UserError(
        f"the pins of these images do not form the lattice of {layout.name} with {len(place)} pins: "
        f"about {np.median([len(found) for found in frames]):.0f} pins are found; name another sensor"
    )


def _first_guess(frames: list[np.ndarray], layout: MarkerLayout) -> np.ndarray:
    """Places (P, 2) px: the flat lattice, bent in radius, on the rim of the pins of all frames, turned to match their outer shells.

    By the least turn of those that match about equally well: in a lattice of some symmetry noise must not choose which pin is which.
    """
    flat = layout.flat / np.linalg.norm(layout.flat, axis=-1).max()
    hulls = np.concatenate([_hull(found) for found in frames])
    centre = (np.percentile(hulls, 2, axis=0) + np.percentile(hulls, 98, axis=0)) / 2
    rim = float(np.median(np.linalg.norm(hulls - centre, axis=-1)))
    outer = layout.shell >= layout.shell.max() - 2
    trees = [cKDTree(found) for found in frames[:: max(1, len(frames) // 10)][:10]]
    radius = np.linalg.norm(flat, axis=-1, keepdims=True)

    def guess(turn: float, bend: float) -> np.ndarray:
        return centre + rim * (1 + bend * (1 - radius**2)) * flat @ rotation_2d(-turn)

    turns = np.radians(np.arange(-layout.symmetry_deg / 2, layout.symmetry_deg / 2, TURN_DEG))
    off = np.array(
        [
            [
                np.mean([np.median(tree.query(guess(turn, bend)[outer])[0]) for tree in trees])
                for bend in RADIAL_BENDS
            ]
            for turn in turns
        ]
    )
    alike = np.flatnonzero(off.min(axis=1) <= MAX_MATCH_RATIO * off.min())
    chosen = alike[np.argmin(np.abs(turns[alike]))]
    return guess(turns[chosen], RADIAL_BENDS[np.argmin(off[chosen])])


def _hull(found: np.ndarray) -> np.ndarray:
    corners = find_hull(found)
    return found[corners] if len(corners) else found
