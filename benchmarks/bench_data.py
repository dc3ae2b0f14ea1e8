"""Measures processor time and bytes per contact of a simulated data set, step by step.

Larger sets are sized by them (docs/cluster.md). Processor time is summed over cores, so other work
on the machine counts little. The set is made twice, and only the second time counts, without
compilation.
"""

import dataclasses
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from jaxunshear.config.configs import PAIRED, get_set_folder, get_unfinished_folder
from jaxunshear.config.data import PairedData
from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.sampling import sample_contacts
from jaxunshear.data.simulation import make_engine, simulate_chunks
from jaxunshear.data.stored_sets import make_set, open_set
from jaxunshear.files import Json
from jaxunshear.text_table import format_text_table

POSES = 12  # of each shape: some hundred contacts
PLAN_MULTIPLE = 20  # times as many are planned: costs of the start count less
COLUMNS = ("name", "contacts", "cpu_ms", "bytes")
format_table = partial(format_text_table, columns=COLUMNS)


def bench_data(poses: int = POSES) -> list[Json]:
    """Return a row for each step: `cpu_ms` and `bytes` per contact, a tap or a slide.

    The set has paired images as in the demo, of 128 px and 331 pins.
    """
    settings = dataclasses.replace(PAIRED["demo"], poses=poses)
    for _ in range(2):
        with tempfile.TemporaryDirectory() as folder:
            rows = _measure_steps(settings, Path(folder))
    return rows


def _measure_steps(settings: PairedData, data: Path) -> list[Json]:
    engine, chunks = make_engine(), get_unfinished_folder(settings, TACTIP_331, data)
    contacts = sample_contacts(settings)
    many = sample_contacts(dataclasses.replace(settings, poses=PLAN_MULTIPLE * settings.poses))
    count = len(contacts.scenes)

    def plan() -> int:
        engine.plan(TACTIP_331, settings.stimuli, many.scenes)
        return 0

    def simulate() -> int:
        paths = simulate_chunks(settings, TACTIP_331, contacts, chunks, engine)
        return sum(path.stat().st_size for path in paths)

    def read() -> int:
        stored = open_set(settings, data, TACTIP_331)
        return sum(field.nbytes for split in SPLITS for field in stored.rows(split).values())

    rows = [
        _measure_step("plan", len(many.scenes), plan),
        _measure_step("simulate and draw", count, simulate),
    ]
    make_set(settings, TACTIP_331, data, engine)
    folder = get_set_folder(settings, TACTIP_331, data)
    size = sum(path.stat().st_size for path in folder.iterdir())
    rows.append({"name": "stored", "contacts": count, "cpu_ms": None, "bytes": size / count})
    return [*rows, _measure_step("read into memory", count, read)]


def _measure_step(name: str, contacts: int, work: Callable[[], int]) -> Json:
    """Measure `work`, which returns the bytes that it made."""
    start = time.process_time()
    size = work()
    seconds = time.process_time() - start
    return {
        "name": name,
        "contacts": contacts,
        "cpu_ms": 1e3 * seconds / contacts,
        "bytes": size / contacts,
    }
