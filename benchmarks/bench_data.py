"""What a simulated set takes: processor time and bytes a contact, step by step, by which larger ones are sized (docs/cluster.md).

Processor time is summed over cores, so that other work on the machine counts little. The set is made twice, and the second time
counted: nothing is compiled then.
"""

import dataclasses
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxunshear.config.configs import PAIRED, get_set_folder, get_unfinished_folder
from jaxunshear.config.data import PairedData
from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.chunks import make_engine, simulate_chunks
from jaxunshear.data.generation import make_set
from jaxunshear.data.reader import open_set
from jaxunshear.data.sampling import sample_contacts

POSES = 12  # of each shape: some hundred contacts
PLAN_MULTIPLE = 20  # times as many are planned: what it costs once counts less
COLUMNS = ("name", "contacts", "cpu_ms", "bytes")


def bench_data(poses: int = POSES) -> list[dict[str, Any]]:
    """A row a step: `cpu_ms` and `bytes` a contact, be it a tap or a slide; of the demo's paired images, 128 px, 331 pins."""
    settings = dataclasses.replace(PAIRED["demo"], poses=poses)
    for _ in range(2):
        with tempfile.TemporaryDirectory() as folder:
            rows = _steps(settings, Path(folder))
    return rows


def _steps(settings: PairedData, data: Path) -> list[dict[str, Any]]:
    engine, chunks = make_engine(), get_unfinished_folder(settings, TACTIP_331, data)
    drawn = [
        sample_contacts(one)
        for one in (settings, dataclasses.replace(settings, poses=PLAN_MULTIPLE * settings.poses))
    ]
    shots, many = drawn
    counts = [len(each.scenes) for each in drawn]

    def simulate() -> int:
        paths = simulate_chunks(settings, TACTIP_331, shots, chunks, engine)
        return sum(path.stat().st_size for path in paths)

    def read() -> int:
        stored = open_set(settings, data, TACTIP_331)
        return sum(field.nbytes for split in SPLITS for field in stored.rows(split).values())

    plan = _step(
        "plan", counts[1], lambda: 0 * len(engine.plan(TACTIP_331, settings.stimuli, many.scenes))
    )
    chunk = _step("simulate and draw", counts[0], simulate)
    make_set(settings, TACTIP_331, data, engine)
    files = sum(
        path.stat().st_size for path in get_set_folder(settings, TACTIP_331, data).iterdir()
    )
    stored = {"name": "stored", "contacts": counts[0], "cpu_ms": None, "bytes": files / counts[0]}
    return [plan, chunk, stored, _step("read into memory", counts[0], read)]


def _step(name: str, contacts: int, work: Callable[[], int]) -> dict[str, Any]:
    """`work` returns the bytes that it made."""
    began = time.process_time()
    size = work()
    spent = time.process_time() - began
    return {
        "name": name,
        "contacts": contacts,
        "cpu_ms": 1e3 * spent / contacts,
        "bytes": size / contacts,
    }
