"""Turn chunks of recorded frames into examples of `tactip_recorded`, and count them.

for key, example in iterate_examples(settings, contacts, paths, "train"): ...
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxunshear.config.data import Recorded
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import iterate_usable_rows, load_chunk
from jaxunshear.data.preprocessing import SensorFrame
from jaxunshear.data.recorded_contacts import RecordedContacts
from jaxunshear.errors import UserError
from jaxunshear.files import Json

MAX_NAMED = 20  # dropped frames that metadata name, at most


def summarise_recordings(
    contacts: RecordedContacts, frame: SensorFrame, paths: list[Path]
) -> tuple[Json, Json]:
    """Return counts, and what else a reader must know of the set, both plain JSON.

    Raises UserError if no frame of a split can be read.
    """
    chunks = [load_chunk(path) for path in paths]
    usable = np.concatenate([chunk["usable"] for chunk in chunks])
    identified = np.concatenate([chunk["sure"] for chunk in chunks])
    problem = np.concatenate([chunk["problem"] for chunk in chunks])
    white_shares = [np.unpackbits(chunk["images"], axis=-1).mean(axis=-1) for chunk in chunks]
    white = np.concatenate(white_shares)
    counts = count_contacts(contacts, usable, identified, problem)
    for split, count in counts["written"].items():
        if not count:
            first = _list_drops(contacts, problem)[:1]
            raise UserError(f"no frame of split '{split}' can be read; the first: {first}")
    is_full = np.isfinite(np.concatenate([chunk["pins"] for chunk in chunks])).all(axis=(1, 2))
    description = {
        "frame": {
            "box": frame.view.box,
            "whites": frame.view.whites,
            "place_px": np.round(frame.rest, 4).tolist(),
            "shell": frame.ring.tolist(),
            "spacing_px": round(frame.spacing_px, 4),
            "radius_px": round(frame.radius_px, 4),
            "size": frame.size,
            "pins_px": frame.pins_px,
        },
        "pins": {
            "sure": round(float(identified[usable].mean()), 6),
            "all_seen": round(float(is_full[usable].mean()), 6),
            "white": [round(float(q), 6) for q in np.quantile(white[usable], (0.01, 0.5, 0.99))],
        },
        "notes": list(contacts.notes),
    }
    return counts, description


def count_contacts(
    contacts: RecordedContacts, usable: np.ndarray, identified: np.ndarray, problem: np.ndarray
) -> Json:
    """Count contacts (N,) by split, all of them and by kind, and list those with a `problem`."""
    return {
        "contacts": len(usable),
        "dropped": int((~usable).sum()),
        "unsure": int((usable & ~identified).sum()),
        "written": _count_by_split(contacts, usable),
        "taps": _count_by_split(contacts, usable & ~contacts.is_slide),
        "slides": _count_by_split(contacts, usable & contacts.is_slide),
        "dropped_frames": _list_drops(contacts, problem)[:MAX_NAMED],
    }


def _count_by_split(contacts: RecordedContacts, selected: np.ndarray) -> dict[str, int]:
    return {
        name: int((selected & (contacts.split == index)).sum()) for index, name in enumerate(SPLITS)
    }


def _list_drops(contacts: RecordedContacts, problem: np.ndarray) -> list[str]:
    return [f"{contacts.names[row]}: {problem[row]}" for row in np.flatnonzero(problem != "")]


def iterate_examples(
    settings: Recorded, contacts: RecordedContacts, paths: list[Path], split: str
) -> Iterator[tuple[str, dict]]:
    """Iterate over (key, example) of every readable frame of a split."""
    in_split = contacts.split == SPLITS.index(split)
    for contact in iterate_usable_rows(paths, in_split):
        row = contact.row
        example = {
            "image": contact.encode_png(settings.preprocess.size),
            "pins": contact.get("pins").astype(np.float32),
            "sure": int(contact.get("sure")),
            "slid": int(contacts.is_slide[row]),
            "pose": contacts.pose[row].astype(np.float32),
            "move": contacts.move[row].astype(np.float32),
            "pose_id": int(contacts.pose_id[row]),
            "number": row,
        }
        yield f"{row:08d}", example
