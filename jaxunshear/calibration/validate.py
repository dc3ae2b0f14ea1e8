"""Measure how far simulated pins follow recorded ones; see `validation` for the scores.

results = validate(Path("recordings/edge"))
results["rows"]  # [{"name": "r2.tap", "unit": "1", "value": 0.71, "contacts": 398}, ...]

Some contacts of each folder align its labels with its images; others are compared.
"""

from collections import Counter
from itertools import product
from pathlib import Path

import numpy as np
from sklearn.kernel_ridge import KernelRidge
from sklearn.model_selection import PredefinedSplit, cross_val_predict

from jaxunshear.angles import rotate_2d
from jaxunshear.calibration.alignment import Alignment, align
from jaxunshear.calibration.calibrate import IMAGES, SEED
from jaxunshear.calibration.labels import LabelledMotions
from jaxunshear.calibration.pin_statistics import subtract_mean
from jaxunshear.calibration.prediction import (
    DEFAULT_CALIBRATION,
    Calibration,
    SensorValues,
    compute_mm_per_px,
    find_solutions,
    fit_positions,
    project_positions,
    simulate_displacements,
)
from jaxunshear.calibration.recorded_groups import (
    MIN_LABELLED,
    FolderSplit,
    RecordedImages,
    list_sampled_images,
    split_folders,
)
from jaxunshear.calibration.validation import (
    ComparedFolder,
    build_rows,
    centre_motions,
    draw_folders,
    format_table,
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

LeftOut = list[dict[str, str]]  # image, why


class _IncomparableError(Exception):
    """A folder has no contacts that can be compared; the message says why."""


def validate(
    path: Path,
    calibration: Calibration = DEFAULT_CALIBRATION,
    contacts_per_folder: int | None = CONTACTS_PER_FOLDER,
    seed: int = 0,
    out: Path | None = None,
) -> Json:
    """Compare simulated with recorded pins.

    Contacts that the calibration was fitted to are not compared. Raises `UserError` if nothing can
    be compared.

    Args:
        calibration: The simulator's sensor, camera and friction.
        contacts_per_folder: Most contacts of every folder, drawn at random; None for all.
        out: The folder for validate.txt and validate.png, which show no recorded image.

    Returns:
        `rows` (name, unit, value, contacts), `notes`, and `left_out` (image, why).
    """
    path, used = Path(path), calibration.image_names
    notes = [f"{calibration.name}; contacts drawn with seed {seed}"]
    if used is None:
        used = list_sampled_images(path, IMAGES, SEED, PRESET_RECORDINGS)
    elif not used:
        notes.append("the calibration does not name its images: some of them may be compared")
    splits, split_notes = split_folders(path, contacts_per_folder, seed, used)
    notes += split_notes
    folders: list[ComparedFolder] = []
    left_out: LeftOut = []
    for split in splits:
        try:
            folders.append(_compare_folder(split, calibration.values, notes, left_out))
        except _IncomparableError as reason:
            notes.append(f"{split.scored.name}: {reason}")
    if not folders:
        raise UserError(
            f"{path}: no folder has labelled contacts that can be compared: {notes[-1]}"
        )
    counts = Counter(image["why"] for image in left_out)
    notes += [f"{count} contacts left out, {why}" for why, count in counts.items()]
    notes.append(CEILING_NOTE)
    rows = build_rows(folders)
    text = format_table(rows) + "\n" + "".join(f"\nnote: {note}" for note in notes)
    print(text)
    if out is not None:
        write_text(Path(out) / "validate.txt", text + "\n")
        write_bytes(Path(out) / "validate.png", draw_folders(folders))
    return {"rows": rows, "notes": notes, "left_out": left_out}


def _compare_folder(
    split: FolderSplit, values: SensorValues, notes: list[str], left_out: LeftOut
) -> ComparedFolder:
    """Align and compare a folder; add to the notes and to the images left out."""
    name, scored = split.scored.name, split.scored
    alignment = _align_folder(split.align, values, notes)
    observation, labelled = scored.observe(values.base), scored.labelled_rows
    usable = labelled & observation.identified
    reasons = {
        "its label cannot be read": ~labelled,
        "its pins cannot be followed": labelled & ~observation.identified,
    }
    rows = np.flatnonzero(usable)
    _check_enough(len(rows), "contacts are labelled and followed")
    contacts = alignment.place_contacts(scored.poses[rows], scored.moves[rows])
    displacement = _simulate_contacts(name, contacts, alignment.side, values)
    converged = find_solutions(displacement)
    reasons["out of the simulator's reach, or not converged"] = np.isin(
        np.arange(len(usable)), rows[~converged]
    )
    for why, images in reasons.items():
        left_out += [{"image": scored.names[i], "why": why} for i in np.flatnonzero(images)]
    _check_enough(int(converged.sum()), "contacts converged")
    rotated = observation.rotate(alignment.mirrored, alignment.angle).take(rows[converged])
    contacts = contacts.take(np.flatnonzero(converged))
    size, scale = rotated.size, 128 / rotated.size
    flat = fit_positions(values, size, rotated.positions, displacement[converged])
    positions = project_positions(values, size, flat, displacement[converged])
    recorded, simulated = centre_motions(rotated.positions * scale, positions * scale)
    return ComparedFolder(
        name,
        recorded,
        simulated,
        predict_from_labels(contacts, recorded),
        rotated.lattice.ring,
        np.nanmean(rotated.positions, axis=0) * scale,
        compute_mm_per_px(values, 128, flat),
        np.linalg.norm(contacts.tip[:, 1] - contacts.tip[:, 0], axis=-1) < 1e-6,
    )


def _check_enough(count: int, what: str) -> None:
    if count < MIN_LABELLED:
        raise _IncomparableError(f"{count} {what}, fewer than {MIN_LABELLED}")


def _align_folder(part: RecordedImages, values: SensorValues, notes: list[str]) -> Alignment:
    observation = part.observe(values.base)
    rows = np.flatnonzero(part.labelled_rows & observation.identified)
    _check_enough(len(rows), "images to align by are labelled and followed")
    alignment = align(observation.take(rows), part.poses[rows], part.moves[rows], values)
    if alignment is None:
        raise _IncomparableError("its labels do not go with its images")
    frame = alignment.frame
    edge = f", edge {frame.across_mm:+.2f} mm from the labels' zero" if alignment.side else ""
    notes.append(
        f"{part.name}: aligned by {len(rows)} other contacts: "
        f"surface at {frame.surface_mm:.2f} mm of the depth axis, "
        f"tilted by {frame.tilt_x_deg:+.2f} and {frame.tilt_y_deg:+.2f} deg{edge}; "
        f"camera turned by {np.degrees(alignment.angle):.1f} deg"
    )
    return alignment


def _simulate_contacts(
    name: str, contacts: LabelledMotions, side: int, values: SensorValues
) -> np.ndarray:
    """Do what `simulate_displacements` does, in chunks with progress."""
    displacements = []
    with Progress(f"contacts of {name}", len(contacts), unit="contacts") as progress:
        for begin in range(0, len(contacts), CHUNK):
            chunk = contacts.take(np.arange(begin, min(begin + CHUNK, len(contacts))))
            displacements.append(simulate_displacements(values, chunk, side))
            progress.advance(len(chunk))
    return np.concatenate(displacements)


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
