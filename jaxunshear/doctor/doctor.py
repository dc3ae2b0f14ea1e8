"""`jaxunshear doctor`: what a folder of recordings is, what is broken in it, and which commands can use it.

diagnosis = examine(Path("recordings/edge_2d"))
print("\\n".join(text_of(diagnosis)))  # of jaxunshear.report.doctor_text
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from jaxunshear.dataset.labels import MOVE_COLUMNS, POSE_COLUMNS, Problem, columns_of, read_table, table_of
from jaxunshear.dataset.recordings import IMAGE_FOLDERS, Recordings, read_image, read_recordings
from jaxunshear.doctor.halves import Column, Pairing, column, pairing, taps_and_slides
from jaxunshear.doctor.part import Part
from jaxunshear.doctor.sampled import Seen, seen
from jaxunshear.doctor.uses import Use, lacks_of, learnt_from, uses_of
from jaxunshear.errors import UserError
from jaxunshear.evenly import evenly
from jaxunshear.image.grey import check_frame
from jaxunshear.progress import Progress
from jaxunshear.settings.image import Preprocess
from jaxunshear.storage import Json

SAMPLED = 40  # images whose pins are found, shared by the folders
LEAST_SAMPLED = 8  # in each of many folders
UNITS = ("mm",) * 3 + ("deg",) * 3
MOST_LISTED = 20  # images that cannot be read, by name


@dataclass(frozen=True)
class Diagnosis:
    path: Path
    parts: tuple[Part, ...]
    pairing: Pairing  # of the folders that training would take, or of all contacts
    problems: tuple[Problem, ...]  # what is broken, and where
    lacks: tuple[str, ...]  # what is not there, a line each
    uses: tuple[Use, ...]

    @property
    def images(self) -> int:
        return sum(part.images for part in self.parts)

    @property
    def usable(self) -> bool:
        return any(use.works for use in self.uses)


def examine(path: str | Path) -> Diagnosis:
    """Reads everything at `path`, and finds pins in about SAMPLED of the images.

    Raises UserError, in one line, where there is nothing that can be read.
    """
    path = Path(path)
    recordings = read_recordings(path, Preprocess())
    problems = [note if isinstance(note, Problem) else Problem.of(path, note) for note in recordings.notes]
    rows: dict[Path, list[int]] = {}
    for row, file in enumerate(recordings.files):
        rows.setdefault(file.parent, []).append(row)
    share = max(LEAST_SAMPLED, SAMPLED // len(rows))
    parts = []
    with Progress(f"doctor {path.name}", len(recordings)) as progress:
        for folder, own in rows.items():
            sizes, broken = _sizes(recordings, own, progress)
            problems += broken
            parts.append(_part(recordings, folder, np.array(own), sizes, share, problems))
    if not any(part.images for part in parts):
        raise UserError(f"none of {len(recordings)} images in {path} can be used; the last: {problems[-1]}")
    found = tuple(parts)
    pairs = _pairs(recordings, list(rows.values()), found)
    return Diagnosis(path, found, pairs, tuple(problems), lacks_of(found, pairs), uses_of(path, found))


def rows_of(diagnosis: Diagnosis) -> Json:
    """The same for JSON: a row a folder, without the images."""
    return {
        "path": str(diagnosis.path),
        "usable": diagnosis.usable,
        "rows": [_row(part) for part in diagnosis.parts],
        "pairing": asdict(diagnosis.pairing),
        "lacks": list(diagnosis.lacks),
        "problems": [
            {"place": str(problem.place), "row": problem.row, "text": str(problem)} for problem in diagnosis.problems
        ],
        "uses": [{**asdict(use), "works": use.works} for use in diagnosis.uses],
    }


def _row(part: Part) -> Json:
    row = asdict(replace(part, seen=None))
    if part.seen:
        row["seen"] = {"pixels": asdict(part.seen.pixels), "pins": asdict(part.seen.pins)}
    return row


def _pairs(recordings: Recordings, rows: list[list[int]], parts: tuple[Part, ...]) -> Pairing:
    """Of the folders that training would take; of all contacts where there are none."""
    taken = {part.path for part in learnt_from(parts) or parts}
    kept = [row for own, part in zip(rows, parts, strict=True) if part.path in taken for row in own]
    poses, moves, ids = (
        None if labels is None else labels[kept] for labels in (recordings.poses, recordings.moves, recordings.pose_ids)
    )
    return pairing(poses, moves, ids, len(kept))


def _sizes(
    recordings: Recordings, rows: list[int], progress: Progress
) -> tuple[dict[int, tuple[int, int]], list[Problem]]:
    """(width, height) px by row of the images that can be used, and what is wrong with the others."""
    sizes: dict[int, tuple[int, int]] = {}
    problems: list[Problem] = []
    for row in rows:
        file = recordings.files[row]
        try:
            raw = read_image(file)
            check_frame(raw)
            sizes[row] = (raw.shape[1], raw.shape[0])
        except UserError as error:
            problems.append(Problem.at(file, str(error)))
        progress.advance()
    usual = _usual(sizes)
    problems += [
        Problem.at(recordings.files[row], f"{size[0]} x {size[1]} pixels, where most here have {usual[0]} x {usual[1]}")
        for row, size in sizes.items()
        if size != usual
    ]
    left = len(problems) - MOST_LISTED
    more = [Problem.at(recordings.files[rows[0]].parent, f"{left} more images with such faults")] if left > 0 else []
    return sizes, problems[:MOST_LISTED] + more


def _usual(sizes: dict[int, tuple[int, int]]) -> tuple[int, int]:
    return Counter(sizes.values()).most_common(1)[0][0] if sizes else (0, 0)


def _part(
    recordings: Recordings,
    folder: Path,
    rows: np.ndarray,
    sizes: dict[int, tuple[int, int]],
    share: int,
    problems: list[Problem],
) -> Part:
    """Of the images in `folder`; what is wrong with them as images is added to `problems`."""
    usual = _usual(sizes)
    alike = [row for row in rows if sizes.get(row) == usual]
    shown = _seen(recordings, alike, share, problems)
    root, single = recordings.path, recordings.path.is_file()
    home = root if single else folder.parent if folder.name in IMAGE_FOLDERS and folder != root else folder
    poses, moves = (None if labels is None else labels[rows] for labels in (recordings.poses, recordings.moves))
    taps, slides = (int(each.sum()) for each in taps_and_slides(moves, len(rows)))
    layout, columns = ("one image", ()) if single else _table(home, folder, poses, moves)
    name = root.absolute().name if home == root else home.relative_to(root).as_posix()
    return Part(home, name, layout, len(sizes), usual, _known(poses), _known(moves), taps, slides, columns, shown)


def _seen(recordings: Recordings, rows: list[int], share: int, problems: list[Problem]) -> Seen | None:
    """What some of these images show; None, and a problem, where that cannot be found out."""
    if not rows:
        return None
    files = [recordings.files[rows[i]] for i in evenly(len(rows), share)]
    try:
        return seen([(file.name, read_image(file)) for file in files])
    except UserError as error:
        problems.append(Problem.at(files[0].parent, f"{error} ({len(files)} of the images were examined)"))
        return None


def _known(labels: np.ndarray | None) -> int:
    return 0 if labels is None else int(np.isfinite(labels).all(axis=1).sum())


def _table(
    home: Path, folder: Path, poses: np.ndarray | None, moves: np.ndarray | None
) -> tuple[str, tuple[Column, ...]]:
    """The layout of a folder in words, and what its columns hold."""
    file = table_of(home)
    if file is None:
        return "images without a table", ()
    try:
        table = read_table(file)
    except UserError:  # already reported
        return f"images beside a {file.name} that is no table", ()
    named = [columns_of(table, choices) for choices in (POSE_COLUMNS, MOVE_COLUMNS)]
    columns = [
        column(name, unit, labels[:, i])
        for names, labels in zip(named, (poses, moves), strict=True)
        if labels is not None
        for i, (name, unit) in enumerate(zip(names, UNITS, strict=True))
    ]
    known = tuple(each for each in columns if each is not None)
    return _layout(table.columns, f"{folder.name}/" if folder != home else "images beside the table"), known


def _layout(columns: tuple[str, ...], images: str) -> str:
    if POSE_COLUMNS[1][0] in columns or MOVE_COLUMNS[1][0] in columns:
        kind = "newer layout"
    elif POSE_COLUMNS[0][0] in columns or MOVE_COLUMNS[0][0] in columns:
        kind = "variant of the older layout" if images == "frames_bw/" else "older layout"
    else:
        kind = "table without poses"
    return f"{kind} ({images})"
