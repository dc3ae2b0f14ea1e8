"""Run a trained model on recordings: unshear the images and predict their poses.

>>> unshear_recordings(Path("recordings/edge"), Path("runs/demo"), Path("unsheared"))
"""

import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, islice
from itertools import count as count_from
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from jaxunshear.code_version import read_source
from jaxunshear.config.targets import get_unit
from jaxunshear.data.labels import name_labels
from jaxunshear.data.recordings import RecordedFrame, Recordings, read_image, read_recordings
from jaxunshear.data.sensor_frame import read_frames
from jaxunshear.errors import UserError
from jaxunshear.files import Json, format_csv, write_bytes, write_text
from jaxunshear.inference.forward import BATCH, UNSHEARED
from jaxunshear.inference.trained_model import TrainedModel, load_model
from jaxunshear.metrics.errors import compute_pose_errors
from jaxunshear.output_checks import check_not_among
from jaxunshear.perception.drawing import encode_png, to_uint8
from jaxunshear.perception.lattice import check_pin_numbers
from jaxunshear.perception.preprocess import prepare_frame
from jaxunshear.perception.sensor_check import invert_image, judge_images
from jaxunshear.progress import Progress
from jaxunshear.results.measurement import Measured, Measurement
from jaxunshear.results.provenance import describe_machine, list_versions

LABELS = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")
SAMPLED_FRAMES = 20  # frames by which a folder is judged
SHOWN_NOTES = 10
MAX_NAME = 255  # bytes of a file's name

Log = Callable[[str], None]
Poses = Mapping[str, Mapping[str, float]]  # of one image, by kind of input and quantity


class _Result(NamedTuple):
    """The results for one image; NaN if it is rejected."""

    row: int  # of the recordings
    name: str
    reason: str  # why it is rejected; empty if it is not
    unsheared: np.ndarray | None  # (S, S) in [0, 1]
    poses: Poses
    touch: Mapping[str, float]  # by field of `Touch`


def unshear_recordings(
    path: Path,
    model_name: Path,
    out: Path,
    force: bool = False,
    like: Path | None = None,
    untouched: Path | None = None,
    without: Sequence[int] = (),
) -> Measured:
    """Unshear every image at `path`; write PNGs, `poses.csv` and `NOTE.txt` to `out`.

    An image that is rejected gets no PNG and no pose, but a row that says why. The time per image
    is that of a full batch over BATCH. Raises `UserError` if the model or every image cannot be
    read, if `out` lies among the recordings, or if the images are not of the model's sensor.

    Args:
        path: An image, or a folder of recordings.
        model_name: The folder of a finished run, or the name of released weights.
        out: The folder for the results.
        force: Use images that are not of the model's sensor.
        like: A folder of contacts of the same sensor and camera, if `path` holds too few to
            estimate the rest positions.
        untouched: Frames of the untouched dome, from which touch is measured.
        without: Pins that are lost.
    """
    check_not_among(path, out, "--out")
    model = _load_adapted_model(path, model_name, like, untouched, without)
    # of the images as they are only errors against labels are reported, which others cannot have
    model.with_sheared_poses = model.source.predicts_directly
    run = _FolderRun(path, model, force)
    notes, files = run.recordings.notes, _list_png_files(run.recordings.names)
    table: list[Json] = []
    for result in run.predict("unshear"):
        image = _write_image(result, out / files[result.row], model)
        cells: Json = {"name": result.name, "image": files[result.row] if image else ""}
        cells |= _format_poses(result.poses.get(UNSHEARED, {})) | _format_poses(result.touch)
        table.append(cells | run.format_labels(result))
    if not model.targets:
        notes.append(f"{model.folder} has no trained PoseNet: poses.csv holds no predicted poses")
    source = model.source
    lines = [source.describe(), source.pose_frame, f"Networks: {model.folder.name}", *notes]
    write_text(out / "poses.csv", format_csv(table))
    write_text(out / "NOTE.txt", "\n".join(lines) + "\n")
    print(
        f"{run.used_count} images unsheared, {run.left_out_count} left out; see {out / 'poses.csv'}"
    )
    time_row = _make_row("unshear.time_per_image", float(np.median(run.seconds)), "s")
    return run.report("unshear", [time_row], print)


def _load_adapted_model(
    path: Path, name: Path, like: Path | None, untouched: Path | None, without: Sequence[int]
) -> TrainedModel:
    if not path.exists():
        raise UserError(f"{path} does not exist: name an image or a folder of recordings")
    model = load_model(name, like or path)
    adapt_to_dome(model, untouched, without)
    return model


def adapt_to_dome(
    model: TrainedModel, untouched: Path | None = None, without: Sequence[int] = ()
) -> None:
    """Leave lost pins out of a model's frames, and learn where pins stand untouched.

    Raises UserError.
    """
    if without:
        if model.frame is None:
            raise UserError(
                f"--without: {model.folder} does not know the pins of these frames: leave it out, "
                "or name a --model over pins, such as skin"
            )
        check_pin_numbers(without, len(model.frame.rest))
        model.frame = model.frame._replace(lost=tuple(sorted(set(without))))
    if untouched is not None:
        model.learn_rest_positions(read_frames(untouched, model.preprocess, model.view))


def _write_image(result: _Result, file: Path, model: TrainedModel) -> bool:
    """Write the image of a result that is not rejected; say whether there is one."""
    if result.unsheared is None:
        raise UserError(
            f"{model.folder} has no network that unshears: it learnt poses alone; "
            "use `jaxunshear pose`"
        )
    if result.reason:  # an image of an earlier run would appear to be the result
        file.unlink(missing_ok=True)
    else:
        write_bytes(file, encode_png(to_uint8(result.unsheared)))
    return not result.reason


def predict_recordings(
    path: Path,
    model_name: Path,
    force: bool = False,
    like: Path | None = None,
    untouched: Path | None = None,
    without: Sequence[int] = (),
) -> Measured:
    """Print the predicted poses of every image at `path`, as recorded and unsheared.

    They are printed as CSV. Notes and errors against the labels go to stderr, so that the CSV can
    be piped. Arguments and exceptions are those of `unshear_recordings`.
    """
    model = _load_adapted_model(path, model_name, like, untouched, without)
    if not model.targets:
        raise UserError(
            f"{model.folder / 'posenet'} holds no trained model (no checkpoints): "
            "train first, or name another folder"
        )
    run = _FolderRun(path, model, force)
    table: list[Json] = []
    rows: list[Measurement] = []
    for result in run.predict("pose"):
        cells: Json = {"name": result.name}
        for kind, pose in result.poses.items():
            cells |= _format_poses(pose, f"{kind}_")
            if not result.reason:
                rows += [
                    _make_row(f"{result.name}.{kind}.{name}", value, get_unit(name))
                    for name, value in pose.items()
                ]
        cells |= _format_poses(result.touch)
        table.append(cells | run.format_labels(result))
    print(format_csv(table).rstrip("\n"))
    log = partial(print, file=sys.stderr)
    log(f"poses of {run.used_count} images, {run.left_out_count} left out")
    return run.report("pose", rows, log)


class _FolderRun:
    """Runs a model on the readable images of a folder, and counts what becomes of them.

    Negatives are inverted. Raises UserError at once if hardly any image is of the model's sensor.
    With `force` all images are used as they are, except those without pins for pin networks.
    """

    def __init__(self, path: Path, model: TrainedModel, force: bool) -> None:
        self._targets = model.targets  # loads the networks before there is work to lose
        self.recordings = read_recordings(path, model.preprocess)
        self.model = model
        self.seconds: list[float] = []  # per image, of each batch
        self._is_negative = False
        self._reasons: Counter[str] = Counter()
        self._rows: list[int] = []
        self._poses: list[Poses] = []
        if force:
            model.force = True
            return
        verdict = judge_images(_sample_images(self.recordings, model), model.appearance)
        if verdict.inverted:
            self.recordings.notes.append(f"{verdict.reason}: they are turned")
            # inverted dark pins are less like the sensor's than light pins
            model.force = True
            self._is_negative = True
        elif not verdict.ok:
            raise UserError(f"{path}: {verdict.reason}; --force answers all the same")

    @property
    def used_count(self) -> int:
        return len(self._rows) - self._reasons.total()

    @property
    def left_out_count(self) -> int:
        return len(self.recordings) - self.used_count

    def predict(self, label: str) -> Iterator[_Result]:
        count = len(self.recordings)
        self.model.compile(BATCH)
        frames = self.recordings.iterate_frames(self.model.view)
        with Progress(label, count) as progress:
            done = 0
            while batch := list(islice(frames, BATCH)):
                yield from self._predict_batch(batch)
                progress.advance(batch[-1].row + 1 - done)
                done = batch[-1].row + 1
            progress.advance(count - done)  # images at the end that cannot be read

    def _predict_batch(self, batch: list[RecordedFrame]) -> Iterator[_Result]:
        images = np.zeros((BATCH, self.model.size, self.model.size), np.uint8)  # one shape
        images[: len(batch)] = [
            invert_image(frame.image) if self._is_negative else frame.image for frame in batch
        ]
        start = time.perf_counter()
        predictions = self.model.predict(images)
        touches = predictions.touch._asdict()
        self.seconds.append((time.perf_counter() - start) / BATCH)
        for i, frame in enumerate(batch):
            reason = str(predictions.rejection[i])
            if reason:
                self._reasons[reason] += 1
                self.recordings.notes.append(f"left out {frame.name}: {reason}")
            poses = {}
            for kind, quantities in predictions.poses.items():
                poses[kind] = {name: float(values[i]) for name, values in quantities.items()}
            self._rows.append(frame.row)
            self._poses.append(poses)
            unsheared = predictions.unsheared
            image = None if unsheared is None else unsheared[i]
            touch = {name: float(values[i]) for name, values in touches.items()}
            yield _Result(frame.row, frame.name, reason, image, poses, touch)

    def format_labels(self, result: _Result) -> dict[str, str]:
        """Format the labels of an image, empty if it has none, and why it is left out."""
        cells = {}
        for kind, values in (("pose", self.recordings.poses), ("move", self.recordings.moves)):
            if values is not None:
                for label, value in zip(LABELS, values[result.row], strict=True):
                    cells[f"recorded_{kind}_{label}"] = f"{value:.6g}" if np.isfinite(value) else ""
        return cells | {"left_out": result.reason}

    def report(self, command: str, rows: list[Measurement], log: Log) -> Measured:
        """Log counts, errors and notes; return the rows, with rows of counts and errors."""
        for reason, count in self._reasons.items():
            log(f"left out {count}: {reason}")
        counts = {"images": self.used_count, "left_out": self.left_out_count}
        rows = [*rows, *(_make_row(f"{command}.{name}", n, "1") for name, n in counts.items())]
        for kind, errors in self._compute_label_errors().items():
            parts = [f"{name} {value:.3f}" for name, value in errors.items()]
            log(f"mean error against the labels, {kind}: {', '.join(parts)}")
            for name, value in errors.items():
                rows.append(_make_row(f"pose_mae.{kind}.{name}", value, get_unit(name)))
        notes = [*self.recordings.notes, self.model.source.describe()]
        for note in (*notes[: SHOWN_NOTES - 1], *notes[SHOWN_NOTES - 1 :][-1:]):
            log(f"note: {note}")
        if len(notes) > SHOWN_NOTES:
            log(f"note: and {len(notes) - SHOWN_NOTES} more")
        return Measured(rows, describe_machine(), list_versions(), read_source())

    def _compute_label_errors(self) -> Poses:
        """Compute mean errors by kind and quantity, if all quantities of poses have labels."""
        recorded = self.recordings
        labels = name_labels(recorded.poses, recorded.moves, recorded.others)
        if not self._poses or not labels.keys() >= {*self._targets}:
            return {}
        true = {name: labels[name][self._rows] for name in self._targets}
        means: dict[str, dict[str, float]] = {}
        for kind in self._poses[0]:
            predicted = {}
            for name in self._targets:
                predicted[name] = np.array([poses[kind][name] for poses in self._poses])
            for name, errors in compute_pose_errors(predicted, true).items():
                finite = errors[np.isfinite(errors)]
                if len(finite):
                    means.setdefault(kind, {})[name] = float(finite.mean(dtype=np.float64))
        return means


def _sample_images(recordings: Recordings, model: TrainedModel) -> np.ndarray:
    """Read (N, S, S) from up to SAMPLED_FRAMES files, evenly spaced."""
    files, problem, images = recordings.files, "", []
    for file in files[:: -(-len(files) // SAMPLED_FRAMES)]:
        view = model.view or recordings.find_common_view(file.parent)
        try:
            images.append(prepare_frame(model.preprocess, read_image(file), view))
        except UserError as error:
            problem = f"{file.name}: {error}"
    if not images:
        raise UserError(
            f"none of the sampled images in {recordings.path} can be read; the last: {problem}"
        )
    return np.stack(images)


def _list_png_files(names: tuple[str, ...]) -> list[str]:
    """List the PNG file of each image, its own on file systems that know no capitals, too.

    A PNG keeps its name; another image of its stem, but for capitals, is called as
    `image_1.jpg.png`, or, where that is too long, by a number.
    """
    files, taken = [""] * len(names), set[str]()
    for row in sorted(range(len(names)), key=lambda row: not names[row].endswith(".png")):
        name = PurePosixPath(names[row])
        ways = name.with_suffix(".png"), name.with_name(f"{name.name}.png")
        for way in chain(ways, (name.with_name(f"{number}.png") for number in count_from(row))):
            files[row] = str(way)
            if len(os.fsencode(way.name)) <= MAX_NAME and files[row].casefold() not in taken:
                break
        taken.add(files[row].casefold())
    return files


def _make_row(name: str, value: float, unit: str) -> Measurement:
    return Measurement(name, value, unit, None, None, None, name.split(".")[-1])


def _format_poses(poses: Mapping[str, float], prefix: str = "") -> dict[str, str]:
    return {
        f"{prefix}{quantity}": f"{value:.4f}" if np.isfinite(value) else ""
        for quantity, value in poses.items()
    }
