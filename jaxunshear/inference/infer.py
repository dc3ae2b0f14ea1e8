"""A finished run at work on recordings: unshears them and determines their poses. Imports JAX only once the paths are known good.

>>> unshear_recordings(Path("recordings/edge"), Path("runs/demo"), Path("unsheared"))
"""

import sys
import time
from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.errors import UserError
from jaxunshear.files import Json, write_bytes, write_text
from jaxunshear.inference.inference_stats import (
    LabelErrors,
    Log,
    RejectedImages,
    count_rows,
    make_row,
)
from jaxunshear.inference.suitability import learnt_note
from jaxunshear.model_folders import find_model_folder, load_settings
from jaxunshear.output_checks import check_not_among
from jaxunshear.perception.png import encode_png, to_uint8
from jaxunshear.progress import Progress
from jaxunshear.results.measurement import Measured, Measurement
from jaxunshear.serialization import format_csv

if TYPE_CHECKING:
    from jaxunshear.data.recordings import Recordings
    from jaxunshear.inference.frames import Frames
    from jaxunshear.inference.perceiver import Perceiver, Predictions

BATCH = 32
LABELS = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")
FRAMES = (
    "x_mm and yaw_deg are relative to the simulated stimulus' target point, edge_mm (negative inside) and edge_deg "
    "give the nearest edge in the sensor frame; recorded_* are the labels that came with the images, in their own work frame."
)
OWN_FRAME = "Poses have the names, the frame and the units of the recorded labels that the networks learnt from."


def unshear_recordings(
    path: Path, model: Path, out: Path, force: bool = False, like: Path | None = None
) -> Measured:
    """Writes every image at `path`, unsheared, to `out` as a grey PNG under its own name, then `poses.csv` and `NOTE.txt`. One that is
    not understood gets no image and no pose, but a row that says why.

    `like` is a folder of contacts of the same sensor and camera, for a `path` that holds too few to know where pins stand. Returns what
    was measured, as rows; the time per image is that of a batch of BATCH, blanks that fill it up included, over BATCH.
    Raises `UserError` where the model or every image cannot be read, where `out` lies among the recordings, or where the images are not
    of the model's sensor, unless `force`d.
    """
    model = find_model_folder(model)
    experiment = _settings_for(path, model)
    check_not_among(path, out, "--out")
    network = _perceiver(
        model,
        experiment,
        uses_pins(experiment) or isinstance(experiment.paired, Recorded),
        like or path,
    )
    recordings, network, frames = _read(path, network, force)
    targets = _targets(recordings.names)
    left_out = RejectedImages(recordings)
    table: list[Json] = []
    seconds: list[float] = []
    errors = LabelErrors(network.targets, recordings)
    for rows, names, answers, spent in _answers(recordings, network, frames, "unshear"):
        if answers.unsheared is None:
            raise UserError(
                f"{model} has no network that unshears: it learnt poses alone; use `jaxunshear pose`"
            )
        seconds.append(spent / BATCH)
        errors.add(rows, answers)
        for i, (row, name) in enumerate(zip(rows, names, strict=True)):
            why = left_out.add(name, answers.rejection[i])
            if why:  # a picture that is there would pass for its answer
                (out / targets[row]).unlink(missing_ok=True)
            else:
                write_bytes(out / targets[row], encode_png(to_uint8(answers.unsheared[i])))
            image = {"name": name, "image": "" if why else targets[row]}
            poses = {
                quantity: _format_cell(values[i])
                for quantity, values in answers.poses.get("unsheared", {}).items()
            }
            table.append(image | poses | _format_labels(recordings, row) | {"left_out": why})
    write_text(out / "poses.csv", format_csv(table))
    notes = list(recordings.notes)
    if not network.targets:
        notes.append(f"{model} has no trained PoseNet: poses.csv holds no predicted poses")
    note, frame = (
        learnt_note(experiment),
        OWN_FRAME if isinstance(experiment.paired, Recorded) else FRAMES,
    )
    write_text(out / "NOTE.txt", "\n".join([note, frame, f"Networks: {model.name}", *notes]) + "\n")
    used = len(table) - left_out.count
    print(f"{used} images unsheared, {len(recordings) - used} left out; see {out / 'poses.csv'}")
    left_out.report(print)
    errors.report(print)
    _print_summary([*notes, note], print)
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
    """Prints, as CSV, the pose that PoseNet reads from every image at `path`, as it was recorded and unsheared.

    Notes and errors against the labels go to stderr, so that the CSV can be piped on. Returns the same as rows. Raises as
    `unshear_recordings`.
    """
    model = find_model_folder(model)
    experiment = _settings_for(path, model)
    network = _perceiver(model, experiment, True, like or path)
    if not network.targets:
        raise UserError(
            f"{model / 'posenet'} holds no trained model (no checkpoints): train first, or name another folder"
        )
    recordings, network, frames = _read(path, network, force)
    left_out = RejectedImages(recordings)
    table: list[Json] = []
    measured: list[Measurement] = []
    errors = LabelErrors(network.targets, recordings)
    for rows, names, answers, _ in _answers(recordings, network, frames, "pose"):
        errors.add(rows, answers)
        for i, (row, name) in enumerate(zip(rows, names, strict=True)):
            line: Json = {"name": name}
            why = left_out.add(name, answers.rejection[i])
            for way, poses in answers.poses.items():
                for quantity, values in poses.items():
                    line[f"{way}_{quantity}"] = _format_cell(values[i])
                    if not why:
                        unit = quantity.split("_")[-1]
                        measured.append(
                            make_row(f"{name}.{way}.{quantity}", float(values[i]), unit)
                        )
            table.append(line | _format_labels(recordings, row) | {"left_out": why})
    print(format_csv(table).rstrip("\n"))
    note = partial(print, file=sys.stderr)
    used = len(table) - left_out.count
    note(f"poses of {used} images, {len(recordings) - used} left out")
    left_out.report(note)
    errors.report(note)
    _print_summary([*recordings.notes, learnt_note(experiment)], note)
    return _add_provenance([*measured, *count_rows("pose", used, recordings), *errors.rows()])


def _perceiver(model: Path, experiment: Experiment, recorded_too: bool, like: Path) -> "Perceiver":
    from jaxunshear.inference.perceiver import find_pin_frame, load_perceiver

    return load_perceiver(model, experiment, recorded_too, find_pin_frame(like, experiment))


def _settings_for(path: Path, model: Path) -> Experiment:
    if not path.exists():
        raise UserError(f"{path} does not exist: name an image or a folder of recordings")
    return load_settings(model)


def _read(path: Path, network: "Perceiver", force: bool) -> "tuple[Recordings, Perceiver, Frames]":
    from jaxunshear.data.recordings import read_recordings
    from jaxunshear.inference.frames import open_frames

    recordings = read_recordings(path, network.preprocess)
    return recordings, *open_frames(recordings, network, force)


def _targets(names: tuple[str, ...]) -> list[str]:
    """Where each image goes: its own name as PNG; `a.jpg` beside `a.png` keeps its full name."""
    targets: list[str] = []
    taken: set[str] = set()
    for name in names:
        target = str(PurePosixPath(name).with_suffix(".png"))
        target = f"{name}.png" if target in taken else target
        taken.add(target)
        targets.append(target)
    return targets


def _answers(
    recordings: "Recordings", network: "Perceiver", frames: "Frames", label: str
) -> "Iterator[tuple[list[int], list[str], Predictions, float]]":
    """Batches of rows, names and answers, and the seconds the networks took for the full BATCH, compilation apart."""
    size = recordings.preprocess.size
    network.predict(np.zeros((BATCH, size, size), np.uint8))
    with Progress(label, len(recordings)) as progress:
        seen = 0
        while batch := list(islice(frames, BATCH)):
            rows, names, images = zip(*batch, strict=True)
            padded = np.zeros((BATCH, size, size), np.uint8)  # one shape to compile
            padded[: len(images)] = images
            start = time.perf_counter()
            answers = network.predict(padded)
            yield list(rows), list(names), answers, time.perf_counter() - start
            progress.advance(rows[-1] + 1 - seen)
            seen = rows[-1] + 1
        progress.advance(len(recordings) - seen)  # left out at the end


def _format_labels(recordings: "Recordings", row: int) -> dict[str, str]:
    """The labels that came with an image; empty cells where this one has none."""
    cells = {}
    for kind, values in (("pose", recordings.poses), ("move", recordings.moves)):
        if values is not None:
            for label, value in zip(LABELS, values[row], strict=True):
                cells[f"recorded_{kind}_{label}"] = f"{value:.6g}" if np.isfinite(value) else ""
    return cells


def _format_cell(value: float) -> str:
    return f"{value:.4f}" if np.isfinite(value) else ""


def _print_summary(notes: list[str], log: Log) -> None:
    for note in (*notes[:9], *notes[9:][-1:]):
        log(f"note: {note}")
    if len(notes) > 10:
        log(f"note: and {len(notes) - 10} more")


def _add_provenance(rows: list[Measurement]) -> Measured:
    from jaxunshear.code_version import read_source
    from jaxunshear.metrics.machine import describe_machine, list_versions

    return Measured(rows, describe_machine(), list_versions(), read_source())
