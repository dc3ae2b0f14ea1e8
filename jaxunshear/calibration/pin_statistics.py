"""What images of pins say in numbers: the same functions on recorded and on simulated images.

seen = observe_pins(images, TACTIP_331)          # binary images (N, S, S)
radii = compute_ring_radii(seen.lattice.shell, seen.place, seen.rest)       # (N, rings)
motion = compute_ring_motion(seen.lattice.shell, seen.place - seen.rest)    # (N, rings + 1)

Rings are given by the motions of the pins that were found: their mean place would jump by a sixtieth of the radius with every pin of the
outermost ring that the housing hides.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from skimage.measure import label

from jaxunshear.angles import rotation_2d
from jaxunshear.config.sensor import Sensor
from jaxunshear.perception.lattice import Lattice, measure_spacing
from jaxunshear.perception.lattice_fitting import fit_lattice, make_layout
from jaxunshear.perception.pin_detection import DetectedPins, find_pins
from jaxunshear.perception.pin_tracking import track_all
from jaxunshear.progress import Progress

CENTRAL = 1  # pins up to this ring are the central ones: seven of them
SLIDE_BINS_MM = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)


class PinObservation(NamedTuple):
    """The pins of N images of one camera; lengths in px of the image."""

    size: int  # px, of the square images
    lattice: Lattice
    positions: np.ndarray  # (N, P, 2) from the middle of the outermost ring, as (column, row); NaN where a pin was not found
    diameter: np.ndarray  # (N, P) of a disc of the pin's area; NaN where not found
    doubt: np.ndarray  # (N,), see `pin_tracking.PinTrack`
    identified: np.ndarray  # (N,) bool: the pins' identities are beyond doubt
    pin_counts: np.ndarray  # (N,) pins
    spacing: np.ndarray  # (N,) usual distance between nearest neighbours
    white_share: np.ndarray  # (N,) white share of the full image, housing and all

    def take(self, rows: np.ndarray) -> "PinObservation":
        return PinObservation(self.size, self.lattice, *(field[rows] for field in self[2:]))

    def rotate(self, mirrored: bool, angle: float) -> "PinObservation":
        """The same pins seen by a camera that is not mirrored, and turned by `angle` rad from column towards row."""
        turn = compute_camera_rotation(angle, mirrored)
        return self._replace(
            positions=self.positions @ turn,
            lattice=self.lattice._replace(rest=self.lattice.rest @ turn),
        )

    @property
    def rest(self) -> np.ndarray:
        """(P, 2) place of each pin of the lattice."""
        return self.lattice.rest - self.lattice.centre


def compute_camera_rotation(angle: float, mirrored: bool = False) -> np.ndarray:
    """(2, 2): px @ this are px of a camera that is not mirrored, and turned by `angle` rad from column towards row."""
    turn = rotation_2d(-angle)
    return np.diag([1.0, -1.0]) @ turn if mirrored else turn


def compute_unit_vectors(place: np.ndarray) -> np.ndarray:
    """(P, 2) -> (P, 2); zero for a pin within a twentieth of the outermost one's distance from the middle: the apex pin."""
    length = np.linalg.norm(place, axis=-1, keepdims=True)
    return np.where(length > 0.05 * length.max(), place / np.maximum(length, 1e-9), 0.0)


def observe_pins(
    images: Sequence[np.ndarray] | np.ndarray, sensor: Sensor, progress: Progress | None = None
) -> PinObservation:
    """Finds and follows the pins of binary images (S, S) uint8. Raises UserError where they are not this sensor's pins."""
    found = []
    for image in images:
        found.append(find_pins(image))
        if progress is not None:
            progress.advance()
    lattice = fit_lattice(found, make_layout(sensor))
    tracks = track_all(lattice, [DetectedPins(pins) for pins in found])
    diameters = [
        measure_pin_diameters(image, pins) for image, pins in zip(images, found, strict=True)
    ]
    diameter = [
        np.where(track.identity >= 0, np.append(d, np.nan)[track.identity], np.nan)
        for track, d in zip(tracks, diameters, strict=True)
    ]
    return PinObservation(
        images[0].shape[0],
        lattice,
        np.array([track.motion for track in tracks]) + lattice.rest - lattice.centre,
        np.array(diameter),
        np.array([track.max_offset for track in tracks]),
        np.array([track.identified for track in tracks]),
        np.array([len(pins) for pins in found]),
        np.array([measure_spacing(pins) if len(pins) > 1 else np.nan for pins in found]),
        np.array([np.mean(image > 127) for image in images]),
    )


def measure_pin_diameters(image: np.ndarray, pins: np.ndarray) -> np.ndarray:
    """Diameters (N,) px of discs of the pins' areas in a binary image; pins that touch share their area evenly."""
    parts = label(image > 127, connectivity=1)
    column, row = np.clip(np.rint(pins).astype(int), 0, parts.shape[0] - 1).T.reshape(2, -1)
    part = parts[row, column]
    area = np.bincount(parts.ravel()) / np.maximum(np.bincount(part, minlength=parts.max() + 1), 1)
    return np.where(part > 0, 2 * np.sqrt(area[part] / np.pi), np.nan)


def _by_ring(shell: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Means (..., rings + 1) over the pins (..., P) of each ring, NaN left out; NaN where all are."""
    known = np.isfinite(values)
    member = np.eye(shell.max() + 1)[shell]
    count = known.astype(float) @ member
    return np.where(count > 0, np.where(known, values, 0) @ member / np.maximum(count, 1), np.nan)


def compute_ring_radii(shell: np.ndarray, place: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Mean distance (..., rings) from the middle of each ring, the apex pin left out, along the directions of `rest` (P, 2)."""
    direction = compute_unit_vectors(rest)
    undisturbed, growth = ((each * direction).sum(-1) for each in (rest, place - rest))
    return (_by_ring(shell, undisturbed) + _by_ring(shell, growth))[..., 1:]


def compute_ring_shift(shell: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Mean motion (N, rings + 1) of each ring as column + i row, from pins' motions (N, P, 2)."""
    return _by_ring(shell, motion[..., 0]) + 1j * _by_ring(shell, motion[..., 1])


def compute_ring_motion(shell: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """`compute_ring_shift` (N, rings + 1) less its mean over the N images."""
    return subtract_mean(compute_ring_shift(shell, motion))


def subtract_mean(values: np.ndarray) -> np.ndarray:
    """(N, F) less the mean over N, NaN left out."""
    known = np.isfinite(values)
    return values - np.where(known, values, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)


def average_central_pins(motion: np.ndarray) -> np.ndarray:
    """(N,) of the seven pins in the middle, from `compute_ring_motion`."""
    weight = np.array([1.0, *(6.0 * k for k in range(1, CENTRAL + 1))])
    return motion[:, : CENTRAL + 1] @ (weight / weight.sum())


def compute_lag(motion: np.ndarray, slide: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """How far (N,) px a motion (N,) complex in the frame of a sensor at `yaw` (N,) rad lies against its slide (N, 2) mm."""
    heading = slide @ np.array([1, 1j])
    length = np.abs(heading)
    return -np.real(motion * np.exp(1j * yaw) * np.conj(heading)) / np.where(
        length > 0, length, np.nan
    )


def find_slide_bin(slide: np.ndarray) -> np.ndarray:
    """(N,) index into SLIDE_BINS_MM of the slides (N, 2) mm; -1 for taps."""
    length = np.linalg.norm(slide, axis=-1)
    return np.where(length > 1e-6, np.digitize(length, SLIDE_BINS_MM) - 1, -1)


class Summary(NamedTuple):
    """One figure an image, (N,), NaN where it says nothing: its mean over images is the statistic."""

    name: str
    unit: str
    values: np.ndarray


def summarise_pins(
    seen: PinObservation, slide: np.ndarray | None = None, yaw: np.ndarray | None = None
) -> list[Summary]:
    """Statistics in px of 128, so that images of any size compare. `slide` (N, 2) mm and `yaw` (N,), see `compute_lag`."""
    scale = 128 / seen.size
    shell, radii = (
        seen.lattice.ring,
        compute_ring_radii(seen.lattice.ring, seen.positions, seen.rest),
    )
    diameter, middle = (
        _by_ring(shell, seen.diameter),
        _by_ring((shell > CENTRAL).astype(int), seen.diameter)[:, 0],
    )
    followed = np.isfinite(seen.diameter).any(axis=1)
    usual, area = np.full((2, len(followed)), np.nan)
    usual[followed] = np.nanmean(
        seen.diameter[followed], axis=1
    )  # the median would be that of a few integers
    area[followed] = np.nansum(np.pi / 4 * seen.diameter[followed] ** 2, axis=1) / seen.size**2
    rows = [
        Summary("pins found", "1", seen.pin_counts.astype(float)),
        Summary("pin spacing", "px", seen.spacing * scale),
        Summary("pin diameter", "px", usual * scale),
        Summary("pin diameter, rim over middle", "1", diameter[:, -1] / middle),
        Summary("white share of pins", "1", area),
        Summary("white share of image", "1", seen.white_share),
        Summary("outermost ring, share of width", "1", radii[:, -1] / seen.size),
    ]
    rows += [
        Summary(f"ring {k + 1} over outermost", "1", radii[:, k] / radii[:, -1])
        for k in range(radii.shape[1] - 1)
    ]
    if slide is not None and yaw is not None:
        motion, index = (
            compute_ring_motion(shell, seen.positions - seen.rest),
            find_slide_bin(slide),
        )
        for name, part in (
            ("central pins", average_central_pins(motion)),
            ("outermost ring", motion[:, -1]),
        ):
            behind = compute_lag(part, slide, yaw) * scale
            for k, least in enumerate(SLIDE_BINS_MM):
                most = f"to {SLIDE_BINS_MM[k + 1]:g}" if k + 1 < len(SLIDE_BINS_MM) else "or more"
                rows.append(
                    Summary(
                        f"{name} left behind, slide {least:g} {most} mm",
                        "px",
                        np.where(index == k, behind, np.nan),
                    )
                )
    return rows
