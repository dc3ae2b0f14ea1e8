"""Read recorded contacts: which are taps, which slides, and which split each is in.

contacts = read_contacts(settings)  # labels alone: no image is read
digest = compute_digest((taps_folder, slides_folder))  # distinguishes recordings

Splits are by pose: a tap and the slides to its pose are in the same one, in any order of files.
Imports no JAX.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.config.data import FROZEN_SPLITS, Recorded
from jaxunshear.config.sensor import Preprocess
from jaxunshear.config.splits import SPLITS, hash_text
from jaxunshear.data.frozen_splits import ContactLabels, check_frozen_split
from jaxunshear.data.labels import (
    compute_span,
    join_columns,
    normalise_name,
    normalise_text,
    read_pair_table,
)
from jaxunshear.data.recorded_splits import (
    TEST,
    TRAIN,
    VALIDATION,
    cut_block,
    read_folder_split,
    split_by_folders,
)
from jaxunshear.data.recordings import Recordings, read_recordings
from jaxunshear.data.videos import is_video
from jaxunshear.errors import UserError

MIN_MOVE = 1e-6  # mm or deg: labels of a move below this are of a tap
MAX_SPAN_RATIO = 40.0  # of taps' and slides' poses; a radian is 57 degrees
DIGITS = 16  # of a digest
PAIRS_PREFIX = "p"
KINDS = {False: "tap", True: "slide"}  # by `is_slide`


class RecordedContacts(NamedTuple):
    """N recorded contacts.

    Poses and moves (N, 6) are x y z mm, Rx Ry Rz deg in the labels' frame, NaN where unknown.
    """

    files: tuple[Path, ...]
    names: tuple[str, ...]  # paths below the folder that the settings name
    pose: np.ndarray
    move: np.ndarray
    pose_id: np.ndarray  # (N,) -1 where unknown
    is_slide: np.ndarray  # (N,) bool
    split: np.ndarray  # (N,) index into SPLITS
    others: Mapping[str, np.ndarray]  # further columns (N,) of the tables by name
    notes: tuple[str, ...]
    paired_by_table: bool = False  # `pose_id` then numbers the taps of the table

    def take(self, rows: np.ndarray) -> "RecordedContacts":
        """Return the contacts of some rows."""
        return self._replace(
            files=tuple(self.files[row] for row in rows),
            names=tuple(self.names[row] for row in rows),
            pose=self.pose[rows],
            move=self.move[rows],
            pose_id=self.pose_id[rows],
            is_slide=self.is_slide[rows],
            split=self.split[rows],
            others={name: values[rows] for name, values in self.others.items()},
        )


def read_contacts(settings: Recorded) -> RecordedContacts:
    """Read the taps and slides of the recordings, and split them.

    Raises UserError if there are none, labels do not distinguish taps from slides, or a split is
    empty.
    """
    contacts = split_contacts(read_test_contacts(settings), settings)
    for is_slide, kind in KINDS.items():
        split = contacts.split[contacts.is_slide == is_slide]
        for index, name in enumerate(SPLITS):
            if len(split) and not (split == index).any():
                raise UserError(
                    f"of {len(split)} {kind}s none is in the split '{name}': "
                    "record more, or raise its share"
                )
    return contacts


def read_test_contacts(settings: Recorded) -> RecordedContacts:
    """Read taps and slides, all in the test split: a finished run is scored on them."""
    taps, slides, parts = settings.tap_folder, settings.slide_folder, []
    if taps == slides:
        parts.append(_classify_one_folder(read_folder(taps, settings.preprocess)))
    elif taps:
        parts.append(_select_taps(read_folder(taps, settings.preprocess)))
    if slides and taps != slides:
        parts.append(_make_contacts(read_folder(slides, settings.preprocess), is_slide=True))
    contacts = _note_other_units(_join_contacts(parts))
    return _pair_by_table(contacts, Path(settings.pairs)) if settings.pairs else contacts


def _note_other_units(contacts: RecordedContacts) -> RecordedContacts:
    """Note that poses of taps and of slides seem to have different units."""
    notes = []
    for columns, name, unit in ((slice(3), "positions", "mm"), (slice(3, 6), "angles", "degrees")):
        poses = contacts.pose[:, columns]
        taps, slides = [compute_span(poses[contacts.is_slide == kind]) for kind in KINDS]
        if min(taps, slides) > MIN_MOVE and max(taps, slides) > MAX_SPAN_RATIO * min(taps, slides):
            varied = f"{name} of taps vary by {taps:.3g} and {name} of slides by {slides:.3g}"
            notes.append(f"{varied}: are the units of both {unit}?")
    return contacts._replace(notes=(*contacts.notes, *notes))


def read_folder(folder: str, preprocess: Preprocess) -> Recordings:
    """Read a folder of recordings. Raises UserError if it is no folder."""
    path = Path(folder)
    if not path.is_dir():
        raise UserError(f"{folder} is no folder of recordings: name one with images and labels")
    return read_recordings(path, preprocess)


def _find_moves(moves: np.ndarray) -> np.ndarray:
    """Find which labels (N, 6) of moves are of a slide; False where they are unknown."""
    return (np.abs(np.nan_to_num(moves)) > MIN_MOVE).any(axis=1) & np.isfinite(moves).all(axis=1)


def _classify_one_folder(recordings: Recordings) -> RecordedContacts:
    contacts = _make_contacts(recordings)
    is_labelled = np.isfinite(contacts.move).all(axis=1)
    if not is_labelled.any():
        raise UserError(
            f"{recordings.path} has no labels that say which contacts are taps: name the two "
            "folders, `jaxunshear fit --taps DIR --slides DIR`"
        )
    contacts = contacts._replace(is_slide=_find_moves(contacts.move))
    return _drop(contacts, ~is_labelled, "without a label of their move are left out")


def _select_taps(recordings: Recordings) -> RecordedContacts:
    """Select the contacts of a folder of taps that have no move in the labels."""
    contacts = _make_contacts(recordings)
    has_moved = _find_moves(contacts.move)
    if has_moved.all():
        raise UserError(f"{recordings.path} holds no taps: each contact has a move in its labels")
    why = f"of {recordings.path} have a move in their labels: no taps, left out"
    return _drop(contacts, has_moved, why)


def _drop(contacts: RecordedContacts, dropped: np.ndarray, why: str) -> RecordedContacts:
    if not dropped.any():
        return contacts
    note = f"{int(dropped.sum())} contacts {why}"
    return contacts._replace(notes=(*contacts.notes, note)).take(np.flatnonzero(~dropped))


def _make_contacts(recordings: Recordings, is_slide: bool = False) -> RecordedContacts:
    count = len(recordings)
    unknown = np.full((count, 6), np.nan)
    return RecordedContacts(
        files=recordings.files,
        names=recordings.names,
        pose=unknown if recordings.poses is None else recordings.poses,
        move=unknown if recordings.moves is None else recordings.moves,
        pose_id=np.full(count, -1) if recordings.pose_ids is None else recordings.pose_ids,
        is_slide=np.full(count, is_slide),
        split=np.full(count, SPLITS.index("test")),
        others=recordings.others,
        notes=tuple(recordings.notes),
    )


def split_contacts(contacts: RecordedContacts, settings: Recorded) -> RecordedContacts:
    """Split by a block of poses, or by folders' names and, where these leave it open, by the pose.

    Taps and slides are split alike. A frozen split is of its own rows, whatever folders are called.
    """
    if settings.split in FROZEN_SPLITS:
        return _split_as_frozen(contacts, settings)
    folder_split = np.array([*map(read_folder_split, contacts.files, contacts.names)])
    if settings.split == "block":
        return _split_by_block(contacts, folder_split, settings)
    split = np.zeros(len(folder_split), int)
    keys = _draw_split_keys(contacts, settings.seed)
    for is_slide in KINDS:
        rows = np.flatnonzero(contacts.is_slide == is_slide)
        if len(rows):
            split[rows] = split_by_folders(
                KINDS[is_slide], folder_split[rows], keys[rows], settings
            )
    return contacts._replace(split=split)


def _split_as_frozen(contacts: RecordedContacts, settings: Recorded) -> RecordedContacts:
    """Split by the poses as float32, as "random" does, and check the rows."""
    pose = contacts.pose.astype(np.float32).astype(np.float64)
    keys = _draw_split_keys(contacts._replace(pose=pose), settings.seed)
    kept_out = np.where(keys < settings.test, TEST, VALIDATION)
    split = np.where(keys < settings.test + settings.validation, kept_out, TRAIN)
    for is_slide in KINDS:
        rows = contacts.is_slide == is_slide
        if rows.any():
            check_frozen_split(settings.split, select_labels(contacts, is_slide), split[rows])
    return contacts._replace(split=split)


def select_labels(contacts: RecordedContacts, is_slide: bool) -> ContactLabels:
    """Select the labels of the taps, or of the slides, as a frozen split compares them."""
    chosen = contacts.take(np.flatnonzero(contacts.is_slide == is_slide))
    names = tuple(map(normalise_name, chosen.names))
    return ContactLabels(KINDS[is_slide], names, chosen.pose, chosen.move)


def _split_by_block(
    contacts: RecordedContacts, folder_split: np.ndarray, settings: Recorded
) -> RecordedContacts:
    """Keep a block of poses out, and drop contacts without a pose, since they may lie in it.

    Raises UserError if a folder is a split by its name.
    """
    held_out = np.flatnonzero((folder_split == "validation") | (folder_split == "test"))
    if len(held_out):
        raise UserError(
            f"paired.split block: the folder of {contacts.names[held_out[0]]} is a split by its "
            "name: use --paired.split folder, or name training folders alone, "
            "`jaxunshear fit --taps DIR --slides DIR`"
        )
    has_pose = np.isfinite(contacts.pose).all(axis=1)
    contacts = _drop(contacts, ~has_pose, "without a pose are left out by split block")
    split, note = cut_block(contacts.pose, settings.test, settings.validation, settings.seed)
    return contacts._replace(split=split, notes=(*contacts.notes, note))


def _draw_split_keys(contacts: RecordedContacts, seed: int) -> np.ndarray:
    """Draw (N,) numbers in [0, 1) that depend on the seed and the pose alone.

    Without a pose they depend on the file's name.
    """
    keys = np.empty(len(contacts.names))
    poses = np.round(contacts.pose, 4)
    for row, name in enumerate(contacts.names):
        number, pose = contacts.pose_id[row], poses[row]
        if contacts.paired_by_table and number >= 0:
            text = f"pair {number}"
        elif np.isfinite(pose).all():
            text = ",".join(f"{value:.4f}" for value in pose + 0.0)  # -0 becomes 0
        else:
            text = name
        keys[row] = hash_text(f"{seed} {text}") / 2**64
    return keys


def _join_contacts(parts: list[RecordedContacts]) -> RecordedContacts:
    """Join contacts, their pose numbers as ranks among all; equal notes become one.

    Other columns than poses and moves are kept if they vary.
    """
    numbers = np.unique(np.concatenate([part.pose_id for part in parts]))
    pose_ids = [
        np.where(part.pose_id < 0, -1, np.searchsorted(numbers, part.pose_id)) for part in parts
    ]
    others = join_columns([part.others for part in parts], [len(part.files) for part in parts])
    return RecordedContacts(
        files=tuple(file for part in parts for file in part.files),
        names=tuple(name for part in parts for name in part.names),
        pose=np.concatenate([part.pose for part in parts]),
        move=np.concatenate([part.move for part in parts]),
        pose_id=np.concatenate(pose_ids),
        is_slide=np.concatenate([part.is_slide for part in parts]),
        split=np.concatenate([part.split for part in parts]),
        others={
            name: values
            for name, values in others.items()
            if len(np.unique(values[np.isfinite(values)])) > 1
        },
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )


def _pair_by_table(contacts: RecordedContacts, table: Path) -> RecordedContacts:
    """Set `pose_id` by a table of pairs, and the pose of a slide that has none to its tap's.

    Raises UserError by file and row.
    """
    rows: dict[bool, dict[str, set[int]]] = {is_slide: {} for is_slide in KINDS}
    for row, name in enumerate(map(normalise_text, contacts.names)):
        for each in (name, name.rpartition("/")[2]):
            rows[bool(contacts.is_slide[row])].setdefault(each, set()).add(row)
    pose_id, pose = np.full(len(contacts.names), -1), contacts.pose.copy()
    for number, pair in read_pair_table(table).items():
        for is_slide, name in ((True, pair.slide), (False, pair.tap)):
            found = len(rows[is_slide].get(name, ()))
            if found != 1:
                many = f"there are {found} {KINDS[is_slide]}s {name}: name their folders, too,"
                text = many if found else f"there is no {KINDS[is_slide]} {name}"
                raise UserError(f"{table}, row {number}: {text} in these recordings")
        (slide,), (tap,) = rows[True][pair.slide], rows[False][pair.tap]
        pose_id[slide] = pose_id[tap] = tap
        if not np.isfinite(pose[slide]).all():
            pose[slide] = pose[tap]
    return contacts._replace(pose_id=pose_id, pose=pose, paired_by_table=True)


def compute_digest(folders: tuple[str, ...], pairs: str = "") -> str:
    """Compute the digest of each folder, and of a table of pairs if there is one, joined by `+`.

    Each has sixteen hexadecimal digits; those of the table follow a `p`. A folder's digest is of
    its labels by their bytes and its images by name and size, so it is the same beside other
    folders.
    """
    parts = []
    for folder in dict.fromkeys(folders):
        digest, recordings = hashlib.sha256(), read_folder(folder, Preprocess())
        for file, name in zip(recordings.files, recordings.names, strict=True):
            stored = file.parent if is_video(file.parent) else file
            size = stored.stat(follow_symlinks=stored.exists()).st_size
            digest.update(f"{name} {size}\n".encode())
        for table in sorted(Path(folder).rglob("*.[ctCT][sS][vV]")):
            digest.update(table.read_bytes())
        parts.append(digest.hexdigest()[:DIGITS])
    if pairs and Path(pairs).is_file():
        parts.append(PAIRS_PREFIX + hashlib.sha256(Path(pairs).read_bytes()).hexdigest()[:DIGITS])
    return "+".join(parts)


def parse_folder_digests(digest: str) -> set[str]:
    """Return the digests of the folders in a joined digest."""
    return {part for part in digest.split("+") if part and not part.startswith(PAIRS_PREFIX)}
