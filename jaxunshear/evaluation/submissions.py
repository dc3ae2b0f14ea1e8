"""Score results of any program on recorded slides: unsheared images, or poses.

>>> submission = score_submission(Path("theirs.csv"), Path("recordings/edge"))
>>> submission.rows[0]["value"]  # mean of the first score

Images are compared with the tap at the slide's pose, beside the slides as they were recorded; poses
with the labels, beside the median label. What is not scored is counted by its reason.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from jaxunshear.config.data import Recorded, SplitMethod
from jaxunshear.config.sensor import Preprocess
from jaxunshear.config.splits import SPLITS
from jaxunshear.config.targets import get_unit, make_label_targets
from jaxunshear.data.labels import IMAGE_COLUMNS, name_labels, normalise_text
from jaxunshear.data.pairing import find_recorded_taps
from jaxunshear.data.reader import concatenate_batches
from jaxunshear.data.recorded_contacts import RecordedContacts, read_contacts, read_test_contacts
from jaxunshear.data.recordings import (
    PROBES,
    find_common_view,
    read_first_image,
    read_image,
    read_recordings,
)
from jaxunshear.data.tables import read_table
from jaxunshear.errors import UserError
from jaxunshear.evaluation.result_tables import Resampled, resample
from jaxunshear.evaluation.score import compute_chance_errors, score_poses
from jaxunshear.files import BROKEN_NPZ, Json, parse_number, read_npz
from jaxunshear.metrics import count_scales, format_ms_ssim_name, ms_ssim, mse, ssim
from jaxunshear.perception.grey import to_grey
from jaxunshear.perception.preprocess import View, prepare_frame
from jaxunshear.progress import Progress
from jaxunshear.selection import select_evenly

SUBMITTED, SHEARED, CHANCE = "submitted", "sheared", "median_label"
NAME_COLUMNS = ("name", *IMAGE_COLUMNS)
BATCH = 32
UNREADABLE, NOT_A_SLIDE = "not readable", "not of a slide that is scored"
MISSING = "slides without a result"
NO_TAP, NO_LABEL, NO_VALUE = "no tap at the slide's pose", "no label", "no value"
COLUMNS = ("name", "unit", "slides", "value", SHEARED, "difference")
POSE_COLUMNS = ("name", "unit", "slides", "value", CHANCE)


class Submission(NamedTuple):
    """The scores of a submission, and what was left out."""

    rows: list[Json]  # a score each: name, unit, slides, values and intervals by kind
    scored: int  # slides
    slides: int  # of the recordings
    left_out: Mapping[str, int]  # by reason
    notes: Sequence[str]  # on the recordings

    @property
    def columns(self) -> tuple[str, ...]:
        return POSE_COLUMNS if CHANCE in self.rows[0] else COLUMNS


class _Scores(NamedTuple):
    rows: np.ndarray  # (N,) of the recordings
    scores: dict[str, np.ndarray]  # (N,) by `<table>/<kind>` or `<table>/<kind>/<target>`


def score_submission(path: Path, recordings: Path, split: SplitMethod | None = None) -> Submission:
    """Score a folder of unsheared images, or a table of poses (CSV or npz), on recorded slides.

    With `split` only slides that this split has for test are scored. Raises UserError if nothing
    can be scored.
    """
    folder = str(recordings)
    settings = Recorded(tap_folder=folder, slide_folder=folder)
    if split is None:
        contacts = read_test_contacts(settings)
    else:
        contacts = read_contacts(replace(settings, split=split))
        contacts = contacts.take(np.flatnonzero(contacts.split == SPLITS.index("test")))
    left_out = Counter[str]()
    slides = np.flatnonzero(contacts.is_slide)
    if not len(slides):
        raise UserError(f"{recordings} holds no slide with a label: name recordings with slides")
    if path.is_dir():
        scored = _score_images(path, contacts, left_out)
        rows = _tabulate(scored, contacts, (SUBMITTED, SHEARED))
    else:
        scored, chance = _score_poses(path, contacts, left_out)
        rows = _tabulate(scored, contacts, (SUBMITTED,))
        for row in rows:
            row[CHANCE] = chance[row["name"].rpartition(".")[2]]
    return Submission(rows, len(scored.rows), len(slides), dict(left_out), contacts.notes)


def match_slides(names: Sequence[str], contacts: RecordedContacts) -> np.ndarray:
    """Find the slides (N,) that results are named after, -1 for a name of no slide.

    A name is that of the slide's file without its ending, or the end of its path. Raises UserError
    for a name of several slides, and for a slide with two results.
    """
    by_name: dict[str, list[int]] = {}
    for row in np.flatnonzero(contacts.is_slide).tolist():
        parts = _strip_ending(contacts.names[row]).split("/")
        for start in range(len(parts)):
            by_name.setdefault("/".join(parts[start:]), []).append(row)
    matched = np.full(len(names), -1)
    for i, name in enumerate(names):
        rows = by_name.get(_strip_ending(name), [])
        if len(rows) > 1:
            choice = " or ".join(contacts.names[row] for row in rows[:2])
            raise UserError(f"{name} may be {choice}: name results by their folders, too")
        matched[i] = rows[0] if rows else -1
    repeated = [row for row, count in Counter(matched.tolist()).items() if row >= 0 and count > 1]
    if repeated:
        raise UserError(f"{contacts.names[repeated[0]]} has two results: give one for each slide")
    return matched


def _strip_ending(name: str) -> str:
    return str(PurePosixPath(normalise_text(name)).with_suffix(""))


def _count_missing(
    matched: np.ndarray, contacts: RecordedContacts, left_out: Counter[str]
) -> np.ndarray:
    """Count names of no slide, and slides without a result; return which names are of slides."""
    known = matched >= 0
    left_out[NOT_A_SLIDE] += int(np.sum(~known))
    left_out[MISSING] += int(contacts.is_slide.sum() - known.sum())
    return known


def _score_images(path: Path, contacts: RecordedContacts, left_out: Counter[str]) -> _Scores:
    submitted = read_recordings(path, Preprocess())
    matched = match_slides(submitted.names, contacts)
    known = np.flatnonzero(_count_missing(matched, contacts, left_out))
    taps = find_recorded_taps(contacts, matched[known])
    left_out[NO_TAP] += int(np.sum(taps < 0))
    chosen, taps = known[taps >= 0], taps[taps >= 0]
    if not len(chosen):
        raise UserError(
            f"no image of {path} can be scored: each needs the name of a slide to whose pose a tap "
            f"was recorded (the same pose_id and labels); {_format_counts(left_out)}"
        )
    files = [submitted.files[row] for row in chosen]
    first = read_first_image(files)
    if first is None:
        raise UserError(f"no image of {path} can be read: name a folder of unsheared images")
    preprocess = Preprocess(size=min(first.shape[:2]))
    frames = [contacts.files[row] for row in select_evenly(len(contacts.files), PROBES)]
    view = find_common_view(frames, preprocess)
    kept: list[int] = []

    def read_triples() -> Iterator[np.ndarray]:
        with Progress("score", len(files)) as progress:
            for i, file in enumerate(files):
                progress.advance()
                recorded = contacts.files[matched[chosen[i]]], contacts.files[taps[i]]
                triple = _read_triple(file, recorded, preprocess, view)
                if triple is None:
                    left_out[UNREADABLE] += 1
                else:
                    kept.append(i)
                    yield triple

    scores = _compare_images(read_triples(), preprocess.size)
    if not kept:
        raise UserError(
            f"no image of {path} can be scored: "
            f"give square images of one size; {_format_counts(left_out)}"
        )
    return _Scores(matched[chosen[kept]], scores)


def _read_triple(
    file: Path, recorded: tuple[Path, Path], preprocess: Preprocess, view: View
) -> np.ndarray | None:
    """Read a submitted image, its slide and its tap as (3, S, S) in [0, 1]; None if one fails."""
    try:
        submitted = to_grey(read_image(file))
        if submitted.shape != (preprocess.size, preprocess.size):
            return None
        frames = [prepare_frame(preprocess, read_image(each), view) for each in recorded]
    except UserError:
        return None
    return np.stack([submitted, *(frame.astype(np.float32) / 255 for frame in frames)])


def _compare_images(triples: Iterator[np.ndarray], size: int) -> dict[str, np.ndarray]:
    """Compare submitted images, and slides as recorded, with taps: (N,) by metric and kind."""
    scales = count_scales(size)
    batches: list[dict[str, np.ndarray]] = []
    batch: list[np.ndarray] = []

    def finish_batch() -> None:
        padded = np.stack([*batch, *[batch[0]] * (BATCH - len(batch))])[..., None]
        scores: dict[str, np.ndarray] = {}
        for kind, images in ((SUBMITTED, padded[:, 0]), (SHEARED, padded[:, 1])):
            taps = padded[:, 2]
            similarity = np.asarray(ms_ssim(images, taps, scales))
            scores[f"{format_ms_ssim_name(scales)}/{kind}"] = similarity
            scores[f"ssim/{kind}"] = np.asarray(ssim(images, taps))
            scores[f"mse/{kind}"] = np.asarray(mse(images, taps))
        batches.append({name: values[: len(batch)] for name, values in scores.items()})
        batch.clear()

    for triple in triples:
        batch.append(triple)
        if len(batch) == BATCH:
            finish_batch()
    if batch:
        finish_batch()
    return concatenate_batches(batches) if batches else {}


def _score_poses(
    path: Path, contacts: RecordedContacts, left_out: Counter[str]
) -> tuple[_Scores, dict[str, float]]:
    """Score poses by target; return the errors of the median label, too."""
    labels = name_labels(contacts.pose, contacts.move, contacts.others)
    names, columns = _read_columns(path, labels)
    matched = match_slides(names, contacts)
    known = _count_missing(matched, contacts, left_out)
    true = np.stack([labels[name][matched] for name in columns])
    has_label = np.isfinite(true).all(axis=0)
    has_value = np.isfinite(np.stack(list(columns.values()))).all(axis=0)
    left_out[NO_LABEL] += int(np.sum(known & ~has_label))
    left_out[NO_VALUE] += int(np.sum(known & has_label & ~has_value))
    rows = np.flatnonzero(known & has_label & has_value)
    if not len(rows):
        raise UserError(f"no pose of {path} can be scored: {_format_counts(left_out)}")
    slides = matched[rows]
    answers = {name: labels[name][slides] for name in columns}
    predicted = {name: values[rows] for name, values in columns.items()}
    scores = score_poses({SUBMITTED: predicted}, answers, "pose_mae")
    pose, move = contacts.pose[slides], contacts.move[slides]
    others = {name: values[slides] for name, values in contacts.others.items()}
    targets = make_label_targets(tuple(columns), pose, move, others)
    return _Scores(slides, scores), compute_chance_errors(answers, targets)


def _read_columns(
    path: Path, labels: Mapping[str, np.ndarray]
) -> tuple[list[str], dict[str, np.ndarray]]:
    """Read the names of results, and the columns (N,) that are called as labels.

    Raises UserError without names, or without such a column.
    """
    if path.suffix.lower() == ".npz":
        try:
            table = {name: np.atleast_1d(values) for name, values in read_npz(path).items()}
        except BROKEN_NPZ as error:
            raise UserError(f"{path} cannot be read as npz ({error}): write it again") from error
    else:
        read, table = read_table(path), {}
        for name in read.columns:
            table[name] = np.array([row[name] for row in read.rows.values()])
    column = next((name for name in NAME_COLUMNS if name in table), None)
    if column is None:
        raise UserError(f"{path} has no column of file names: add one called name")
    values = {name: _parse_column(table[name]) for name in labels if name in table}
    if not values:
        raise UserError(f"{path} has no column that is called as a label: use {', '.join(labels)}")
    lengths = {len(each) for each in (table[column], *values.values())}
    if len(lengths) > 1:
        raise UserError(f"{path}: its arrays have different lengths: give a row for each slide")
    return [str(name) for name in table[column]], values


def _parse_column(cells: np.ndarray) -> np.ndarray:
    """Parse numbers (N,); a cell that is none is NaN."""
    if np.issubdtype(cells.dtype, np.number):
        return cells.astype(np.float64)
    values = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells.tolist()):
        try:
            values[i] = parse_number(str(cell))
        except ValueError:
            continue
    return values


def _tabulate(scored: _Scores, contacts: RecordedContacts, kinds: Sequence[str]) -> list[Json]:
    """Make a row for each score: means and 95 % intervals by kind, and their difference."""
    scores = dict(scored.scores)
    tables = [name.replace(f"/{SUBMITTED}", "") for name in scores if f"/{SUBMITTED}" in name]
    if SHEARED in kinds:
        for table in tables:
            sheared = scores[f"{table}/{SHEARED}"]
            scores[f"{table}/difference"] = scores[f"{table}/{SUBMITTED}"] - sheared
        kinds = (*kinds, "difference")
    poses = np.unique(contacts.pose[scored.rows].round(4), axis=0, return_inverse=True)[1]
    resampled = resample(scores, poses.reshape(-1))
    assert resampled is not None  # there are contacts
    return [_make_row(resampled, table, kinds, len(scored.rows)) for table in tables]


def _make_row(resampled: Resampled, table: str, kinds: Sequence[str], slides: int) -> Json:
    metric, *target = table.split("/")
    row: Json = {
        "name": ".".join([metric, SUBMITTED, *target]),
        "unit": get_unit(target[0]) if target else "1",
        "slides": slides,
    }
    for kind in kinds:
        name, field = "/".join([metric, kind, *target]), "value" if kind == SUBMITTED else kind
        row[field] = resampled.compute_mean(name)
        row[f"{field}_interval"] = resampled.compute_interval(name)
    return row


def format_rows(rows: Sequence[Json]) -> list[Json]:
    """Format scores with their intervals in brackets, for a table of text."""
    formatted = []
    for row in rows:
        cells: Json = {}
        for name, value in row.items():
            if name.endswith("_interval"):
                kind = name.removesuffix("_interval")
                low, high = value
                cells[kind] = f"{row[kind]:.3g} [{low:.3g}, {high:.3g}]"
            else:
                cells[name] = value
        formatted.append(cells)
    return formatted


def _format_counts(left_out: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in left_out.items() if count)
