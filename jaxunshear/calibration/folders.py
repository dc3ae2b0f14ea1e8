"""A folder of recorded contacts as the simulator can follow them: labels read, pins followed, the object's frame found."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxunshear.calibration.alignment import STEPS, Matter, find_frame
from jaxunshear.calibration.calibrate import LEAST_LABELLED
from jaxunshear.calibration.calibrated import Calibrated
from jaxunshear.calibration.ceiling import explained_by_labels
from jaxunshear.calibration.held_out import Parts
from jaxunshear.calibration.labels import Frame, Motions, framed, motions, to_paths
from jaxunshear.calibration.matching import read_labels
from jaxunshear.calibration.prediction import displacements
from jaxunshear.calibration.statistics import Seen
from jaxunshear.calibration.validation import Compared, centred, mm_per_px, settled
from jaxunshear.progress import Progress
from jaxunshear.scene.paths import DEPTH, X

CHUNK = 50  # contacts between two steps of the progress


@dataclass(frozen=True)
class Folder:
    """Its images in two parts: those that align, as `matter`, and those that are compared, with their labels as read."""

    name: str
    matter: Matter
    start: Frame  # where the search for the frame begins
    mirrored: bool
    angle: float  # rad, of the camera, before the frame is found
    seen: Seen  # compared contacts, as the camera has them
    contacts: Motions  # of the same
    images: tuple[str, ...]  # their names
    aligned_by: tuple[str, ...]  # names of the others


class Aligned(NamedTuple):
    """What a folder's labels do not give, read off images that are not compared."""

    frame: Frame
    angle: float  # rad, of the camera
    side: int
    images: int

    @property
    def note(self) -> str:
        frame = self.frame
        edge = f", edge {frame.across_mm:+.2f} mm from the labels' zero" if self.side else ""
        return (
            f"aligned by {self.images} other contacts: surface at {frame.surface_mm:.2f} mm of the depth axis, tilted by "
            f"{frame.tilt_x_deg:+.2f} and {frame.tilt_y_deg:+.2f} deg{edge}; camera turned by {np.degrees(self.angle):.1f} deg"
        )


def read_folder(parts: Parts, known: Calibrated) -> tuple[Folder | str, list[dict[str, str]]]:
    """A folder's labelled contacts, or why it has none that can be compared; and the images left out (image, why)."""
    align, scored = parts.align, parts.scored
    seen = align.observe(known.sensor)
    rows = np.flatnonzero(align.labelled & seen.sure)
    if len(rows) < LEAST_LABELLED:
        return f"{len(rows)} images to align by are labelled and followed, fewer than {LEAST_LABELLED}", []
    assert align.poses is not None  # else none would be labelled
    moves = None if align.moves is None else align.moves[rows]
    reading = read_labels(seen.take(rows), align.poses[rows], moves, known.values, known.sensor)
    if reading is None:
        return "its labels do not go with its images", []
    turned = seen.take(rows).turned(reading.mirrored, reading.angle)
    matter = Matter(turned, reading.contacts, reading.side, known.values, known.sensor)
    compared, labelled = scored.observe(known.sensor), scored.labelled
    left_out = _left_out(scored.names, ~labelled, "its label cannot be read")
    left_out += _left_out(scored.names, labelled & ~compared.sure, "its pins cannot be followed")
    kept = np.flatnonzero(labelled & compared.sure)
    if len(kept) < LEAST_LABELLED:
        return f"{len(kept)} contacts are labelled and followed, fewer than {LEAST_LABELLED}", left_out
    assert scored.poses is not None  # else none would be labelled
    folder = Folder(
        scored.name,
        matter,
        Frame(reading.surface_mm),
        reading.mirrored,
        reading.angle,
        compared.take(kept),
        motions(scored.poses[kept], None if scored.moves is None else reading.sign * scored.moves[kept]),
        tuple(scored.names[i] for i in kept),
        align.names,
    )
    return folder, left_out


def frame_names(as_labelled: bool) -> tuple[str, ...]:
    """What is found of the frame. `as_labelled`: edge and tilt are where the labels have them."""
    return ("surface_mm",) if as_labelled else tuple(STEPS)


def align(folder: Folder, known: Calibrated, as_labelled: bool, start: Frame) -> Aligned:
    """How a folder's labels and images go together, from images that are not compared; the search begins at `start`."""
    matter = with_values(folder.matter, known)
    frame = find_frame(matter, start, frame_names(as_labelled))
    return Aligned(frame, folder.angle - matter.turn(frame), matter.side, len(matter.contacts))


def with_values(matter: Matter, known: Calibrated) -> Matter:
    """The same contacts, to be followed by another sensor and camera."""
    return matter._replace(values=known.values, sensor=known.sensor)


def compare(folder: Folder, aligned: Aligned, known: Calibrated) -> tuple[Compared | None, list[dict[str, str]]]:
    """Recorded and simulated motions of the compared contacts, and those left out. None where too few converge."""
    contacts = framed(folder.contacts, aligned.frame)
    moved, converged = _solved(folder.name, contacts, aligned.side, known)
    kept = np.flatnonzero(converged)
    left_out = _left_out(folder.images, ~converged, "out of the simulator's reach, or not converged")
    if len(kept) < LEAST_LABELLED:
        return None, left_out
    seen = folder.seen.turned(folder.mirrored, aligned.angle).take(kept)
    return _result(folder.name, seen, contacts.take(kept), moved[kept], aligned.side, known), left_out


def _result(name: str, seen: Seen, contacts: Motions, moved: np.ndarray, side: int, known: Calibrated) -> Compared:
    sensor, values = known.sensor, known.values
    flat, place = settled(values, sensor, seen.size, seen.place, moved)
    recorded, simulated = centred(seen.place * (128 / seen.size), place * (128 / seen.size))
    end = to_paths(contacts, sensor, 0.0, side, values.friction).points[:, -1]
    return Compared(
        name,
        recorded,
        simulated,
        explained_by_labels(contacts, recorded),
        seen.lattice.shell,
        np.nanmean(seen.place, axis=0) * (128 / seen.size),
        mm_per_px(values, sensor, 128, flat),
        np.linalg.norm(contacts.tip[:, 1] - contacts.tip[:, 0], axis=-1),
        end[:, DEPTH],
        end[:, X] if side else np.full(len(end), np.nan),
    )


def _solved(name: str, contacts: Motions, side: int, known: Calibrated) -> tuple[np.ndarray, np.ndarray]:
    """As `displacements`, some contacts at a time."""
    values, parts = known.values, []
    with Progress(f"contacts of {name}", len(contacts), unit="contacts") as progress:
        for begin in range(0, len(contacts), CHUNK):
            some = contacts.take(np.arange(begin, min(begin + CHUNK, len(contacts))))
            parts.append(displacements(known.sensor, some, side, values.friction, 0.0, values.skin_to_gel))
            progress.advance(len(some))
    return np.concatenate([moved for moved, _ in parts]), np.concatenate([fine for _, fine in parts])


def _left_out(names: tuple[str, ...], lost: np.ndarray, why: str) -> list[dict[str, str]]:
    return [{"image": names[i], "why": why} for i in np.flatnonzero(lost)]
