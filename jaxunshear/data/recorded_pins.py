"""`jaxunshear pins`: where each pin of recorded images stands, and how far it has moved.

>>> found = find_pins(Path("recordings"), layout_of(TACTIP_331))
>>> found.motion_px[found.sure]                           # (images, pins, 2)
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxunshear.config.image import Preprocess
from jaxunshear.data.recordings import Recordings, read_image, read_recordings
from jaxunshear.errors import UserError
from jaxunshear.perception.lattice import Lattice
from jaxunshear.perception.lattice_fitting import MarkerLayout, fit_lattice
from jaxunshear.perception.pin_detection import DetectedPins, detect_pins
from jaxunshear.perception.pin_track import PinTrack
from jaxunshear.perception.pin_tracking import track_all
from jaxunshear.perception.preprocess import View
from jaxunshear.progress import Progress
from jaxunshear.results.applications import PinScore, PinScores
from jaxunshear.selection import select_evenly

LARGEST_PX = 256  # larger frames are made this size; smaller ones gain nothing from being enlarged
DRAWN = 12

Shown = list[tuple[str, np.ndarray, PinTrack]]


@dataclass(frozen=True)
class Pins:
    """P pins of N images by identity; NaN for those that were not found, and where an image's identities are not sure."""

    name: np.ndarray  # (N,) of the images
    sure: np.ndarray  # (N,) bool
    place_px: np.ndarray  # (N, P, 2)
    motion_px: np.ndarray  # (N, P, 2) from where the pins stand untouched
    lattice: Lattice  # where that is
    table: PinScores  # how well it went, image by image
    shown: Shown  # some images, to be drawn


def prepared_size(path: Path) -> int:
    """Pixels of the images that recordings at `path` are best made to: their own, up to LARGEST_PX."""
    recordings = read_recordings(path, Preprocess())
    for file in recordings.files:
        try:
            return min(LARGEST_PX, *read_image(file).shape[:2])
        except UserError:
            continue
    return LARGEST_PX  # none can be read, which `frames` will report


def find_pins(
    path: Path,
    lattice: Lattice | MarkerLayout,
    preprocess: Preprocess | None = None,
    rest: Path | None = None,
) -> Pins:
    """Of an image or a folder of recordings, prepared as `preprocess` says, or else in their own size.

    A `lattice` is where the untouched pins stand; a layout is fitted, to untouched images at `rest` or else to the images themselves:
    motions are then from their mean place. Raises `UserError` where nothing can be read or pins are not this layout's.
    """
    preprocess = preprocess or Preprocess(size=prepared_size(path))
    recordings = read_recordings(path, preprocess)
    view = recordings.find_common_view()
    found, names, drawn, spent = _found(recordings, view)
    began = time.perf_counter()
    origin = "the untouched pins"
    if isinstance(lattice, MarkerLayout):
        origin = origin if rest is not None else "the pins' mean place in these images"
        some = found if rest is None else _found(read_recordings(rest, preprocess), view)[0]
        lattice = fit_lattice([each.pins for each in some], lattice)
    fitted = time.perf_counter()
    tracks = track_all(lattice, found)
    spent += time.perf_counter() - fitted
    place = lattice.rest + np.array([np.where(t.identified, t.motion, np.nan) for t in tracks])
    table = PinScores(
        rows=[_row(name, track) for name, track in zip(names, tracks, strict=True)],
        pins=len(lattice.rest),
        image_px=preprocess.size,
        motion_from=origin,
        fit_s=fitted - began,
        ms_per_image=1e3 * spent / len(names),
        left_out=list(recordings.notes),
    )
    shown = [(names[i], image, tracks[i]) for i, image in drawn.items()]
    sure = np.array([track.identified for track in tracks])
    return Pins(np.array(names), sure, place, place - lattice.rest, lattice, table, shown)


def _found(
    recordings: Recordings, view: View
) -> tuple[list[DetectedPins], list[str], dict[int, np.ndarray], float]:
    """Pins and names of all images that can be read, some of the images, and the seconds that finding took."""
    found: list[DetectedPins] = []
    names: list[str] = []
    wanted = set(select_evenly(len(recordings), DRAWN).tolist())
    drawn: dict[int, np.ndarray] = {}
    spent, seen = 0.0, 0
    with Progress(f"pins {recordings.path.name}", len(recordings)) as progress:
        for row, name, image in recordings.iterate_frames(view):
            began = time.perf_counter()
            found.append(detect_pins(image))
            spent += time.perf_counter() - began
            if row in wanted:
                drawn[len(names)] = image
            names.append(name)
            progress.advance(row + 1 - seen)
            seen = row + 1
        progress.advance(len(recordings) - seen)
    return found, names, drawn, spent


def _row(name: str, track: PinTrack) -> PinScore:
    return PinScore(
        name=name,
        matched=int(track.visible.sum()) if track.identified else 0,
        sure=track.identified,
        doubt=round(track.max_offset, 4) if np.isfinite(track.max_offset) else None,
        missed=track.missed,
        extra=track.extra,
        largest_motion_px=round(float(np.nanmax(np.linalg.norm(track.motion, axis=-1))), 3)
        if track.identified
        else None,
    )


def summary(table: PinScores) -> str:
    """What a person wants to know at once."""
    rows, pins = table.rows, table.pins
    sure = [row for row in rows if row.sure]
    lines = [
        f"{len(rows)} images: {len(sure)} with every pin's identity sure ({100 * len(sure) / len(rows):.1f} %), "
        f"{sum(row.matched == pins for row in sure)} of them with all {pins} pins",
        f"motions are from {table.motion_from}; {table.ms_per_image:.1f} ms an image",
    ]
    unsure = [row.name for row in rows if not row.sure]
    if unsure:
        lines.append(
            f"not matched: {', '.join(unsure[:8])}{f', and {len(unsure) - 8} more' if len(unsure) > 8 else ''}"
        )
    lines += [f"note: {note}" for note in table.left_out[:5]]
    return "\n".join(lines)
