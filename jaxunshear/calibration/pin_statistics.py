"""Statistics of images of pins, the same for recorded and for simulated images.

observation = observe_pins(images, TACTIP_331)    # binary images (N, S, S)
ring, rest = observation.lattice.ring, observation.rest
radii = compute_ring_radii(ring, observation.positions, rest)      # (N, rings)
motion = compute_ring_motion(ring, observation.positions - rest)   # (N, rings + 1)

Rings are measured by the motions of the pins that were detected. Their mean position would jump by
a sixtieth of the radius with every pin of the outermost ring that the housing hides.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from skimage.measure import label

from jaxunshear.angles import rotation_2d
from jaxunshear.calibration.labels import LabelledMotions
from jaxunshear.config.sensor import Sensor
from jaxunshear.perception.lattice import Lattice, measure_spacing
from jaxunshear.perception.lattice_fitting import fit_lattice, make_layout
from jaxunshear.perception.pin_detection import DetectedPins, detect_pin_centres
from jaxunshear.perception.pin_tracking import track_all
from jaxunshear.progress import Progress

CENTRAL = 1  # pins up to this ring are the central ones: seven of them
SLIDE_BINS_MM = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)


class PinObservation(NamedTuple):
    """The pins of N images of one camera; lengths in px of the image."""

    size: int  # px, of the square images
    lattice: Lattice
    # (N, P, 2) from the middle of the outermost ring, as (column, row); NaN if not detected
    positions: np.ndarray
    diameter: np.ndarray  # (N, P) of a disc of the pin's area; NaN if not detected
    identified: np.ndarray  # (N,) bool: the pins' identities are beyond doubt
    pin_counts: np.ndarray  # (N,) detected pins
    spacing: np.ndarray  # (N,) usual distance between nearest neighbours
    white_share: np.ndarray  # (N,) white share of the full image, with the housing

    def take(self, rows: np.ndarray) -> "PinObservation":
        return PinObservation(self.size, self.lattice, *(field[rows] for field in self[2:]))

    def rotate(self, mirrored: bool, angle: float) -> "PinObservation":
        """Show the pins as a camera that is not mirrored, and turned by `angle`, sees them.

        The angle is in rad, from column to row.
        """
        turn = compute_camera_rotation(angle, mirrored)
        return self._replace(
            positions=self.positions @ turn,
            lattice=self.lattice._replace(rest=self.lattice.rest @ turn),
        )

    @property
    def rest(self) -> np.ndarray:
        """(P, 2) rest position of each pin of the lattice, from its centre."""
        return self.lattice.rest - self.lattice.centre


def compute_camera_rotation(angle: float, mirrored: bool = False) -> np.ndarray:
    """Compute the matrix (2, 2) of `PinObservation.rotate`, for px (..., 2) @ matrix."""
    turn = rotation_2d(-angle)
    return np.diag([1.0, -1.0]) @ turn if mirrored else turn


def make_observation(size: int, lattice: Lattice, positions: np.ndarray) -> PinObservation:
    """Make an observation of positions (N, P, 2) alone, of pins that are all identified."""
    unknown = np.full(len(positions), np.nan)
    identified = np.ones(len(positions), bool)
    diameter = np.full(positions.shape[:2], np.nan)
    return PinObservation(size, lattice, positions, diameter, identified, unknown, unknown, unknown)


def observe_pins(
    images: Sequence[np.ndarray] | np.ndarray, sensor: Sensor, progress: Progress | None = None
) -> PinObservation:
    """Find and follow the pins of binary images (S, S) uint8.

    Raises UserError if they are not this sensor's pins.
    """
    detected = []
    for image in images:
        detected.append(detect_pin_centres(image))
        if progress is not None:
            progress.advance()
    lattice = fit_lattice(detected, make_layout(sensor))
    tracks = track_all(lattice, [DetectedPins(pins) for pins in detected])
    diameters = []
    for image, pins, track in zip(images, detected, tracks, strict=True):
        by_pin = np.append(measure_pin_diameters(image, pins), np.nan)
        diameters.append(np.where(track.identity >= 0, by_pin[track.identity], np.nan))
    return PinObservation(
        size=images[0].shape[0],
        lattice=lattice,
        positions=np.array([track.motion for track in tracks]) + lattice.rest - lattice.centre,
        diameter=np.array(diameters),
        identified=np.array([track.identified for track in tracks]),
        pin_counts=np.array([len(pins) for pins in detected]),
        spacing=np.array([measure_spacing(pins) if len(pins) > 1 else np.nan for pins in detected]),
        white_share=np.array([np.mean(image > 127) for image in images]),
    )


def measure_pin_diameters(image: np.ndarray, pins: np.ndarray) -> np.ndarray:
    """Measure diameters (N,) px of discs of the pins' areas in a binary image.

    Pins that touch share their area evenly.
    """
    parts = label(image > 127, connectivity=1)
    column, row = np.clip(np.rint(pins).astype(int), 0, parts.shape[0] - 1).T.reshape(2, -1)
    part = parts[row, column]
    area = np.bincount(parts.ravel()) / np.maximum(np.bincount(part, minlength=parts.max() + 1), 1)
    return np.where(part > 0, 2 * np.sqrt(area[part] / np.pi), np.nan)


def _average_by_ring(ring: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Average (..., P) over the finite pins of each ring: (..., rings + 1), NaN if none is."""
    finite = np.isfinite(values)
    member = np.eye(ring.max() + 1)[ring]
    count = finite.astype(float) @ member
    return np.where(count > 0, np.where(finite, values, 0) @ member / np.maximum(count, 1), np.nan)


def compute_ring_radii(ring: np.ndarray, positions: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Compute the mean distance (..., rings) of each ring from the middle.

    The apex pin is left out: it is within a twentieth of the outermost pin's distance. Distances
    are along the directions of `rest` (P, 2); `ring` (P,) is the ring of each pin.
    """
    length = np.linalg.norm(rest, axis=-1, keepdims=True)
    direction = np.where(length > 0.05 * length.max(), rest / np.maximum(length, 1e-9), 0.0)
    undisturbed = (rest * direction).sum(-1)
    growth = ((positions - rest) * direction).sum(-1)
    return (_average_by_ring(ring, undisturbed) + _average_by_ring(ring, growth))[..., 1:]


def compute_ring_shift(ring: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Average pins' motions (N, P, 2) over each ring, (N, rings + 1) as column + i row."""
    return _average_by_ring(ring, motion[..., 0]) + 1j * _average_by_ring(ring, motion[..., 1])


def compute_ring_motion(ring: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Compute `compute_ring_shift` (N, rings + 1) less its mean over the N images."""
    return subtract_mean(compute_ring_shift(ring, motion))


def subtract_mean(values: np.ndarray) -> np.ndarray:
    """Subtract the mean over the first axis, without NaN."""
    finite = np.isfinite(values)
    return values - np.where(finite, values, 0).sum(axis=0) / np.maximum(finite.sum(axis=0), 1)


def average_central_pins(motion: np.ndarray) -> np.ndarray:
    """Average `compute_ring_motion` over the seven pins in the middle, (N,)."""
    weight = np.array([1.0, *(6.0 * k for k in range(1, CENTRAL + 1))])
    return motion[:, : CENTRAL + 1] @ (weight / weight.sum())


def compute_lag(motion: np.ndarray, slide: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Compute how far (N,) px a motion lies against its slide.

    Args:
        motion: (N,) complex, px, in the frame of the sensor.
        slide: (N, 2) mm.
        yaw: (N,) rad, of the sensor.
    """
    heading = slide @ np.array([1, 1j])
    length = np.abs(heading)
    along = np.real(motion * np.exp(1j * yaw) * np.conj(heading))
    return -along / np.where(length > 0, length, np.nan)


def find_slide_bin(slide: np.ndarray) -> np.ndarray:
    """Find the index (N,) into SLIDE_BINS_MM of slides (N, 2) mm; -1 for taps."""
    length = np.linalg.norm(slide, axis=-1)
    return np.where(length > 1e-6, np.digitize(length, SLIDE_BINS_MM) - 1, -1)


class Summary(NamedTuple):
    """One statistic: a value for each image, of which the mean is reported."""

    name: str
    unit: str
    values: np.ndarray  # (N,), NaN for images that do not count


def summarise_pins(observation: PinObservation) -> list[Summary]:
    """Compute statistics of the pins, in px of 128, so that images of any size compare."""
    size, scale, ring = observation.size, 128 / observation.size, observation.lattice.ring
    radii = compute_ring_radii(ring, observation.positions, observation.rest)
    by_ring = _average_by_ring(ring, observation.diameter)
    middle = _average_by_ring((ring > CENTRAL).astype(int), observation.diameter)[:, 0]
    followed = np.isfinite(observation.diameter).any(axis=1)
    diameter, area = np.full((2, len(followed)), np.nan)
    # not the median, which would be that of a few integers
    diameter[followed] = np.nanmean(observation.diameter[followed], axis=1)
    area[followed] = np.nansum(np.pi / 4 * observation.diameter[followed] ** 2, axis=1) / size**2
    rows = [
        Summary("pins found", "1", observation.pin_counts.astype(float)),
        Summary("pin spacing", "px", observation.spacing * scale),
        Summary("pin diameter", "px", diameter * scale),
        Summary("pin diameter, rim over middle", "1", by_ring[:, -1] / middle),
        Summary("white share of pins", "1", area),
        Summary("white share of image", "1", observation.white_share),
        Summary("outermost ring, share of width", "1", radii[:, -1] / size),
    ]
    for k in range(radii.shape[1] - 1):
        rows.append(Summary(f"ring {k + 1} over outermost", "1", radii[:, k] / radii[:, -1]))
    return rows


def summarise_slides(observation: PinObservation, contacts: LabelledMotions) -> list[Summary]:
    """Compute how far pins are left behind, in px of 128, by length of the slide."""
    motion = compute_ring_motion(observation.lattice.ring, observation.positions - observation.rest)
    slide_bin = find_slide_bin(contacts.slide)
    parts = {"central pins": average_central_pins(motion), "outermost ring": motion[:, -1]}
    rows = []
    for part, part_motion in parts.items():
        lag = compute_lag(part_motion, contacts.slide, contacts.yaw) * (128 / observation.size)
        for k, least in enumerate(SLIDE_BINS_MM):
            most = f"to {SLIDE_BINS_MM[k + 1]:g}" if k + 1 < len(SLIDE_BINS_MM) else "or more"
            name = f"{part} left behind, slide {least:g} {most} mm"
            rows.append(Summary(name, "px", np.where(slide_bin == k, lag, np.nan)))
    return rows
