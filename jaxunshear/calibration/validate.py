"""How far the simulated pins follow the recorded ones; see `validation` for what is compared.

results = validate(Path("recordings/edge"))
results["rows"]  # [{"name": "r2.tap", "unit": "1", "value": 0.71, "contacts": 398}, ...]

Some contacts of each folder show how its labels and images go together; others are compared.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from sklearn.kernel_ridge import KernelRidge
from sklearn.model_selection import PredefinedSplit, cross_val_predict

from jaxunshear.angles import rotate_2d
from jaxunshear.calibration.alignment import STEPS, AlignmentProblem, find_frame, read_labels
from jaxunshear.calibration.calibrate import IMAGES, MIN_LABELLED
from jaxunshear.calibration.calibration_result import DEFAULT_CALIBRATION, Calibration
from jaxunshear.calibration.labels import LabelFrame, LabelledMotions, apply_frame, read_motions
from jaxunshear.calibration.pin_statistics import PinObservation, subtract_mean
from jaxunshear.calibration.prediction import simulate_displacements
from jaxunshear.calibration.sampling import Parts, sample_folders, split_folders
from jaxunshear.calibration.validation import (
    ComparedFolder,
    Row,
    build_rows,
    centre_motions,
    compute_mm_per_px,
    fit_positions,
)
from jaxunshear.errors import UserError
from jaxunshear.files import Json, write_bytes, write_text
from jaxunshear.progress import Progress

CONTACTS_PER_FOLDER = 400  # contacts of a folder
CHUNK = 50  # contacts between two steps of the progress
# what the shipped preset was fitted to, of IMAGES and seed 0
PRESET_RECORDINGS = ("edge_2d/shear/csv_train", "edge_2d/tap/csv_train")
CEILING_NOTE = "ceiling: a regression from the labels of these contacts, which more of them raise: from few it may lie below"
FOLDS = 5
WIDTHS = (1.0, 1.5, 2.2, 3.3, 5.0)  # of the kernel, in standard deviations of the features
RIDGES = (1e-4, 1e-3, 1e-2, 1e-1)

LeftOut = list[dict[str, str]]  # image, why


def validate(
    path: Path,
    calibrated: Calibration = DEFAULT_CALIBRATION,
    contacts_per_folder: int | None = CONTACTS_PER_FOLDER,
    seed: int = 0,
    out: Path | None = None,
    log: Callable[[str], None] = print,
    as_labelled: bool = False,
) -> Json:
    """Compare simulated with recorded pins in contacts that the calibration has not seen.

    `contacts_per_folder` contacts of every folder at `path` are drawn at random (None: all). `as_labelled`: with
    edge and tilt of the object where the labels have them.

    Returns `rows` (name, unit, value, contacts), `notes`, and `left_out` (image, why). With `out`,
    writes validate.txt and validate.png there, which show no recorded image. Raises `UserError`
    where nothing can be compared.
    """
    path = Path(path)
    notes = [f"{calibrated.name}; contacts drawn with seed {seed}"]
    parts, more = split_folders(
        path, contacts_per_folder, seed, _list_calibration_images(path, calibrated, notes)
    )
    notes += more
    compared: list[ComparedFolder] = []
    left_out: LeftOut = []
    for part in parts:
        found = _compare_folder(part, calibrated, as_labelled, notes, left_out)
        compared += [] if found is None else [found]
    if not compared:
        raise UserError(
            f"{path}: no folder has labelled contacts that can be compared: {notes[-1]}"
        )
    for why in sorted({one["why"] for one in left_out}):
        names = [one["image"] for one in left_out if one["why"] == why]
        some = f"{', '.join(names[:5])}{' ...' if len(names) > 5 else ''}"
        notes.append(f"{len(names)} left out, {why}: {some}")
    notes.append(CEILING_NOTE)
    rows = build_rows(compared)
    text = format_table(rows) + "\n" + "".join(f"\nnote: {note}" for note in notes)
    log(text)
    if out is not None:
        from jaxunshear.calibration.validate_figure import validate_figure

        write_text(Path(out) / "validate.txt", text + "\n")
        write_bytes(Path(out) / "validate.png", validate_figure(compared))
    return {"rows": rows, "notes": notes, "left_out": left_out}


def format_table(rows: list[Row]) -> str:
    """Print a line for taps, slides and each ring of them."""
    from jaxunshear.text_table import format_text_table

    lines: dict[str, Json] = {}
    for row in rows:
        measure, _, part = str(row["name"]).partition(".")
        lines.setdefault(part, {"contacts of": part, "contacts": row["contacts"]})[measure] = row[
            "value"
        ]
    columns = (
        "contacts of",
        "contacts",
        "r2",
        "ceiling_r2",
        "residual_px",
        "residual_mm",
        "motion_px",
    )
    return format_text_table(list(lines.values()), columns)


def _list_calibration_images(
    path: Path, calibrated: Calibration, notes: list[str]
) -> tuple[str, ...]:
    """Names of the images that a calibration was fitted to."""
    if calibrated.image_names is not None:
        if not calibrated.image_names:
            notes.append("the calibration does not name its images: some of them may be compared")
        return calibrated.image_names
    parts, _ = sample_folders(path, IMAGES, 0)
    fitted = [
        part
        for part in parts
        if any(f"/{known}".endswith(f"/{part.name}") for known in PRESET_RECORDINGS)
    ]
    return tuple(name for part in fitted for name in part.names)


@dataclass(frozen=True)
class RecordedFolder:
    """A folder's images in two parts: those that align, and those that are compared."""

    name: str
    problem: AlignmentProblem
    start: LabelFrame  # where the search for the frame begins
    mirrored: bool
    angle: float  # rad, of the camera, before the frame is found
    observation: PinObservation  # compared contacts, as the camera has them
    contacts: LabelledMotions  # of the same
    images: tuple[str, ...]  # their names


class FolderAlignment(NamedTuple):
    """What a folder's labels do not give, read off images that are not compared."""

    frame: LabelFrame
    angle: float  # rad, of the camera

    def note(self, matter: AlignmentProblem) -> str:
        frame = self.frame
        edge = f", edge {frame.across_mm:+.2f} mm from the labels' zero" if matter.side else ""
        return (
            f"aligned by {len(matter.contacts)} other contacts: surface at {frame.surface_mm:.2f} mm of the "
            f"depth axis, tilted by {frame.tilt_x_deg:+.2f} and {frame.tilt_y_deg:+.2f} deg{edge}; "
            f"camera turned by {np.degrees(self.angle):.1f} deg"
        )


def _compare_folder(
    parts: Parts, known: Calibration, as_labelled: bool, notes: list[str], left_out: LeftOut
) -> ComparedFolder | None:
    """A folder aligned and compared, with notes and the images left out; None where it cannot be."""
    folder = _read_folder(parts, known, left_out)
    if isinstance(folder, str):
        notes.append(f"{parts.scored.name}: {folder}")
        return None
    matter = folder.problem
    frame = find_frame(matter, folder.start, ("surface_mm",) if as_labelled else tuple(STEPS))
    aligned = FolderAlignment(frame, folder.angle - matter.measure_rotation(frame))
    notes.append(f"{folder.name}: {aligned.note(matter)}")
    contacts = apply_frame(folder.contacts, frame)
    moved, converged = _solve_contacts(folder.name, contacts, matter.side, known)
    left_out += _lost(folder.images, ~converged, "out of the simulator's reach, or not converged")
    kept = np.flatnonzero(converged)
    if len(kept) < MIN_LABELLED:
        notes.append(f"{folder.name}: too few contacts converged")
        return None
    seen = folder.observation.rotate(folder.mirrored, aligned.angle).take(kept)
    return _compared(folder.name, seen, contacts.take(kept), moved[kept], known)


def _read_folder(parts: Parts, known: Calibration, left_out: LeftOut) -> RecordedFolder | str:
    """A folder's labelled contacts, or why it has none that can be compared."""
    align, scored = parts.align, parts.scored
    seen = align.observe(known.sensor)
    rows = np.flatnonzero(align.labelled_rows & seen.identified)
    if len(rows) < MIN_LABELLED:
        return (
            f"{len(rows)} images to align by are labelled and followed, fewer than {MIN_LABELLED}"
        )
    assert align.poses is not None  # else none would be labelled
    moves = None if align.moves is None else align.moves[rows]
    reading = read_labels(seen.take(rows), align.poses[rows], moves, known.values, known.sensor)
    if reading is None:
        return "its labels do not go with its images"
    turned = seen.take(rows).rotate(reading.mirrored, reading.angle)
    compared, labelled = scored.observe(known.sensor), scored.labelled_rows
    left_out += _lost(scored.names, ~labelled, "its label cannot be read")
    left_out += _lost(scored.names, labelled & ~compared.identified, "its pins cannot be followed")
    kept = np.flatnonzero(labelled & compared.identified)
    if len(kept) < MIN_LABELLED:
        return f"{len(kept)} contacts are labelled and followed, fewer than {MIN_LABELLED}"
    assert scored.poses is not None  # else none would be labelled
    return RecordedFolder(
        scored.name,
        AlignmentProblem(turned, reading.contacts, reading.side, known.values, known.sensor),
        LabelFrame(reading.surface_mm),
        reading.mirrored,
        reading.angle,
        compared.take(kept),
        read_motions(
            scored.poses[kept], None if scored.moves is None else reading.sign * scored.moves[kept]
        ),
        tuple(scored.names[i] for i in kept),
    )


def _compared(
    name: str,
    seen: PinObservation,
    contacts: LabelledMotions,
    moved: np.ndarray,
    known: Calibration,
) -> ComparedFolder:
    flat, place = fit_positions(known.values, known.sensor, seen.size, seen.positions, moved)
    scale = 128 / seen.size
    recorded, simulated = centre_motions(seen.positions * scale, place * scale)
    return ComparedFolder(
        name,
        recorded,
        simulated,
        explained_by_labels(contacts, recorded),
        seen.lattice.ring,
        np.nanmean(seen.positions, axis=0) * scale,
        compute_mm_per_px(known.values, known.sensor, 128, flat),
        np.linalg.norm(contacts.tip[:, 1] - contacts.tip[:, 0], axis=-1) < 1e-6,
    )


def _solve_contacts(
    name: str, contacts: LabelledMotions, side: int, known: Calibration
) -> tuple[np.ndarray, np.ndarray]:
    """As `simulate_displacements`, some contacts at a time."""
    values, parts = known.values, []
    with Progress(f"contacts of {name}", len(contacts), unit="contacts") as progress:
        for begin in range(0, len(contacts), CHUNK):
            some = contacts.take(np.arange(begin, min(begin + CHUNK, len(contacts))))
            parts.append(
                simulate_displacements(
                    known.sensor, some, side, values.friction, 0.0, values.skin_to_gel
                )
            )
            progress.advance(len(some))
    return np.concatenate([moved for moved, _ in parts]), np.concatenate(
        [fine for _, fine in parts]
    )


def _lost(names: tuple[str, ...], lost: np.ndarray, why: str) -> LeftOut:
    return [{"image": names[i], "why": why} for i in np.flatnonzero(lost)]


def explained_by_labels(contacts: LabelledMotions, motion: np.ndarray) -> np.ndarray:
    """Predict motions (N, P, 2) px, each from the labels of contacts of other folds.

    Kernel ridge regression, with the width and the ridge that do best over all folds. What is left
    over is what no simulator of the labelled motion can explain: the robot's errors, the camera's
    pixels, and for few contacts what the regression has not learnt yet.
    """
    x, y = _features(contacts), np.nan_to_num(subtract_mean(motion)).reshape(len(motion), -1)
    folds = PredefinedSplit(np.random.default_rng(0).permutation(len(x)) % FOLDS)
    best, error = np.zeros_like(y), np.inf
    for width, ridge in product(WIDTHS, RIDGES):
        model = KernelRidge(alpha=ridge, kernel="rbf", gamma=1 / (2 * width**2 * x.shape[1]))
        predicted = cross_val_predict(model, x, y, cv=folds)
        off = np.sum((predicted - y) ** 2)
        if off < error:
            best, error = predicted, off
    return best.reshape(motion.shape)


def _features(contacts: LabelledMotions) -> np.ndarray:
    """Place and depth, heading, tilt, slide and turn as the sensor feels them: (N, F) of unit spread."""
    count, yaw = len(contacts), contacts.yaw
    end, slide = contacts.tip[:, 1], contacts.tip[:, 1] - contacts.tip[:, 0]
    own = np.column_stack([rotate_2d(slide[:, :2], -yaw), slide[:, 2]])
    turn = contacts.turn
    axis = turn[count:].inv().apply([0, 0, 1.0])  # the object's normal in the sensor's frame
    twist = (turn[:count].inv() * turn[count:]).as_rotvec()
    place = end[:, [0, 2]] if contacts.across else end[:, [2]]
    columns = np.column_stack([place, np.cos(yaw), np.sin(yaw), axis[:, :2], own, twist])
    spread = columns.std(axis=0)
    varied = spread > 1e-6
    return (columns[:, varied] - columns[:, varied].mean(axis=0)) / spread[varied]
