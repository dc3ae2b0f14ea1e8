"""Files in which one bit has flipped: refused by name, or read as before; never a wrong figure."""

import contextlib
import random
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from benchmarks.bench_sim import set_ring_spacing
from jaxunshear.api import load_model
from jaxunshear.config.configs import get_set_folder
from jaxunshear.config.data import PairedData, PoseData, Recorded
from jaxunshear.config.load import load_experiment
from jaxunshear.config.sensor import TACTIP_127, Sensor
from jaxunshear.config.serialization import from_json
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import load_chunk
from jaxunshear.data.recordings import read_image
from jaxunshear.data.stored_sets import make_set, open_set
from jaxunshear.errors import UserError
from jaxunshear.files import read_json, to_builtins
from jaxunshear.report import montage
from jaxunshear.report.training_sections import read_history
from jaxunshear.results.record_files import read_record, read_times
from jaxunshear.results.run import Results
from jaxunshear.simulator.dome import load_dome
from jaxunshear.training.checkpoint import load_best, read_net, read_targets
from tests.faults import shim
from tests.faults.outcome import (
    Outcome,
    Row,
    Size,
    compute_array_digest,
    compute_digest,
    flip_bit,
    judge_reading,
    run_cases,
    run_command,
)
from tests.faults.places import TINY, Places

Read = Callable[[], object]


def list_rows(places: Places, size: Size, scratch: Path) -> Iterator[Row]:
    """Yield a row for each kind of file and the command that reads it."""

    def flip(fault: str, command: str, files: Sequence[Path], read: Read, times: int = 1) -> Row:
        return _flip(Row(f"a bit flipped: {fault}", command, size.seed), files, read, size, times)

    run = shutil.copytree(places.run, scratch / "tiny")
    shown = [run / "results.json", run / "montage.npz", run / "times.json"]
    shown += run.rglob("log.jsonl")
    kind = "results, images, logs"
    yield flip(kind, "report", shown, lambda: _make_report(run))
    yield flip(kind, "report, its reading", shown, lambda: _read_report_inputs(run), 10)
    records = _list_files(run, ".json")
    yield flip("JSON of a run", "all that read it", records, lambda: _read_json(records), 10)
    networks = [file for file in run.rglob("*") if file.is_file() and file.parent != run]
    inputs = [file for file in networks if file.suffix != ".jsonl" and file.name != "summary.json"]
    released = [*inputs, run / "experiment.json"]
    yield flip("checkpoints", "release", released, lambda: _release(run, scratch / "out"))
    yield flip("checkpoints", "networks as all read them", inputs, lambda: _read_networks(run))
    weights = shutil.copytree(places.weights, scratch / "weights")
    files = _list_files(weights, ".json", ".npz")
    yield flip("weights", "all that load a model", files, lambda: _load_weights(weights))
    data = shutil.copytree(places.data, scratch / "datasets")
    tiny, pins = load_experiment(TINY), from_json(read_json(places.pins / "experiment.json"))
    for experiment in (tiny, pins):
        folder = get_set_folder(experiment.paired, experiment.sensor, data)
        read = _make_set_reader(experiment.paired, experiment.sensor, data)
        name = f"stored set {experiment.paired.set_name}"
        yield flip(name, "run", [file for file in folder.iterdir() if file.is_file()], read)
    chunks = _make_unfinished_set(tiny.pose, scratch / "unfinished")
    read_chunks = lambda: [compute_array_digest(load_chunk(file)) for file in chunks]  # noqa: E731
    yield flip("contacts made so far", "data", chunks, read_chunks)
    images = _list_files(shutil.copytree(places.frames, scratch / "few"), ".png")
    yield flip("recorded PNG", "all that read images", images, lambda: _read_images(images))
    with pytest.MonkeyPatch.context() as patch:
        # the response of a coarse dome is made again if its file is damaged, so it is the same
        patch.setenv("JAXUNSHEAR_CACHE", str(scratch / "cache"))
        coarse = set_ring_spacing(TACTIP_127, 3.0)
        read = lambda: compute_array_digest(vars(load_dome(coarse)))  # noqa: E731
        read()
        files = list((scratch / "cache").glob("dome-*.bin"))
        yield flip("cache of the simulator", "all that simulate", files, read)


def _flip(row: Row, files: Sequence[Path], read: Read, size: Size, times: int) -> Row:
    right, ordered = read(), sorted(files)
    names = tuple({name for file in files for name in (file.name, str(file.parent))})

    def flip_one(draw: random.Random) -> Outcome:
        file = draw.choice(ordered)
        before = file.read_bytes()
        bit = draw.randrange(8 * len(before))
        file.write_bytes(flip_bit(before, bit))
        outcome = judge_reading(read, right, f"{file.name}, bit {bit}", names)
        file.write_bytes(before)
        return outcome

    return run_cases(row, size, size.bits * times, flip_one)


def _list_files(folder: Path, *suffixes: str) -> list[Path]:
    return sorted(file for file in folder.rglob("*") if file.suffix in suffixes)


def _make_report(run: Path) -> object:
    """Make the page, which has the same bytes each time."""
    run_command("report", run)
    return compute_digest([run / "report.html"])


def _read_report_inputs(run: Path) -> object:
    logs = [read_history(file) for file in sorted(run.rglob("log.jsonl"))]
    results = read_record(run / "results.json", Results, "again")
    images = compute_array_digest(montage.read_montage(run / "montage.npz"))
    return str((logs, results, read_times(run))), images


def _read_json(files: Sequence[Path]) -> object:
    return {str(file): to_builtins(read_json(file)) for file in files}


def _release(run: Path, out: Path) -> object:
    shutil.rmtree(out, ignore_errors=True)
    run_command("release", run, "--out", out)
    return compute_digest(_list_files(out, ".json", ".npz"))


def _read_networks(folder: Path) -> list[object]:
    folders = sorted(file.parent for file in folder.rglob("model.json"))
    return [
        (compute_array_digest(load_best(each)), read_net(each), read_targets(each))
        for each in folders
    ]


def _load_weights(weights: Path) -> object:
    settings = to_builtins(read_json(weights / "experiment.json"))
    return type(load_model(weights)), settings, *_read_networks(weights)


def _make_set_reader(settings: PairedData | Recorded, sensor: Sensor, data: Path) -> Read:
    def read() -> object:
        reader = open_set(settings, data, sensor)
        rows = [compute_array_digest(reader.rows(split)) for split in SPLITS]
        return rows, to_builtins(reader.metadata)

    return read


def _make_unfinished_set(settings: PoseData, data: Path) -> list[Path]:
    """Make a set whose contacts are made and whose shards are not, as the disk was full."""
    shim.arm(data, 0)
    make_set(settings, data_dir=data)
    count = shim.count_writes()
    shutil.rmtree(data)
    shim.arm(data, count - 4, "ENOSPC")
    with contextlib.suppress(UserError):
        make_set(settings, data_dir=data)
    shim.disarm()
    return list((data / ".partial").rglob("*.npz"))


def _read_images(files: Sequence[Path]) -> object:
    digests = []
    for file in files:
        try:
            digests.append(compute_array_digest(read_image(file)))
        except UserError as error:  # readers of folders add the name
            raise UserError(f"{file.name}: {error}") from None
    return digests
