"""Files in which one bit has turned over: refused by name, or read as before; never a wrong figure."""

import hashlib
import random
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from jaxunshear.api import load_model
from jaxunshear.config.configs import get_set_folder
from jaxunshear.config.data import PairedData, PoseData, Recorded
from jaxunshear.config.load import load_experiment
from jaxunshear.config.serialization import from_json
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import load_chunk
from jaxunshear.data.generation import make_set
from jaxunshear.data.reader import open_set
from jaxunshear.data.recordings import read_image
from jaxunshear.errors import UserError
from jaxunshear.files import read_json
from jaxunshear.report import montage
from jaxunshear.report.history import read_history
from jaxunshear.results.record_files import read_record
from jaxunshear.results.run import Results
from jaxunshear.results.times import read_times
from jaxunshear.serialization import to_builtins
from jaxunshear.training.checkpoint import load_best, read_net, read_targets
from tests.faults import shim
from tests.faults.outcome import Row, Size, attempt, commanded, digest
from tests.faults.places import TINY, Places, flipped

Act = Callable[[], object]


def rows(places: Places, size: Size, scratch: Path) -> Iterator[Row]:
    """A row for each kind of file and the command that reads it."""
    run = shutil.copytree(places.run, scratch / "tiny")
    shown = _read_by_report(run)
    yield _flip("results, images, logs", "report", shown, _report(run), size)
    yield _flip("results, images, logs", "report, its reading", shown, _inputs(run), size, 10)
    yield _flip("JSON of a run", "all that read it", _files(run, ".json"), _json(run), size, 10)
    networks = [file for file in run.rglob("*") if file.is_file() and file.parent != run]
    inputs = [file for file in networks if file.suffix != ".jsonl" and file.name != "summary.json"]
    yield _flip(
        "checkpoints",
        "release",
        [*inputs, run / "experiment.json"],
        _release(run, scratch / "out"),
        size,
    )
    yield _flip("checkpoints", "networks as all read them", inputs, _networks(run), size)
    weights = shutil.copytree(places.weights, scratch / "weights")
    yield _flip(
        "weights", "all that load a model", _files(weights, ".json", ".npz"), _model(weights), size
    )
    data = shutil.copytree(places.data, scratch / "datasets")
    tiny, pins = load_experiment(TINY), from_json(read_json(places.pins / "experiment.json"))
    for settings, experiment in ((tiny.paired, tiny), (pins.paired, pins)):
        folder = get_set_folder(settings, experiment.sensor, data)
        act = _set(settings, experiment, data)
        yield _flip(
            f"stored set {settings.set_name}",
            "run",
            [f for f in folder.iterdir() if f.is_file()],
            act,
            size,
        )
    yield _flip(
        "contacts made so far", "data", *_unfinished(tiny.pose, scratch / "unfinished"), size
    )
    images = shutil.copytree(places.frames, scratch / "few")
    yield _flip(
        "recorded PNG", "all that read images", _files(images, ".png"), _images(images), size
    )
    yield _cache(scratch / "cache", size)


def _flip(
    fault: str, command: str, files: Sequence[Path], act: Act, size: Size, times: int = 1
) -> Row:
    row = Row(f"a bit flipped: {fault}", command, size.seed)
    began, draw = time.monotonic(), random.Random(size.seed)
    right = act()
    names = tuple({name for file in files for name in (file.name, str(file.parent))})
    for _ in size.places(size.bits * times):
        file = draw.choice(files)
        before = file.read_bytes()
        bit = draw.randrange(8 * len(before))
        file.write_bytes(flipped(before, bit))
        attempt(row, act, right, f"{file.name}, bit {bit}", names)
        file.write_bytes(before)
    row.seconds = time.monotonic() - began
    return row


def _files(folder: Path, *suffixes: str) -> list[Path]:
    return sorted(file for file in folder.rglob("*") if file.suffix in suffixes)


def _read_by_report(run: Path) -> list[Path]:
    return [run / "results.json", run / "montage.npz", run / "times.json", *run.rglob("log.jsonl")]


def _report(run: Path) -> Act:
    """Pages, which are made of the same bytes each time."""

    def act() -> object:
        commanded("report", run)
        return digest([run / "report.html", run / "montage.png"])

    return act


def _inputs(run: Path) -> Act:
    """What a report is made of."""

    def act() -> object:
        logs = [read_history(file) for file in sorted(run.rglob("log.jsonl"))]
        results = read_record(run / "results.json", Results, "again")
        return str((logs, results, read_times(run))), bits(
            montage.read_montage(run / "montage.npz")
        )

    return act


def _json(run: Path) -> Act:
    def act() -> object:
        return {str(file): to_builtins(read_json(file)) for file in sorted(run.rglob("*.json"))}

    return act


def _release(run: Path, out: Path) -> Act:
    def act() -> object:
        shutil.rmtree(out, ignore_errors=True)
        commanded("release", run, "--out", out)
        return digest(_files(out, ".json", ".npz"))

    return act


def _networks(run: Path) -> Act:
    def act() -> object:
        folders = sorted(file.parent for file in run.rglob("model.json"))
        return [(bits(load_best(one)), read_net(one), read_targets(one)) for one in folders]

    return act


def bits(tree: object) -> str:
    found = hashlib.sha256()
    if isinstance(tree, dict):
        for name in sorted(tree):
            found.update(f"{name} {bits(tree[name])}".encode())
    else:
        array = np.asarray(tree)
        found.update(f"{array.dtype} {array.shape}".encode() + array.tobytes())
    return found.hexdigest()


def _model(weights: Path) -> Act:
    def act() -> object:
        model = load_model(weights)
        folders = sorted(file.parent for file in weights.rglob("model.json"))
        parts = [(bits(load_best(one)), read_net(one), read_targets(one)) for one in folders]
        return parts, to_builtins(read_json(weights / "experiment.json")), type(model)

    return act


def _set(settings: PairedData | Recorded, experiment: object, data: Path) -> Act:
    sensor = experiment.sensor  # type: ignore[attr-defined]

    def act() -> object:
        reader = open_set(settings, data, sensor)
        return [bits(reader.rows(split)) for split in SPLITS], to_builtins(reader.metadata)

    return act


def _unfinished(settings: PoseData, data: Path) -> tuple[list[Path], Act]:
    """A set whose contacts are made and whose shards are not: the disk was full."""
    shim.arm(data, 0)
    make_set(settings, data_dir=data)
    count = shim.seen()
    shutil.rmtree(data)
    shim.arm(data, count - 4, "ENOSPC")
    try:
        make_set(settings, data_dir=data)
    except UserError:
        pass
    finally:
        shim.disarm()
    files = sorted((data / ".partial").rglob("*.npz"))

    def act() -> object:
        return [bits(load_chunk(file)) for file in files]

    return files, act


def _images(folder: Path) -> Act:
    def act() -> object:
        found = []
        for file in _files(folder, ".png"):
            try:
                found.append(bits(read_image(file)))
            except UserError as error:
                raise UserError(
                    f"{file.name}: {error}"
                ) from None  # readers of folders add the name
        return found

    return act


def _cache(folder: Path, size: Size) -> Row:
    """The response of a coarse dome: made again where its file is damaged, so the same."""
    from jaxunshear.config.reach import set_ring_spacing
    from jaxunshear.config.sensor import TACTIP_127
    from jaxunshear.simulator.dome import load_dome

    coarse = set_ring_spacing(TACTIP_127, 3.0)
    with shim.environment("JAXUNSHEAR_CACHE", str(folder)):
        load_dome(coarse)
        files = sorted(folder.glob("dome-*.bin"))

        def act() -> object:
            return bits(vars(load_dome(coarse)))

        row = _flip("cache of the simulator", "all that simulate", files, act, size)
    return row
