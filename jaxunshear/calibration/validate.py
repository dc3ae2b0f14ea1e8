"""Measure how far simulated pins follow recorded ones; see `validation` for the scores.

results = validate(Path("recordings/edge"))
results["rows"]  # [{"name": "r2.tap", "unit": "1", "value": 0.71, "contacts": 398}, ...]

Some contacts of each folder align its labels with its images; others are compared.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from sklearn.kernel_ridge import KernelRidge
from sklearn.model_selection import PredefinedSplit, cross_val_predict

from jaxunshear.angles import rotate_2d
from jaxunshear.calibration.alignment import STEPS, AlignmentProblem, find_frame, read_labels
from jaxunshear.calibration.calibrate import IMAGES, SEED
from jaxunshear.calibration.calibration_result import DEFAULT_CALIBRATION, Calibration
from jaxunshear.calibration.labels import LabelFrame, LabelledMotions, apply_frame, read_motions
from jaxunshear.calibration.pin_statistics import PinObservation, subtract_mean
from jaxunshear.calibration.prediction import simulate_displacements
from jaxunshear.calibration.recorded_groups import MIN_LABELLED
from jaxunshear.calibration.sampling import FolderSplit, sample_folders, split_folders
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

CONTACTS_PER_FOLDER = 400
CHUNK = 50  # contacts between two steps of the progress
# the recordings that the shipped preset was fitted to, with IMAGES and SEED of `calibrate`
PRESET_RECORDINGS = ("edge_2d/shear/csv_train", "edge_2d/tap/csv_train")
CEILING_NOTE = (
    "ceiling: a regression from the labels of these contacts, which more of them raise: "
    "from few it may lie below"
)
FOLDS = 5
WIDTHS = (1.0, 1.5, 2.2, 3.3, 5.0)  # of the kernel, in standard deviations of the features
RIDGES = (1e-4, 1e-3, 1e-2, 1e-1)
COLUMNS = ("contacts of", "contacts", "r2", "ceiling_r2", "residual_px", "residual_mm", "motion_px")

LeftOut = list[dict[str, str]]  # image, why


def validate(
    path: Path,
    calibration: Calibration = DEFAULT_CALIBRATION,
    contacts_per_folder: int | None = CONTACTS_PER_FOLDER,
    seed: int = 0,
    out: Path | None = None,
    log: Callable[[str], None] = print,
    as_labelled: bool = False,
) -> Json:
    """Compare simulated with recorded pins.

    Contacts that the calibration was fitted to are not compared. Raises `UserError` if nothing can
    be compared.

    Args:
        calibration: The simulator's sensor, camera and friction.
        contacts_per_folder: Most contacts of every folder, drawn at random; None for all.
        out: The folder for validate.txt and validate.png, which show no recorded image.
        as_labelled: Leave edge and tilt of the object where the labels have them.

    Returns:
        `rows` (name, unit, value, contacts), `notes`, and `left_out` (image, why).
    """
    path = Path(path)
    notes = [f"{calibration.name}; contacts drawn with seed {seed}"]
    used = _list_calibration_images(path, calibration, notes)
    splits, split_notes = split_folders(path, contacts_per_folder, seed, used)
    notes += split_notes
    folders: list[ComparedFolder] = []
    left_out: LeftOut = []
    for split in splits:
        folder = _compare_folder(split, calibration, as_labelled, notes, left_out)
        if folder is not None:
            folders.append(folder)
    if not folders:
        raise UserError(
            f"{path}: no folder has labelled contacts that can be compared: {notes[-1]}"
        )
    notes += [*_note_left_out(left_out), CEILING_NOTE]
    rows = build_rows(folders)
    text = format_table(rows) + "\n" + "".join(f"\nnote: {note}" for note in notes)
    log(text)
    if out is not None:
        from jaxunshear.calibration.validate_figure import validate_figure

        write_text(Path(out) / "validate.txt", text + "\n")
        write_bytes(Path(out) / "validate.png", validate_figure(folders))
    return {"rows": rows, "notes": notes, "left_out": left_out}


def _note_left_out(left_out: LeftOut) -> list[str]:
    notes = []
    for why in sorted({image["why"] for image in left_out}):
        names = [image["image"] for image in left_out if image["why"] == why]
        some = f"{', '.join(names[:5])}{' ...' if len(names) > 5 else ''}"
        notes.append(f"{len(names)} left out, {why}: {some}")
    return notes


def format_table(rows: list[Row]) -> str:
    """Format a line for taps, slides and each ring of them."""
    from jaxunshear.text_table import format_text_table

    lines: dict[str, Json] = {}
    for row in rows:
        measure, _, part = str(row["name"]).partition(".")
        line = lines.setdefault(part, {"contacts of": part, "contacts": row["contacts"]})
        line[measure] = row["value"]
    return format_text_table(list(lines.values()), COLUMNS)


def _list_calibration_images(
    path: Path, calibration: Calibration, notes: list[str]
) -> tuple[str, ...]:
    """List the images that a calibration was fitted to."""
    if calibration.image_names is not None:
        if not calibration.image_names:
            notes.append("the calibration does not name its images: some of them may be compared")
        return calibration.image_names
    names: list[str] = []
    for part in sample_folders(path, IMAGES, SEED)[0]:
        if any(f"/{recording}".endswith(f"/{part.name}") for recording in PRESET_RECORDINGS):
            names += part.names
    return tuple(names)


@dataclass(frozen=True)
class RecordedFolder:
    """A folder's images in two parts: those that align, and those that are compared."""

    name: str
    problem: AlignmentProblem
    start: LabelFrame  # where the search for the frame begins
    mirrored: bool
    angle: float  # rad, of the camera, before the frame is found
    observation: PinObservation  # of the compared contacts, as the camera has them
    contacts: LabelledMotions
    images: tuple[str, ...]  # names


def _compare_folder(
    split: FolderSplit,
    calibration: Calibration,
    as_labelled: bool,
    notes: list[str],
    left_out: LeftOut,
) -> ComparedFolder | None:
    """Align and compare a folder; None if that is impossible.

    Adds to the notes and to the images left out.
    """
    folder = _read_folder(split, calibration, left_out)
    if isinstance(folder, str):
        notes.append(f"{split.scored.name}: {folder}")
        return None
    problem = folder.problem
    frame = find_frame(problem, folder.start, ("surface_mm",) if as_labelled else tuple(STEPS))
    angle = folder.angle - problem.measure_rotation(frame)
    notes.append(f"{folder.name}: {_describe_alignment(problem, frame, angle)}")
    contacts = apply_frame(folder.contacts, frame)
    displacement, converged = _simulate_contacts(folder.name, contacts, problem.side, calibration)
    left_out += _list_left_out(
        folder.images, ~converged, "out of the simulator's reach, or not converged"
    )
    rows = np.flatnonzero(converged)
    if len(rows) < MIN_LABELLED:
        notes.append(f"{folder.name}: too few contacts converged")
        return None
    observation = folder.observation.rotate(folder.mirrored, angle).take(rows)
    return _compare_contacts(
        folder.name, observation, contacts.take(rows), displacement[rows], calibration
    )


def _describe_alignment(problem: AlignmentProblem, frame: LabelFrame, angle: float) -> str:
    edge = f", edge {frame.across_mm:+.2f} mm from the labels' zero" if problem.side else ""
    return (
        f"aligned by {len(problem.contacts)} other contacts: "
        f"surface at {frame.surface_mm:.2f} mm of the depth axis, "
        f"tilted by {frame.tilt_x_deg:+.2f} and {frame.tilt_y_deg:+.2f} deg{edge}; "
        f"camera turned by {np.degrees(angle):.1f} deg"
    )


def _read_folder(
    split: FolderSplit, calibration: Calibration, left_out: LeftOut
) -> RecordedFolder | str:
    """Read a folder's labelled contacts, or say why it has none that can be compared."""
    align, scored = split.align, split.scored
    values, sensor = calibration.values, calibration.sensor
    observation = align.observe(sensor)
    rows = np.flatnonzero(align.labelled_rows & observation.identified)
    if len(rows) < MIN_LABELLED:
        return (
            f"{len(rows)} images to align by are labelled and followed, fewer than {MIN_LABELLED}"
        )
    assert align.poses is not None  # else none would be labelled
    moves = None if align.moves is None else align.moves[rows]
    reading = read_labels(observation.take(rows), align.poses[rows], moves, values, sensor)
    if reading is None:
        return "its labels do not go with its images"
    rotated = observation.take(rows).rotate(reading.mirrored, reading.angle)
    compared, labelled = scored.observe(sensor), scored.labelled_rows
    left_out += _list_left_out(scored.names, ~labelled, "its label cannot be read")
    left_out += _list_left_out(
        scored.names, labelled & ~compared.identified, "its pins cannot be followed"
    )
    rows = np.flatnonzero(labelled & compared.identified)
    if len(rows) < MIN_LABELLED:
        return f"{len(rows)} contacts are labelled and followed, fewer than {MIN_LABELLED}"
    assert scored.poses is not None  # else none would be labelled
    moves = None if scored.moves is None else reading.sign * scored.moves[rows]
    return RecordedFolder(
        scored.name,
        AlignmentProblem(rotated, reading.contacts, reading.side, values, sensor),
        LabelFrame(reading.surface_mm),
        reading.mirrored,
        reading.angle,
        compared.take(rows),
        read_motions(scored.poses[rows], moves),
        tuple(scored.names[row] for row in rows),
    )


def _compare_contacts(
    name: str,
    observation: PinObservation,
    contacts: LabelledMotions,
    displacement: np.ndarray,
    calibration: Calibration,
) -> ComparedFolder:
    values, sensor, size = calibration.values, calibration.sensor, observation.size
    flat, positions = fit_positions(values, sensor, size, observation.positions, displacement)
    scale = 128 / size
    recorded, simulated = centre_motions(observation.positions * scale, positions * scale)
    return ComparedFolder(
        name,
        recorded,
        simulated,
        predict_from_labels(contacts, recorded),
        observation.lattice.ring,
        np.nanmean(observation.positions, axis=0) * scale,
        compute_mm_per_px(values, sensor, 128, flat),
        np.linalg.norm(contacts.tip[:, 1] - contacts.tip[:, 0], axis=-1) < 1e-6,
    )


def _simulate_contacts(
    name: str, contacts: LabelledMotions, side: int, calibration: Calibration
) -> tuple[np.ndarray, np.ndarray]:
    """Do what `simulate_displacements` does, in chunks with progress."""
    sensor, friction = calibration.sensor, calibration.friction
    ratio = calibration.values.skin_to_gel
    displacements, converged = [], []
    with Progress(f"contacts of {name}", len(contacts), unit="contacts") as progress:
        for begin in range(0, len(contacts), CHUNK):
            chunk = contacts.take(np.arange(begin, min(begin + CHUNK, len(contacts))))
            solved = simulate_displacements(sensor, chunk, side, friction, 0.0, ratio)
            displacements.append(solved[0])
            converged.append(solved[1])
            progress.advance(len(chunk))
    return np.concatenate(displacements), np.concatenate(converged)


def _list_left_out(names: tuple[str, ...], left_out: np.ndarray, why: str) -> LeftOut:
    return [{"image": names[i], "why": why} for i in np.flatnonzero(left_out)]


def predict_from_labels(contacts: LabelledMotions, motion: np.ndarray) -> np.ndarray:
    """Predict motions (N, P, 2) px, each from the labels of contacts of other folds.

    Kernel ridge regression, with the width and the ridge that do best over all folds. Its residual
    is what no simulator of the labelled motion can explain: the robot's errors, the camera's
    pixels, and, for few contacts, what the regression could not learn from them.
    """
    x, y = _compute_features(contacts), np.nan_to_num(subtract_mean(motion))
    y = y.reshape(len(motion), -1)
    folds = PredefinedSplit(np.random.default_rng(0).permutation(len(x)) % FOLDS)
    best, best_error = np.zeros_like(y), np.inf
    for width, ridge in product(WIDTHS, RIDGES):
        model = KernelRidge(alpha=ridge, kernel="rbf", gamma=1 / (2 * width**2 * x.shape[1]))
        predicted = cross_val_predict(model, x, y, cv=folds)
        error = np.sum((predicted - y) ** 2)
        if error < best_error:
            best, best_error = predicted, error
    return best.reshape(motion.shape)


def _compute_features(contacts: LabelledMotions) -> np.ndarray:
    """Compute features (N, F) of unit spread in the sensor frame.

    They are position and depth, heading, tilt, slide and rotation.
    """
    count, yaw = len(contacts), contacts.yaw
    end, slide = contacts.tip[:, 1], contacts.tip[:, 1] - contacts.tip[:, 0]
    sensor_slide = np.column_stack([rotate_2d(slide[:, :2], -yaw), slide[:, 2]])
    turn = contacts.turn
    axis = turn[count:].inv().apply([0, 0, 1.0])  # the object's normal in the sensor's frame
    twist = (turn[:count].inv() * turn[count:]).as_rotvec()
    position = end[:, [0, 2]] if contacts.across else end[:, [2]]
    columns = np.column_stack(
        [position, np.cos(yaw), np.sin(yaw), axis[:, :2], sensor_slide, twist]
    )
    spread = columns.std(axis=0)
    varies = spread > 1e-6
    return (columns[:, varies] - columns[:, varies].mean(axis=0)) / spread[varies]
