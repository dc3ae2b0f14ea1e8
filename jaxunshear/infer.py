"""A finished run at work on recordings: unshears them and tells their poses. Imports JAX only once the paths are known good.

>>> unshear_recordings(Path("recordings/edge"), Path("runs/demo"), Path("unsheared"))
"""

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxunshear.config import from_json
from jaxunshear.errors import UserError
from jaxunshear.experiment import Experiment
from jaxunshear.image.png import eight_bit, png
from jaxunshear.progress import Progress
from jaxunshear.storage import check_beside, csv_text, read_json, write_bytes, write_text

if TYPE_CHECKING:
    from jaxunshear.dataset.recordings import Recordings

BATCH = 32
LABELS = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")
SIMULATION_ONLY = (
    "These networks have seen simulated touches only. On real recordings their images and poses are untested: "
    "take them for a first look, not for measurements."
)
FRAMES = (
    "x_mm and yaw_deg are relative to the simulated stimulus' target point, edge_mm (negative inside) and edge_deg "
    "tell the nearest edge in the sensor frame; recorded_* are the labels that came with the images, in their own work frame."
)

RELEASED = Path(__file__).parent / "weights"  # a folder for each name, with a model card

Log = Callable[[str], None]


class Answers(NamedTuple):
    """Of one batch: `unsheared` (B, S, S) in [0, 1], and poses by quantity, each (B,), of the image as it is and unsheared."""

    unsheared: np.ndarray
    as_recorded: dict[str, np.ndarray]
    after: dict[str, np.ndarray]


def unshear_recordings(path: Path, model: Path, out: Path, log: Log = print) -> dict[str, Any]:
    """Writes every image at `path`, unsheared, to `out` as a grey PNG under its own name, then `poses.csv` and `NOTE.txt`.

    Returns what was measured, as rows; the time per image is that of a batch of BATCH, blanks that fill it up included, over BATCH.
    Raises `UserError` where the model or every image cannot be read, or where `out` lies among the recordings.
    """
    model = model_folder(model)
    experiment = _settings_for(path, model)
    check_beside(path, out, "--out")
    recordings = _read(path, experiment)
    network = load_networks(model, pose_needed=False)
    targets = _targets(recordings.names)
    table: list[dict[str, Any]] = []
    seconds: list[float] = []
    for rows, names, answers, spent in _answers(recordings, network, "unshear"):
        seconds.append(spent / BATCH)
        for i, (row, name) in enumerate(zip(rows, names, strict=True)):
            write_bytes(out / targets[row], png(eight_bit(answers.unsheared[i])))
            poses = {quantity: f"{values[i]:.4f}" for quantity, values in answers.after.items()}
            table.append({"name": name, "image": targets[row]} | poses | _recorded(recordings, row))
    write_text(out / "poses.csv", csv_text(table))
    notes = list(recordings.notes)
    if not answers.after:
        notes.append(f"{model} has no trained PoseNet: poses.csv holds no predicted poses")
    write_text(out / "NOTE.txt", "\n".join([SIMULATION_ONLY, FRAMES, f"Networks: {model.name}", *notes]) + "\n")
    log(f"{len(table)} images unsheared, {len(recordings) - len(table)} left out; see {out / 'poses.csv'}")
    _tell(notes, log)
    return _measured(
        [
            _row("unshear.images", len(table), "1"),
            _row("unshear.left_out", len(recordings) - len(table), "1"),
            _row("unshear.time_per_image", float(np.median(seconds)), "s"),
        ]
    )


def pose_of_recordings(path: Path, model: Path, log: Log = print, note: Log | None = None) -> dict[str, Any]:
    """Logs, as CSV, the pose that PoseNet reads from every image at `path`, as it was recorded and unsheared.

    Notes go to `note` (stderr), so that the CSV can be piped on. Returns the same as rows. Raises as `unshear_recordings`.
    """
    model = model_folder(model)
    experiment = _settings_for(path, model)
    recordings = _read(path, experiment)
    network = load_networks(model, pose_needed=True)
    table: list[dict[str, Any]] = []
    rows_out: list[dict[str, Any]] = []
    for rows, names, answers, _ in _answers(recordings, network, "pose"):
        for i, (row, name) in enumerate(zip(rows, names, strict=True)):
            line: dict[str, Any] = {"name": name}
            for kind, poses in (("as_recorded", answers.as_recorded), ("unsheared", answers.after)):
                for quantity, values in poses.items():
                    line[f"{kind}_{quantity}"] = f"{values[i]:.4f}"
                    unit = quantity.split("_")[-1]
                    rows_out.append(_row(f"{name}.{kind}.{quantity}", float(values[i]), unit))
            table.append(line | _recorded(recordings, row))
    log(csv_text(table).rstrip("\n"))
    _tell(recordings.notes, note or (lambda text: print(text, file=sys.stderr)))
    return _measured(rows_out)


def model_folder(model: Path) -> Path:
    """`model` itself where it is a folder, else that of the released weights of this name. Raises `UserError`."""
    released = {folder.name: folder for folder in sorted(RELEASED.glob("*")) if (folder / "experiment.json").is_file()}
    if model.exists() or str(model) not in released:
        return model
    return released[str(model)]


def load_settings(model: Path) -> Experiment:
    """The experiment that the folder of a run was made with. Raises `UserError`."""
    file = model / "experiment.json"
    if not file.is_file():
        names = ", ".join(sorted(folder.name for folder in RELEASED.glob("*") if folder.is_dir()))
        raise UserError(
            f"--model {model} holds no experiment.json: name the folder of a finished run, such as runs/demo, "
            f"or released weights{f' ({names})' if names else ''}"
        )
    return from_json(read_json(file), str(file))


def load_networks(model: Path, pose_needed: bool) -> Callable[[np.ndarray], Answers]:
    """A function of images (B, S, S) uint8 of {0, 255}.

    Without a trained PoseNet the answers hold no poses; where `pose_needed` that is a `UserError`, as are damaged files. The
    poses of images as they were recorded are read only where `pose_needed`.
    """
    import jax

    from jaxunshear.memory import keep_freed_memory
    from jaxunshear.model import posenet, unshearnet
    from jaxunshear.model.ready import ready
    from jaxunshear.training.checkpoint import check_finished, holds_model, load_best, read_net, read_targets

    keep_freed_memory()
    wanted = ["disentangled"]
    if pose_needed or holds_model(model / "posenet"):
        wanted.append("posenet")
    for name in wanted:
        check_finished(model / name)
    nets: dict[str, Any] = {name: read_net(model / name) for name in wanted}
    variables = {name: load_best(model / name) for name in wanted}
    targets = read_targets(model / "posenet") if "posenet" in nets else ()

    def look(variables: dict[str, Any], images: jax.Array) -> tuple[jax.Array, dict[str, Any], dict[str, Any]]:
        recorded = images[..., None].astype(np.float32) / 255
        after = unshearnet.unshear(nets["disentangled"], variables["disentangled"], recorded)

        def pose(image: jax.Array) -> dict[str, Any]:
            return posenet.pose_from_outputs(posenet.predict(nets["posenet"], variables["posenet"], image), targets)

        return after[..., 0], pose(recorded) if pose_needed else {}, pose(after) if "posenet" in nets else {}

    run = ready(look, variables)
    return lambda images: Answers(*jax.device_get(run(images)))


def _settings_for(path: Path, model: Path) -> Experiment:
    if not path.exists():
        raise UserError(f"{path} does not exist: name an image or a folder of recordings")
    return load_settings(model)


def _read(path: Path, experiment: Experiment) -> "Recordings":
    from jaxunshear.dataset.recordings import read_recordings

    return read_recordings(path, experiment.paired.preprocess)


def _targets(names: tuple[str, ...]) -> list[str]:
    """Where each image goes: its own name as PNG; `a.jpg` beside `a.png` keeps its whole name."""
    targets: list[str] = []
    taken: set[str] = set()
    for name in names:
        target = str(PurePosixPath(name).with_suffix(".png"))
        target = f"{name}.png" if target in taken else target
        taken.add(target)
        targets.append(target)
    return targets


def _answers(
    recordings: "Recordings", network: Callable[[np.ndarray], Answers], label: str
) -> Iterator[tuple[list[int], list[str], Answers, float]]:
    """Batches of rows, names and answers, and the seconds the networks took for the whole BATCH, compilation apart."""
    size = recordings.preprocess.size
    network(np.zeros((BATCH, size, size), np.uint8))
    with Progress(label, len(recordings)) as progress:
        seen = 0
        for batch in _batches(recordings.frames()):
            rows, names, images = zip(*batch, strict=True)
            padded = np.zeros((BATCH, size, size), np.uint8)  # one shape to compile
            padded[: len(images)] = images
            start = time.perf_counter()
            answers = network(padded)
            yield list(rows), list(names), answers, time.perf_counter() - start
            progress.advance(rows[-1] + 1 - seen)
            seen = rows[-1] + 1
        progress.advance(len(recordings) - seen)  # left out at the end


def _batches(frames: Iterator[Any]) -> Iterator[list[Any]]:
    batch: list[Any] = []
    for frame in frames:
        batch.append(frame)
        if len(batch) == BATCH:
            yield batch
            batch = []
    if batch:
        yield batch


def _recorded(recordings: "Recordings", row: int) -> dict[str, str]:
    """The labels that came with an image; empty cells where this one has none."""
    cells = {}
    for kind, values in (("pose", recordings.poses), ("move", recordings.moves)):
        if values is not None:
            for label, value in zip(LABELS, values[row], strict=True):
                cells[f"recorded_{kind}_{label}"] = f"{value:.6g}" if np.isfinite(value) else ""
    return cells


def _tell(notes: list[str], log: Log) -> None:
    for note in notes[:10]:
        log(f"note: {note}")
    if len(notes) > 10:
        log(f"note: and {len(notes) - 10} more")
    log(f"note: {SIMULATION_ONLY}")


def _row(name: str, value: float, unit: str) -> dict[str, Any]:
    return {
        "name": name,
        "value": value,
        "unit": unit,
        "bar": None,
        "sense": None,
        "ok": None,
        "metric": name.split(".")[-1],
    }


def _measured(rows: list[dict[str, Any]]) -> dict[str, Any]:
    from jaxunshear.metrics.machine import machine, versions

    return {"rows": rows, "machine": machine(), "versions": versions()}
