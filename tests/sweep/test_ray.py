"""The same rows over a Ray cluster on this machine, also where its workers die."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from jaxunshear.results.record_files import convert_record
from jaxunshear.results.sweep import SweepResult
from tests.helpers.reproducible import select_sweep


@pytest.mark.long
def test_workers_that_are_killed_change_nothing(stand_in, tmp_path):
    """Two Ray workers are killed: the table equals that of the serial engine.

    No other step than theirs is done twice.
    """
    pytest.importorskip("ray")
    sweep, pause = [*stand_in.WORKER, "sweep"], os.environ | {"STAND_IN_PAUSE": "0.2"}
    serial = subprocess.run([*sweep, tmp_path / "serial"], capture_output=True, check=True)
    words = [*sweep, tmp_path / "ray", "ray"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, env=pause)
    killed: set[int] = set()
    while len(killed) < 2 and process.poll() is None:
        time.sleep(0.5)
        for worker in ray_workers(tmp_path / "ray" / "small" / "rows") - killed:
            time.sleep(1)  # amid its training
            os.kill(worker, signal.SIGKILL)
            killed.add(worker)
            break
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 0 and len(killed) == 2
    found = convert_record(json.loads(out.splitlines()[-1]), SweepResult, "it", "again")
    expected = convert_record(json.loads(serial.stdout), SweepResult, "it", "again")
    assert select_sweep(found) == select_sweep(expected)
    lines = (tmp_path / "ray" / "data" / "steps.txt").read_text().splitlines()
    assert len(lines) - len(set(lines)) <= len(killed)


def ray_workers(rows: Path) -> set[int]:
    """The parents of the processes that work on `rows`."""
    found = set()
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if str(rows).encode() in (path / "cmdline").read_bytes():
                found.add(int((path / "stat").read_text().rpartition(")")[2].split()[1]))
        except OSError:
            continue
    return found
