"""Training logs as TensorBoard's event files: log.jsonl is read, also while it grows, and nothing of a run is written.

DIR/<run>/<network>/   losses, validation figures, learning rate and images a second, by step
DIR/<run>/             settings as text, the montage once there is one

Steps are never there twice: what this module wrote before is deleted and written anew, also where a log no longer begins as it did.
"""

import contextlib
import io
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from PIL import Image

from jaxunshear.errors import UserError
from jaxunshear.folders import names_apart
from jaxunshear.report import montage
from jaxunshear.report.history import read_lines
from jaxunshear.results.run import EVALUATED, Results
from jaxunshear.results.stored import read
from jaxunshear.settings.registry import TRAINABLE
from jaxunshear.settings.stored import build
from jaxunshear.settings.training import Training
from jaxunshear.storage import Json, os_error, read_object, read_object_if_sound
from jaxunshear.training.step import learning_rate

EXTRA = "pip install 'jaxunshear[tensorboard]'"
OURS = ".jaxunshear"  # how the names of our files end
GROUPS = ("train", "validation", "kernels")  # of a line of log.jsonl
Line = Json


def write_events(folders: Sequence[Path], out: Path, follow: Callable[[], object] | None) -> None:
    """Writes the logs of runs, and of all rows of sweeps, below `out`; with `follow`, which waits a while, until all of them are
    evaluated.

    Raises UserError where tensorboardX is not installed, or a folder is of no run.
    """
    writer_of = _writer()
    for folder in folders:
        _check(folder)
    streams: dict[Path, _Stream] = {}
    with contextlib.ExitStack() as stack:
        while True:
            done = all(map(_is_finished, folders))  # asked first: what ends while we read is read once more
            for source, target in _places(folders, out):
                if source not in streams and (is_run(source) or (source / "log.jsonl").is_file()):
                    streams[source] = _Stream(source, target, writer_of)
                    stack.callback(streams[source].close)
                if source in streams:
                    streams[source].update()
            if done or follow is None:
                break
            follow()
    logs = [len(stream.lines) for source, stream in streams.items() if not is_run(source)]
    print(f"{sum(logs)} validations of {len(logs)} networks: {out}")


def is_run(folder: Path) -> bool:
    return (folder / "experiment.json").is_file()


def _writer() -> Any:
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise UserError(f"event files need tensorboardX: {EXTRA}") from None
    return SummaryWriter


def _check(folder: Path) -> None:
    if not is_run(folder) and not (folder / "rows").is_dir():
        raise UserError(f"{folder} is no run and no sweep: name a folder such as runs/demo or runs/sweeps/frontier")


def _rows(folder: Path) -> list[Path]:
    """Of a sweep, those that have started; of a run, itself."""
    return [folder] if is_run(folder) else sorted(path for path in (folder / "rows").glob("*/") if is_run(path))


def _is_finished(folder: Path) -> bool:
    rows = [folder] if is_run(folder) else list((folder / "rows").glob("*/"))
    return all((row / "results.json").is_file() or (row / "row.json").is_file() for row in rows)


def _places(folders: Sequence[Path], out: Path) -> Iterator[tuple[Path, Path]]:
    """Folders of runs and of their networks, each with that of its event file."""
    for folder, name in zip(folders, names_apart(folders), strict=True):
        for row in _rows(folder):
            target = out / name if row == folder else out / name / row.name
            yield row, target
            for network in TRAINABLE:
                yield row / network, target / network


class _Stream:
    """One event file, and what of its source is in it."""

    def __init__(self, source: Path, target: Path, writer_of: Any) -> None:
        self.source, self.target, self.writer_of = source, target, writer_of
        self.lines: list[Line] = []
        self.writer: Any = None
        self.began = 0.0  # seconds since 1970
        self.shown = False  # the montage

    def update(self) -> None:
        """What the source has more than the file."""
        if is_run(self.source):
            self._update_run()
            return
        lines = read_lines(self.source / "log.jsonl")
        if self.writer is None or lines[: len(self.lines)] != self.lines:
            self._begin()
        if lines == self.lines:
            return
        before = self.lines[-1] if self.lines else {"images": 0, "train_seconds": 0.0}
        rates = _rates(self.source, lines)
        for index, line in enumerate(lines[len(self.lines) :], len(self.lines)):
            seconds = line["train_seconds"] - before["train_seconds"]
            more = {"images_per_second": (line["images"] - before["images"]) / seconds} if seconds > 0 else {}
            for name, value in (scalars(line) | more | ({"learning_rate": rates[index]} if rates else {})).items():
                self.writer.add_scalar(name, value, line["step"], self.began + line["train_seconds"])
            before = line
        self.lines = lines
        self.writer.flush()

    def close(self) -> None:
        if self.writer is not None:
            self.writer.close()

    def _update_run(self) -> None:
        if not self.lines:
            self._begin()
            self.lines = [read_object(self.source / "experiment.json")]
            self.writer.add_text("settings", _table(self.lines[0]), 0, self.began)
        if not self.shown and (image := _montage(self.source)) is not None:
            self.writer.add_image("montage", image, 0, self.began, dataformats="HWC")
            self.shown = True
        self.writer.flush()

    def _begin(self) -> None:
        """A new file in the place of all that we wrote there; a TensorBoard that is open drops what it read of those."""
        self.close()
        self.lines = []
        mark = self.source / ("experiment.json" if is_run(self.source) else "model.json")
        try:
            self.target.mkdir(parents=True, exist_ok=True)
            for path in self.target.glob(f"events.out.tfevents.*{OURS}"):
                path.unlink()
            self.began = mark.stat().st_mtime if mark.exists() else 0.0
            self.writer = self.writer_of(str(self.target), purge_step=0, filename_suffix=OURS)
        except OSError as error:
            raise os_error(self.target, error) from error


def scalars(line: Line) -> dict[str, float]:
    """The figures of a line of log.jsonl by tag, those that are known."""
    return {
        f"{group}/{name}": float(value)
        for group in GROUPS
        for name, value in (line.get(group) or {}).items()
        if isinstance(value, int | float)
    }


def _rates(source: Path, lines: Sequence[Line]) -> list[float]:
    """The learning rate of each line's step; none where the network's model.json is of another version."""
    model = read_object_if_sound(source / "model.json") or {}
    try:
        training = build(model["training"], Training, str(source / "model.json"), "training")
        an_epoch = model["epoch_images"] / training.batch
    except (UserError, KeyError):
        return []
    steps = np.array([line["step"] for line in lines])
    rate = learning_rate(training, max(1, round(training.epochs * an_epoch)), an_epoch)
    return np.broadcast_to(np.asarray(rate(jnp.asarray(steps - 1))), steps.shape).tolist()


def _table(settings: Json) -> str:
    """Settings by dotted name, as Markdown."""

    def flat(tree: Json, prefix: str) -> Iterator[str]:
        for name, value in tree.items():
            if isinstance(value, dict):
                yield from flat(value, f"{prefix}{name}.")
            else:
                yield f"| {prefix}{name} | {value} |"

    return "\n".join(["| setting | value |", "|---|---|", *flat(settings, "")])


def _montage(folder: Path) -> np.ndarray | None:
    """(H, W, 3) uint8; None where there is none yet, or none at all."""
    if not all((folder / name).is_file() for name in ("results.json", "montage.npz")):
        return None
    results = read(folder / "results.json", Results, EVALUATED)
    png = montage.drawing(montage.read(folder / "montage.npz"), results)
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))
