"""Recorded contacts: which are taps and which slides, in which split, and where their pins stand. Imports no JAX until images are read.

contacts = read_contacts(settings)                                     # labels alone: no image is read
sensor = identify_sensor(contacts, settings.preprocess)               # by the number of pins
paths, frame = prepare(settings, sensor, contacts, folder)      # chunks of images and pins; goes on where a killed run stopped

Splits are by pose: a tap and the slides to its pose are in the same one, in any order of files.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxunshear.config.data import Recorded
from jaxunshear.config.image import Preprocess
from jaxunshear.config.sensor import SENSORS, Sensor
from jaxunshear.config.splits import SPLITS, hash_text
from jaxunshear.data.labels import read_pair_table
from jaxunshear.data.pose_block import cut_block
from jaxunshear.data.recordings import Recordings, read_image, read_recordings
from jaxunshear.errors import UserError
from jaxunshear.selection import select_evenly

if TYPE_CHECKING:
    from jaxunshear.perception.preprocess import View

MIN_MOVE = 1e-6  # mm or deg: labels of a move below this are of a tap
SPLIT_NAMES = {
    "train": "train",
    "val": "validation",
    "valid": "validation",
    "validation": "validation",
    "test": "test",
}
LARGEST_PX = 256  # pins are found at the frames' own size, at most this
PROBES = 20  # training frames that crop, sensor and lattice are found from
COUNTED_FRAMES = 5  # of them, whose pins are counted
MAX_PIN_COUNT_ERROR = 0.15  # of a sensor's pins, by which a count may miss


class RecordedContacts(NamedTuple):
    """N recorded contacts. Poses and moves (N, 6) are x y z mm, Rx Ry Rz deg in the labels' own frame, NaN where unknown."""

    files: tuple[Path, ...]
    names: tuple[str, ...]  # places below the folder that was named
    pose: np.ndarray
    move: np.ndarray
    pose_id: np.ndarray  # (N,) -1 where unknown
    is_slide: np.ndarray  # (N,) bool
    split: np.ndarray  # (N,) index into SPLITS
    notes: tuple[str, ...]
    paired_by_table: bool = False  # by a table: `pose_id` then numbers its taps

    def take(self, rows: np.ndarray) -> "RecordedContacts":
        arrays = {
            name: getattr(self, name)[rows] for name in ("pose", "move", "pose_id", "is_slide", "split")
        }
        files, names = tuple(self.files[i] for i in rows), tuple(self.names[i] for i in rows)
        return self._replace(files=files, names=names, **arrays)


def read_contacts(settings: Recorded) -> RecordedContacts:
    """Taps and slides of the recordings, split. Raises UserError where there is nothing, or labels do not part taps from slides."""
    contacts = _split(read_test_contacts(settings), settings)
    for slid, kind in ((False, "taps"), (True, "slides")):
        mine = contacts.split[contacts.is_slide == slid]
        lacking = [
            name for index, name in enumerate(SPLITS) if len(mine) and not (mine == index).any()
        ]
        if lacking:
            raise UserError(
                f"of {len(mine)} {kind} none is in the split '{lacking[0]}': record more, or raise its share"
            )
    return contacts


def read_test_contacts(settings: Recorded) -> RecordedContacts:
    """The same in one split, the test's: recordings that a finished run is scored on."""
    if settings.tap_folder == settings.slide_folder:
        parts = [_split_one_folder(read_folder(settings.tap_folder, settings.preprocess))]
    else:
        folders = ((settings.tap_folder, False), (settings.slide_folder, True))
        parts = [
            _select_kind(read_folder(folder, settings.preprocess), slid)
            for folder, slid in folders
            if folder
        ]
    contacts = _join_contacts(parts)
    return _pair_by_table(contacts, Path(settings.pairs)) if settings.pairs else contacts


def identify_sensor(contacts: RecordedContacts, preprocess: Preprocess) -> Sensor:
    """The sensor with as many pins as some training frames show. Raises UserError where there is none."""
    from jaxunshear.perception.pin_detection import find_pins

    counts = [
        len(find_pins(image)) for image in _probe_images(contacts, preprocess)[:COUNTED_FRAMES]
    ]
    pins = float(np.median(counts))
    nearest = min(SENSORS.values(), key=lambda sensor: abs(sensor.pins - pins))
    if abs(nearest.pins - pins) > MAX_PIN_COUNT_ERROR * nearest.pins:
        known = ", ".join(dict.fromkeys(str(sensor.pins) for sensor in SENSORS.values()))
        raise UserError(
            f"{contacts.files[0].parent}: about {pins:.0f} pins are found in an image; known are sensors of {known} pins"
        )
    return nearest


def select_probes(contacts: RecordedContacts) -> np.ndarray:
    """Rows of up to PROBES training contacts, evenly spaced: what a camera's frames have in common is found from these alone."""
    rows = np.flatnonzero(contacts.split == SPLITS.index("train"))
    return rows[select_evenly(len(rows), PROBES)]


def find_common_view(contacts: RecordedContacts, preprocess: Preprocess) -> "View":
    """The crop and whites of the training frames; no crop where these differ in size."""
    from jaxunshear.perception import preprocess as frames

    views, sizes = [], set()
    for row in select_probes(contacts):
        try:
            raw = read_image(contacts.files[row])
            views.append(frames.find_view(preprocess, raw))
            sizes.add(raw.shape[:2])
        except UserError:
            continue  # `prepare` says which
    common = frames.combine_views(views)
    return common if len(sizes) == 1 else frames.View(None, common.whites)


def _probe_images(contacts: RecordedContacts, preprocess: Preprocess) -> list[np.ndarray]:
    from jaxunshear.perception.preprocess import prepare_frame

    view, images, problem = find_common_view(contacts, preprocess), [], ""
    for row in select_probes(contacts):
        try:
            raw = read_image(contacts.files[row])
            own = replace(preprocess, size=min(LARGEST_PX, *raw.shape[:2]))
            images.append(prepare_frame(own, raw, view))
        except UserError as error:
            problem = f"{contacts.names[row]}: {error}"
    if not images:
        raise UserError(
            f"none of {len(select_probes(contacts))} images of {contacts.files[0].parent} can be read; the last: {problem}"
        )
    return images


def read_folder(folder: str, preprocess: Preprocess) -> Recordings:
    path = Path(folder)
    if not path.is_dir():
        raise UserError(f"{folder} is no folder of recordings: name one with images and labels")
    return read_recordings(path, preprocess)


def _classify_moves(move: np.ndarray) -> np.ndarray:
    """(N,) 1 slid, 0 tapped, -1 unknown."""
    known = np.isfinite(move).all(axis=1)
    return np.where(known, (np.abs(np.nan_to_num(move)) > MIN_MOVE).any(axis=1).astype(int), -1)


def _split_one_folder(recordings: Recordings) -> RecordedContacts:
    """Taps and slides that lie in one folder: by their labels."""
    contacts = _contacts(recordings, np.zeros(len(recordings), bool))
    moved = _classify_moves(contacts.move)
    if (moved < 0).all():
        raise UserError(
            f"{recordings.path} has no labels that say which contacts are taps: name the two folders, "
            "`jaxunshear fit --taps DIR --slides DIR`"
        )
    notes = contacts.notes
    if (moved < 0).any():
        notes = (
            *notes,
            f"{int((moved < 0).sum())} contacts without a label of their move are left out",
        )
    return contacts._replace(is_slide=moved == 1, notes=notes).take(np.flatnonzero(moved >= 0))


def _select_kind(recordings: Recordings, slid: bool) -> RecordedContacts:
    contacts = _contacts(recordings, np.full(len(recordings), slid))
    wrong = np.zeros(len(contacts.is_slide), bool) if slid else _classify_moves(contacts.move) == 1
    if wrong.all():
        raise UserError(
            f"{recordings.path} holds no taps: each of its contacts has a move in its labels"
        )
    if wrong.any():
        note = f"{recordings.path}: {int(wrong.sum())} contacts have a move in their labels: no taps, left out"
        contacts = contacts._replace(notes=(*contacts.notes, note)).take(np.flatnonzero(~wrong))
    return contacts


def _contacts(recordings: Recordings, slid: np.ndarray) -> RecordedContacts:
    unknown = np.full((len(recordings), 6), np.nan)
    return RecordedContacts(
        recordings.files,
        recordings.names,
        unknown if recordings.poses is None else recordings.poses,
        unknown if recordings.moves is None else recordings.moves,
        np.full(len(recordings), -1) if recordings.pose_ids is None else recordings.pose_ids,
        slid,
        np.full(len(recordings), SPLITS.index("test")),
        tuple(recordings.notes),
    )


def _split(contacts: RecordedContacts, settings: Recorded) -> RecordedContacts:
    """Split by a block of poses, or by folders' names and, where these leave it open, by the pose.

    Taps and slides are split alike. Names count only where some contacts are left to learn from: a
    folder that happens to be called `test` is no split.
    """
    named = np.array(
        [
            _named_split(file, name)
            for file, name in zip(contacts.files, contacts.names, strict=True)
        ]
    )
    if settings.split == "block":
        return _split_by_block(contacts, named, settings)
    split = np.zeros(len(named), int)
    drawn = _draw_split_keys(contacts, settings.seed)
    for slid, kind in ((False, "taps"), (True, "slides")):
        here = contacts.is_slide == slid
        opened = here & ((named == "") | (named == "train"))
        if not opened.any():
            named, opened = np.where(here, "", named), here
        for index, name in enumerate(SPLITS):
            split[here & (named == name)] = index
        start = 0.0
        for name, share in (("test", settings.test), ("validation", settings.validation)):
            if name in named[here]:
                continue
            if settings.split == "folder" and here.any():
                raise UserError(
                    f"paired.split folder: no folder of {kind} has the name of the split '{name}', "
                    f"such as csv_{name}: move contacts into one, or use --paired.split random"
                )
            chosen = opened & (drawn >= start) & (drawn < start + share)
            left = opened & (split == 0)
            if not chosen.any() and left.sum() > len(
                SPLITS
            ):  # of few contacts chance may take none
                chosen = left & (drawn == drawn[left].min())
            split[chosen] = SPLITS.index(name)
            start += share
    return contacts._replace(split=split)


def _split_by_block(
    contacts: RecordedContacts, named: np.ndarray, settings: Recorded
) -> RecordedContacts:
    """Keep a block of poses out, and drop contacts without a pose, since they may lie in it.

    Raises UserError if a folder is a split by its name.
    """
    kept_out = np.flatnonzero((named == "validation") | (named == "test"))
    if len(kept_out):
        raise UserError(
            f"paired.split block: the folder of {contacts.names[kept_out[0]]} is a split by its name: use "
            "--paired.split folder, or name training folders alone, `jaxunshear fit --taps DIR --slides DIR`"
        )
    known = np.isfinite(contacts.pose).all(axis=1)
    if not known.all():
        note = f"split block: {int((~known).sum())} contacts without a pose are left out"
        contacts = contacts._replace(notes=(*contacts.notes, note)).take(np.flatnonzero(known))
    split, note = cut_block(contacts.pose, settings.test, settings.validation, settings.seed)
    return contacts._replace(split=split, notes=(*contacts.notes, note))


def _named_split(file: Path, name: str) -> str:
    """Of the folders below the one that was named, and of that one: `csv_train`, `val`, `test_2`."""
    folders = file.parent.resolve().parts[-1 - name.count("/") :]
    words = [word for folder in reversed(folders) for word in re.split(r"[^a-z]+", folder.lower())]
    return next((SPLIT_NAMES[word] for word in words if word in SPLIT_NAMES), "")


def _draw_split_keys(contacts: RecordedContacts, seed: int) -> np.ndarray:
    """(N,) numbers in [0, 1) that depend on the seed and the pose alone; on the file's name where there is no pose."""
    keys = [
        f"pair {number}"
        if contacts.paired_by_table and number >= 0
        else ",".join(f"{value:.4f}" for value in pose + 0.0)
        if np.isfinite(pose).all()
        else name
        for pose, name, number in zip(
            np.round(contacts.pose, 4), contacts.names, contacts.pose_id, strict=True
        )
    ]
    return np.array([hash_text(f"{seed} {key}") / 2**64 for key in keys])


def _join_contacts(parts: list[RecordedContacts]) -> RecordedContacts:
    known = np.unique(np.concatenate([part.pose_id for part in parts]))
    parts = [
        part._replace(pose_id=np.where(part.pose_id < 0, -1, np.searchsorted(known, part.pose_id)))
        for part in parts
    ]
    return RecordedContacts(
        tuple(file for part in parts for file in part.files),
        tuple(name for part in parts for name in part.names),
        np.concatenate([part.pose for part in parts]),
        np.concatenate([part.move for part in parts]),
        np.concatenate([part.pose_id for part in parts]),
        np.concatenate([part.is_slide for part in parts]),
        np.concatenate([part.split for part in parts]),
        tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )


def _pair_by_table(contacts: RecordedContacts, table: Path) -> RecordedContacts:
    """With `pose_id` by a table of pairs, and the tap's pose for a slide that has none. Raises UserError by file and row."""
    rows: dict[bool, dict[str, int]] = {False: {}, True: {}}
    for row, name in enumerate(contacts.names):
        mine = rows[bool(contacts.is_slide[row])]
        mine[name] = mine[name.rpartition("/")[2]] = row
    pose_id, pose = np.full(len(contacts.names), -1), contacts.pose.copy()
    for number, (slide, tap) in enumerate(read_pair_table(table), 2):
        for slid, name in ((True, slide), (False, tap)):
            if name not in rows[slid]:
                kind = "slide" if slid else "tap"
                raise UserError(
                    f"{table}, row {number}: there is no {kind} {name} in these recordings"
                )
        here, there = rows[True][slide], rows[False][tap]
        pose_id[here] = pose_id[there] = there
        if not np.isfinite(pose[here]).all():
            pose[here] = pose[there]
    if not (pose_id >= 0).any():
        raise UserError(f"{table} pairs nothing")
    return contacts._replace(pose_id=pose_id, pose=pose, paired_by_table=True)
