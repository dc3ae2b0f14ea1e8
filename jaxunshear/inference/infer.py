"""Run a trained model on recordings: unshear the images and predict their poses.

JAX is imported only after the paths were checked.

>>> unshear_recordings(Path("recordings/edge"), Path("runs/demo"), Path("unsheared"))
"""

import sys
import time
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.data.sources import open_source
from jaxunshear.errors import UserError
from jaxunshear.files import Json, write_bytes, write_text
from jaxunshear.inference.inference_stats import (
    LabelErrors,
    Log,
    RejectedImages,
    count_rows,
    make_row,
)
from jaxunshear.model_folders import find_model_folder, load_settings
from jaxunshear.output_checks import check_not_among
from jaxunshear.perception.png import encode_png, to_uint8
from jaxunshear.progress import Progress
from jaxunshear.results.measurement import Measured, Measurement
from jaxunshear.serialization import format_csv

if TYPE_CHECKING:
    from jaxunshear.data.recordings import Recordings
    from jaxunshear.inference.frames import Frame
    from jaxunshear.inference.perceiver import Perceiver, Predictions

BATCH = 32
LABELS = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")


class _Source(NamedTuple):
    """Recordings, and the perceiver of their frames."""

    recordings: "Recordings"
    perceiver: "Perceiver"
    frames: "Iterator[Frame]"


class _Batch(NamedTuple):
    rows: list[int]
    names: list[str]
    predictions: "Predictions"
    seconds: float  # of the networks, for the full BATCH


def unshear_recordings(
    path: Path, model: Path, out: Path, force: bool = False, like: Path | None = None
) -> Measured:
    """Unshear every image at `path`; write PNGs, `poses.csv` and `NOTE.txt` to `out`.

    An image that is rejected gets no PNG and no pose, but a row that says why. The time per image
    is that of a full batch over BATCH. Raises `UserError` if the model or every image cannot be
    read, if `out` lies among the recordings, or if the images are not of the model's sensor.

    Args:
        path: An image, or a folder of recordings.
        model: The folder of a finished run, or the name of released weights.
        out: The folder for the results.
        force: Use images that are not of the model's sensor.
        like: A folder of contacts of the same sensor and camera, if `path` holds too few to
            estimate the rest positions.
    """
    model = find_model_folder(model)
    experiment = _load_settings(path, model)
    check_not_among(path, out, "--out")
    with_sheared_poses = uses_pins(experiment) or open_source(experiment).predicts_directly
    perceiver = _load_perceiver(model, experiment, with_sheared_poses, like or path)
    source = _open_source(path, perceiver, force)
    recordings = source.recordings
    files = _list_png_files(recordings.names)
    rejected = RejectedImages(recordings)
    errors = LabelErrors(perceiver.targets, recordings)
    table: list[Json] = []
    seconds: list[float] = []
    for batch in _predict_batches(source, "unshear"):
        unsheared = batch.predictions.unsheared
        if unsheared is None:
            raise UserError(
                f"{model} has no network that unshears: it learnt poses alone; "
                "use `jaxunshear pose`"
            )
        seconds.append(batch.seconds / BATCH)
        errors.add(batch.rows, batch.predictions)
        for i, (row, name) in enumerate(zip(batch.rows, batch.names, strict=True)):
            reason = rejected.add(name, batch.predictions.rejection[i])
            if reason:  # an image of an earlier run would appear to be the result
                (out / files[row]).unlink(missing_ok=True)
            else:
                write_bytes(out / files[row], encode_png(to_uint8(unsheared[i])))
            cells: Json = {"name": name, "image": "" if reason else files[row]}
            cells |= _format_poses(batch.predictions.poses.get("unsheared", {}), i)
            table.append(cells | _format_labels(recordings, row) | {"left_out": reason})
    write_text(out / "poses.csv", format_csv(table))
    notes = list(recordings.notes)
    if not perceiver.targets:
        notes.append(f"{model} has no trained PoseNet: poses.csv holds no predicted poses")
    _write_note(out / "NOTE.txt", model, experiment, notes)
    used = len(table) - rejected.count
    print(f"{used} images unsheared, {len(recordings) - used} left out; see {out / 'poses.csv'}")
    _report(rejected, errors, [*notes, open_source(experiment).describe()], print)
    return _add_provenance(
        [
            *count_rows("unshear", used, recordings),
            make_row("unshear.time_per_image", float(np.median(seconds)), "s"),
            *errors.rows(),
        ]
    )


def predict_recordings(
    path: Path, model: Path, force: bool = False, like: Path | None = None
) -> Measured:
    """Print the predicted poses of every image at `path`, as recorded and unsheared.

    They are printed as CSV. Notes and errors against the labels go to stderr, so that the CSV can
    be piped. Arguments and exceptions are those of `unshear_recordings`.
    """
    model = find_model_folder(model)
    experiment = _load_settings(path, model)
    perceiver = _load_perceiver(model, experiment, True, like or path)
    if not perceiver.targets:
        raise UserError(
            f"{model / 'posenet'} holds no trained model (no checkpoints): "
            "train first, or name another folder"
        )
    source = _open_source(path, perceiver, force)
    recordings = source.recordings
    rejected = RejectedImages(recordings)
    errors = LabelErrors(perceiver.targets, recordings)
    table: list[Json] = []
    measured: list[Measurement] = []
    for batch in _predict_batches(source, "pose"):
        errors.add(batch.rows, batch.predictions)
        for i, (row, name) in enumerate(zip(batch.rows, batch.names, strict=True)):
            reason = rejected.add(name, batch.predictions.rejection[i])
            cells: Json = {"name": name}
            for kind, poses in batch.predictions.poses.items():
                cells |= _format_poses(poses, i, f"{kind}_")
                if not reason:
                    measured += _list_pose_rows(f"{name}.{kind}", poses, i)
            table.append(cells | _format_labels(recordings, row) | {"left_out": reason})
    print(format_csv(table).rstrip("\n"))
    log = partial(print, file=sys.stderr)
    used = len(table) - rejected.count
    log(f"poses of {used} images, {len(recordings) - used} left out")
    _report(rejected, errors, [*recordings.notes, open_source(experiment).describe()], log)
    return _add_provenance([*measured, *count_rows("pose", used, recordings), *errors.rows()])


def _load_settings(path: Path, model: Path) -> Experiment:
    if not path.exists():
        raise UserError(f"{path} does not exist: name an image or a folder of recordings")
    return load_settings(model)


def _load_perceiver(
    model: Path, experiment: Experiment, with_sheared_poses: bool, like: Path
) -> "Perceiver":
    from jaxunshear.inference.perceiver import find_pin_frame, load_perceiver

    return load_perceiver(model, experiment, with_sheared_poses, find_pin_frame(like, experiment))


def _open_source(path: Path, perceiver: "Perceiver", force: bool) -> _Source:
    from jaxunshear.data.recordings import read_recordings
    from jaxunshear.inference.frames import open_frames

    recordings = read_recordings(path, perceiver.preprocess)
    return _Source(recordings, *open_frames(recordings, perceiver, force))


def _list_png_files(names: tuple[str, ...]) -> list[str]:
    """List the PNG file of each image; `a.jpg` beside `a.png` keeps its full name."""
    files: list[str] = []
    for name in names:
        file = str(PurePosixPath(name).with_suffix(".png"))
        files.append(f"{name}.png" if file in files else file)
    return files


def _predict_batches(source: _Source, label: str) -> Iterator[_Batch]:
    recordings, perceiver, frames = source
    size = recordings.preprocess.size
    perceiver.predict(np.zeros((BATCH, size, size), np.uint8))  # compiles
    with Progress(label, len(recordings)) as progress:
        done = 0
        while batch := list(islice(frames, BATCH)):
            images = np.zeros((BATCH, size, size), np.uint8)  # one shape to compile
            images[: len(batch)] = [frame.image for frame in batch]
            start = time.perf_counter()
            predictions = perceiver.predict(images)
            seconds = time.perf_counter() - start
            rows, names = [frame.row for frame in batch], [frame.name for frame in batch]
            yield _Batch(rows, names, predictions, seconds)
            progress.advance(rows[-1] + 1 - done)
            done = rows[-1] + 1
        progress.advance(len(recordings) - done)  # images at the end that cannot be read


def _format_poses(poses: Mapping[str, np.ndarray], i: int, prefix: str = "") -> dict[str, str]:
    cells = {}
    for quantity, values in poses.items():
        cells[f"{prefix}{quantity}"] = f"{values[i]:.4f}" if np.isfinite(values[i]) else ""
    return cells


def _list_pose_rows(name: str, poses: Mapping[str, np.ndarray], i: int) -> list[Measurement]:
    return [
        make_row(f"{name}.{quantity}", float(values[i]), quantity.split("_")[-1])
        for quantity, values in poses.items()
    ]


def _format_labels(recordings: "Recordings", row: int) -> dict[str, str]:
    """Format the labels of an image; cells are empty if it has none."""
    cells = {}
    for kind, values in (("pose", recordings.poses), ("move", recordings.moves)):
        if values is not None:
            for label, value in zip(LABELS, values[row], strict=True):
                cells[f"recorded_{kind}_{label}"] = f"{value:.6g}" if np.isfinite(value) else ""
    return cells


def _write_note(file: Path, model: Path, experiment: Experiment, notes: list[str]) -> None:
    source = open_source(experiment)
    lines = [source.describe(), source.pose_frame, f"Networks: {model.name}", *notes]
    write_text(file, "\n".join(lines) + "\n")


def _report(rejected: RejectedImages, errors: LabelErrors, notes: list[str], log: Log) -> None:
    rejected.report(log)
    errors.report(log)
    for note in (*notes[:9], *notes[9:][-1:]):
        log(f"note: {note}")
    if len(notes) > 10:
        log(f"note: and {len(notes) - 10} more")


def _add_provenance(rows: list[Measurement]) -> Measured:
    from jaxunshear.code_version import read_source
    from jaxunshear.metrics.machine import describe_machine, list_versions

    return Measured(rows, describe_machine(), list_versions(), read_source())
