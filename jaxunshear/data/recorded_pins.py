"""Measure where each pin of recorded images stands, and its motion (`jaxunshear pins`).

>>> pins = find_pins(Path("recordings"), make_layout(TACTIP_331))
>>> pins.motion_px[pins.sure]  # (images, pins, 2)
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.sensor import Preprocess
from jaxunshear.data.recordings import Recordings, read_first_image, read_recordings
from jaxunshear.data.sensor_frame import LARGEST_PX, explain_failure
from jaxunshear.errors import UserError
from jaxunshear.perception.lattice import Lattice, check_pin_numbers, make_lattice
from jaxunshear.perception.lattice_fitting import MarkerLayout, fit_lattice
from jaxunshear.perception.pin_detection import DetectedPins, detect_pins
from jaxunshear.perception.pin_track import PinTrack
from jaxunshear.perception.pin_tracking import track_all
from jaxunshear.perception.preprocess import View
from jaxunshear.progress import Progress
from jaxunshear.results.applications import PinScore, PinScores
from jaxunshear.selection import select_evenly

SHOWN_IMAGES = 12
MAX_NAMED = 8  # images, in the summary
MAX_NOTES = 5


class ShownImage(NamedTuple):
    """An image to be drawn with its pins."""

    name: str
    image: np.ndarray
    track: PinTrack


@dataclass(frozen=True)
class Pins:
    """P pins of N images by identity, NaN for missing pins and for images without identities."""

    name: np.ndarray  # (N,) of the images
    sure: np.ndarray  # (N,) bool
    place_px: np.ndarray  # (N, P, 2)
    motion_px: np.ndarray  # (N, P, 2) from the rest positions
    lattice: Lattice  # the rest positions
    table: PinScores  # how well it went, image by image
    shown: list[ShownImage]


def find_pins(
    path: Path,
    lattice: Lattice | MarkerLayout,
    preprocess: Preprocess | None = None,
    rest: Path | None = None,
    without: Sequence[int] = (),
) -> Pins:
    """Find the pins of an image or a folder of recordings.

    Images are prepared as `preprocess` says, or else in their own size, up to LARGEST_PX. A
    `lattice` holds the rest positions; a layout is fitted, to untouched images at `rest` or else
    to the images themselves: motions are then from their mean position. Lost pins, those in
    `without` or else those that no image shows, have no place. Raises `UserError` if nothing can be
    read or pins are not this layout's.
    """
    _check_request(path, lattice, without)
    if preprocess is None:
        first = read_first_image(read_recordings(path, Preprocess()).files)
        preprocess = Preprocess(
            size=LARGEST_PX if first is None else min(LARGEST_PX, *first.shape[:2])
        )
    recordings = read_recordings(path, preprocess)
    view = recordings.find_common_view(dark=isinstance(lattice, MarkerLayout) and lattice.dark)
    detection = _detect_all(recordings, view)
    names = detection.names
    start = time.perf_counter()
    origin, untouched = "the untouched pins", detection.pins
    if isinstance(lattice, MarkerLayout):
        if rest is None:
            origin = "the pins' mean place in these images"
        else:
            untouched = _detect_all(read_recordings(rest, preprocess), view).pins
    lattice = _fit_rest(lattice, untouched, without, recordings.files[0])
    fitted = time.perf_counter()
    tracks = track_all(lattice, detection.pins)
    seconds = detection.seconds + time.perf_counter() - fitted
    motions = [np.where(track.identified, track.motion, np.nan) for track in tracks]
    place = lattice.rest + np.array(motions)
    table = PinScores(
        rows=[_score_track(name, track) for name, track in zip(names, tracks, strict=True)],
        pins=len(lattice.rest),
        image_px=preprocess.size,
        motion_from=origin,
        fit_s=fitted - start,
        ms_per_image=1e3 * seconds / len(names),
        left_out=[*_name_lost(lattice), *recordings.notes],
    )
    shown = [ShownImage(names[i], image, tracks[i]) for i, image in detection.images.items()]
    identified = np.array([track.identified for track in tracks])
    return Pins(np.array(names), identified, place, place - lattice.rest, lattice, table, shown)


def _check_request(path: object, lattice: Lattice | MarkerLayout, without: Sequence[int]) -> None:
    if not isinstance(path, str | Path):
        raise UserError(
            f"find_pins takes the path of an image or a folder, not {type(path).__name__}: "
            "for an image in memory use `detect_pin_centres` of jaxunshear.perception.pin_detection"
        )
    check_pin_numbers(without, len(lattice.ring))


def _fit_rest(
    lattice: Lattice | MarkerLayout,
    untouched: list[DetectedPins],
    without: Sequence[int],
    file: Path,
) -> Lattice:
    """Fit a layout to untouched pins; a lattice is used as it is, except for lost pins."""
    if isinstance(lattice, Lattice):
        return make_lattice(lattice.rest, lattice.ring, without) if without else lattice
    try:
        return fit_lattice([each.pins for each in untouched], lattice, without)
    except UserError as error:
        raise explain_failure(error, file) from error


class _Detection(NamedTuple):
    """The pins of all images that can be read."""

    pins: list[DetectedPins]
    names: list[str]
    images: dict[int, np.ndarray]  # some of them, by their index
    seconds: float  # that detection took


def _detect_all(recordings: Recordings, view: View) -> _Detection:
    pins: list[DetectedPins] = []
    names: list[str] = []
    shown_rows = set(select_evenly(len(recordings), SHOWN_IMAGES).tolist())
    images: dict[int, np.ndarray] = {}
    seconds, done = 0.0, 0
    with Progress(f"pins {recordings.path.name}", len(recordings)) as progress:
        for row, name, image in recordings.iterate_frames(view):
            start = time.perf_counter()
            pins.append(detect_pins(image))
            seconds += time.perf_counter() - start
            if row in shown_rows:
                images[len(names)] = image
            names.append(name)
            progress.advance(row + 1 - done)
            done = row + 1
        progress.advance(len(recordings) - done)
    return _Detection(pins, names, images, seconds)


def _name_lost(lattice: Lattice) -> list[str]:
    if not lattice.lost:
        return []
    numbers = ", ".join(map(str, lattice.lost[:MAX_NAMED]))
    more = f" and {len(lattice.lost) - MAX_NAMED} more" if len(lattice.lost) > MAX_NAMED else ""
    return [f"{len(lattice.lost)} pins are lost, and left out of all images: {numbers}{more}"]


def _score_track(name: str, track: PinTrack) -> PinScore:
    largest_motion = None
    if track.identified:
        largest_motion = round(float(np.nanmax(np.linalg.norm(track.motion, axis=-1))), 3)
    return PinScore(
        name=name,
        matched=int(track.visible.sum()) if track.identified else 0,
        sure=track.identified,
        doubt=round(track.max_offset, 4) if np.isfinite(track.max_offset) else None,
        missed=track.missed,
        extra=track.extra,
        largest_motion_px=largest_motion,
    )


def summary(table: PinScores) -> str:
    """Summarise the scores in a few lines for a person."""
    rows, pins = table.rows, table.pins
    identified = [row for row in rows if row.sure]
    percent = 100 * len(identified) / len(rows)
    full = sum(row.missed == 0 for row in identified)
    lines = [
        f"{len(rows)} images: {len(identified)} with every pin's identity sure "
        f"({percent:.1f} %), {full} of them with all {pins} pins",
        f"motions are from {table.motion_from}; {table.ms_per_image:.1f} ms an image",
    ]
    others = [row.name for row in rows if not row.sure]
    if others:
        more = f", and {len(others) - MAX_NAMED} more" if len(others) > MAX_NAMED else ""
        lines.append(f"not matched: {', '.join(others[:MAX_NAMED])}{more}")
    lines += [f"note: {note}" for note in table.left_out[:MAX_NOTES]]
    return "\n".join(lines)
