"""`jaxunshear pins`: where each pin of recorded images stands, and how far it has moved.

Images in; `pins.npz` (places and motions by identity) and `pins.csv` (a line an image) out.
"""

import io
import time
from pathlib import Path

import numpy as np

from jaxunshear.dataset.recordings import Recordings, read_image, read_recordings
from jaxunshear.errors import UserError
from jaxunshear.image.fitting import Layout, fit_lattice
from jaxunshear.image.lattice import Lattice
from jaxunshear.image.pins import Found, detect
from jaxunshear.image.preprocess import View
from jaxunshear.image.track import Track
from jaxunshear.image.tracking import follow_all
from jaxunshear.progress import Progress
from jaxunshear.settings.image import Preprocess
from jaxunshear.storage import Json, csv_text, write_bytes, write_text

LARGEST_PX = 256  # larger frames are made this size; smaller ones gain nothing from being enlarged
DRAWN = 12

Shown = list[tuple[str, np.ndarray, Track]]


def prepared_size(path: Path) -> int:
    """Pixels of the images that recordings at `path` are best made to: their own, up to LARGEST_PX."""
    recordings = read_recordings(path, Preprocess())
    for file in recordings.files:
        try:
            return min(LARGEST_PX, *read_image(file).shape[:2])
        except UserError:
            continue
    return LARGEST_PX  # none can be read, which `frames` will report


def pins_of_recordings(
    path: Path, lattice: Lattice | Layout, preprocess: Preprocess, out: Path, rest: Path | None = None
) -> tuple[Json, Lattice, Shown]:
    """What was measured, the untouched pins, and some images to draw; writes `pins.npz` and `pins.csv` to `out`.

    Rows by image: `name`, `matched` pins (0 where identities are not sure), `sure`, `doubt`, `missed`, `extra`.

    A `lattice` is where the untouched pins stand; a layout is fitted, to untouched images at `rest` or else to the images themselves:
    motions are then from their mean place. Raises `UserError` where nothing can be read or pins are not this layout's.
    """
    recordings = read_recordings(path, preprocess)
    view = recordings.common_view()
    found, names, drawn, spent = _found(recordings, view)
    began = time.perf_counter()
    origin = "the untouched pins"
    if isinstance(lattice, Layout):
        origin = origin if rest is not None else "the pins' mean place in these images"
        some = found if rest is None else _found(read_recordings(rest, preprocess), view)[0]
        lattice = fit_lattice([each.pins for each in some], lattice)
    fitted = time.perf_counter()
    tracks = follow_all(lattice, found)
    spent += time.perf_counter() - fitted
    rows = [_row(name, track) for name, track in zip(names, tracks, strict=True)]
    place = lattice.place + np.array([np.where(t.sure, t.motion, np.nan) for t in tracks])
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        name=np.array(names),
        sure=np.array([track.sure for track in tracks]),
        place_px=place.astype(np.float32),
        motion_px=(place - lattice.place).astype(np.float32),
        undeformed_px=lattice.place.astype(np.float32),
    )
    write_bytes(out / "pins.npz", buffer.getvalue())
    write_text(out / "pins.csv", csv_text(rows))
    measured = {
        "rows": rows,
        "pins": len(lattice.place),
        "image_px": preprocess.size,
        "motion_from": origin,
        "fit_s": fitted - began,
        "ms_per_image": 1e3 * spent / len(names),
        "left_out": list(recordings.notes),
    }
    return measured, lattice, [(names[i], image, tracks[i]) for i, image in drawn.items()]


def _found(recordings: Recordings, view: View) -> tuple[list[Found], list[str], dict[int, np.ndarray], float]:
    """Pins and names of all images that can be read, some of the images, and the seconds that finding took."""
    found: list[Found] = []
    names: list[str] = []
    wanted = set(np.linspace(0, len(recordings) - 1, min(DRAWN, len(recordings))).round().astype(int).tolist())
    drawn: dict[int, np.ndarray] = {}
    spent, seen = 0.0, 0
    with Progress(f"pins {recordings.path.name}", len(recordings)) as progress:
        for row, name, image in recordings.frames(view):
            began = time.perf_counter()
            found.append(detect(image))
            spent += time.perf_counter() - began
            if row in wanted:
                drawn[len(names)] = image
            names.append(name)
            progress.advance(row + 1 - seen)
            seen = row + 1
        progress.advance(len(recordings) - seen)
    return found, names, drawn, spent


def _row(name: str, track: Track) -> Json:
    finite = np.isfinite(track.doubt)
    return {
        "name": name,
        "matched": int(track.seen.sum()) if track.sure else 0,
        "sure": track.sure,
        "doubt": round(track.doubt, 4) if finite else None,
        "missed": track.missed,
        "extra": track.extra,
        "largest_motion_px": round(float(np.nanmax(np.linalg.norm(track.motion, axis=-1))), 3) if track.sure else None,
    }


def summary(measured: Json) -> str:
    """What a person wants to know at once."""
    rows, pins = measured["rows"], measured["pins"]
    sure = [row for row in rows if row["sure"]]
    lines = [
        f"{len(rows)} images: {len(sure)} with every pin's identity sure ({100 * len(sure) / len(rows):.1f} %), "
        f"{sum(row['matched'] == pins for row in sure)} of them with all {pins} pins",
        f"motions are from {measured['motion_from']}; {measured['ms_per_image']:.1f} ms an image",
    ]
    unsure = [row["name"] for row in rows if not row["sure"]]
    if unsure:
        lines.append(
            f"not matched: {', '.join(unsure[:8])}{f', and {len(unsure) - 8} more' if len(unsure) > 8 else ''}"
        )
    lines += [f"note: {note}" for note in measured["left_out"][:5]]
    return "\n".join(lines)
