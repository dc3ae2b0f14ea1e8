"""Chunks of recorded frames -> examples of `tactip_recorded`, and the counts that go with a set.

contacts, frame, paths = prepare_recordings(settings, sensor, folder)
for key, example in examples(settings, contacts, paths, "train"): ...
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxunshear.config.data import Recorded
from jaxunshear.config.sensor import Sensor
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import encode_stored_png, iterate_usable_rows, load_chunk
from jaxunshear.data.preprocessing import SensorFrame, find_sensor_frame, prepare_chunks
from jaxunshear.data.recorded_contacts import RecordedContacts, read_contacts
from jaxunshear.errors import UserError
from jaxunshear.files import Json

MAX_NAMED = 20  # frames left out that metadata name, at most


def prepare_recordings(
    settings: Recorded, sensor: Sensor, folder: Path
) -> tuple[RecordedContacts, SensorFrame, list[Path]]:
    """Contacts, what their frames have in common, and chunk files in `folder`. Raises UserError."""
    contacts = read_contacts(settings)
    frame = find_sensor_frame(contacts, settings, sensor)
    return contacts, frame, prepare_chunks(contacts, settings, frame, folder)


def summarise_recordings(
    contacts: RecordedContacts, frame: SensorFrame, paths: list[Path]
) -> tuple[Json, Json]:
    """Counts, and what else a reader must know of the set, both plain JSON. Raises UserError where a split holds nothing readable."""
    chunks = [load_chunk(path) for path in paths]
    usable, sure, problem = (
        np.concatenate([chunk[name] for chunk in chunks]) for name in ("usable", "sure", "problem")
    )
    white = np.concatenate(
        [np.unpackbits(chunk["images"], axis=-1).mean(axis=-1) for chunk in chunks]
    )
    counts = count_contacts(contacts, usable, sure, problem)
    for split, count in counts["written"].items():
        if not count:
            raise UserError(
                f"no frame of split '{split}' can be read; the first: {_left_out(contacts, problem)[:1]}"
            )
    full = np.isfinite(np.concatenate([chunk["pins"] for chunk in chunks])).all(axis=(1, 2))
    more = {
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
            "sure": round(float(sure[usable].mean()), 6),
            "all_seen": round(float(full[usable].mean()), 6),
            "white": [round(float(q), 6) for q in np.quantile(white[usable], (0.01, 0.5, 0.99))],
        },
        "notes": list(contacts.notes),
    }
    return counts, more


def count_contacts(
    contacts: RecordedContacts, usable: np.ndarray, sure: np.ndarray, problem: np.ndarray
) -> Json:
    """Of contacts (N,): by split, taps and slides apart, and which could not be read (`problem`)."""
    kinds = {
        "written": np.ones(len(usable), bool),
        "taps": ~contacts.is_slide,
        "slides": contacts.is_slide,
    }
    return {
        "contacts": len(usable),
        "dropped": int((~usable).sum()),
        "unsure": int((usable & ~sure).sum()),
        **{
            kind: {
                name: int((usable & here & (contacts.split == i)).sum())
                for i, name in enumerate(SPLITS)
            }
            for kind, here in kinds.items()
        },
        "dropped_frames": _left_out(contacts, problem)[:MAX_NAMED],
    }


def _left_out(contacts: RecordedContacts, problem: np.ndarray) -> list[str]:
    return [f"{contacts.names[row]}: {problem[row]}" for row in np.flatnonzero(problem != "")]


def iterate_examples(
    settings: Recorded, contacts: RecordedContacts, paths: list[Path], split: str
) -> Iterator[tuple[str, dict]]:
    """(key, example) of every readable frame of a split."""
    inside = contacts.split == SPLITS.index(split)
    for chunk, place, row in iterate_usable_rows(paths, inside):
        yield (
            f"{row:08d}",
            {
                "image": encode_stored_png(chunk, place, settings.preprocess.size),
                "pins": chunk["pins"][place].astype(np.float32),
                "sure": int(chunk["sure"][place]),
                "slid": int(contacts.is_slide[row]),
                "pose": contacts.pose[row].astype(np.float32),
                "move": contacts.move[row].astype(np.float32),
                "pose_id": int(contacts.pose_id[row]),
                "number": row,
            },
        )
