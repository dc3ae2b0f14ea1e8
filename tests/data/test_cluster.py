"""Make a data set over a Ray cluster of two nodes on this machine, one of which is lost.

Also what is refused before a cluster is started.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jaxunshear import cluster
from jaxunshear.cluster import Call, run_locally
from jaxunshear.config.configs import get_set_folder, get_unfinished_folder
from jaxunshear.config.splits import SPLITS
from jaxunshear.data.stored_sets import make_set, open_set
from jaxunshear.errors import UserError

STAND_IN = Path(__file__).with_name("conftest.py")
TINY = Path(__file__).resolve().parents[2] / "experiments" / "tiny.py"
# In the environment of its processes: another test may have a cluster of its own.
MARK = "FAKE_CLUSTER"
SCRIPT = """
import runpy, sys
from pathlib import Path
from jaxunshear.cluster import make_ray_runner
from jaxunshear.data.stored_sets import make_set
fake = runpy.run_path(sys.argv[1])
engine = fake["ENGINE"]._replace(run_calls=make_ray_runner(sys.argv[3], 1))
make_set(fake["PAIRED"], fake["SENSOR"], Path(sys.argv[2]), engine)
"""


def test_calls_are_done_here_in_their_order():
    calls = [Call(Path(name), str.upper, (name,)) for name in "ba"]
    assert list(run_locally(calls)) == [(Path("b"), "B"), (Path("a"), "A")]
    with pytest.raises(ZeroDivisionError):
        list(run_locally([Call(Path("c"), divmod, (1, 0))]))


def test_nothing_to_do_starts_no_cluster(monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.delenv("RAY_USAGE_STATS_ENABLED", raising=False)
    assert list(cluster.make_ray_runner(None, 1)([])) == []
    assert "RAY_USAGE_STATS_ENABLED" not in os.environ  # which it sets before it starts one


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("--ray-cores 2", "go with --engine ray"),
        ("--engine ray --ray-cores 0", "--ray-cores 0: use at least 1"),
        (
            "--engine ray --ray-address 127.0.0.1:1",
            "--ray-address 127.0.0.1:1: no cluster answers there",
        ),
    ],
)
@pytest.mark.parametrize("name", ["data", "run"])
def test_what_cannot_be_is_refused_in_one_line(command, tmp_path, name, words, line):
    pytest.importorskip("ray")
    answer = command(
        name, TINY, *words.split(), "--out", tmp_path / "out", "--data", tmp_path / "sets"
    )
    assert answer.code == 2 and line in answer.err and answer.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_without_ray_data_says_how_to_get_it(command, absent):
    absent("ray")
    answer = command("data", TINY, "--engine", "ray")
    assert answer.code == 2
    assert "--engine ray needs Ray: pip install" in answer.err
    assert "[ray]" in answer.err


@pytest.fixture
def nodes(monkeypatch, tmp_path):
    """A cluster of two nodes with a core each, whose contacts take their time."""
    utils = pytest.importorskip("ray.cluster_utils")
    monkeypatch.setenv("FAKE_SECONDS", "1")
    monkeypatch.setenv(MARK, str(tmp_path))
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    made = utils.Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
    )
    try:
        made.add_node(num_cpus=1)
        yield made
    finally:
        made.shutdown()


@pytest.mark.long
def test_a_set_outlives_workers_nodes_and_commands(nodes, paired, sensor, engine, tmp_path):
    """Check for the same bits as on one machine.

    No chunk that a stopped command had kept is made twice.
    """
    make_set(paired, sensor, tmp_path / "serial", engine)
    chunks = get_unfinished_folder(paired, sensor, tmp_path / "ray")
    words = [sys.executable, "-c", SCRIPT, str(STAND_IN), str(tmp_path / "ray"), nodes.address]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: len(workers()) == 2 and len(made_in(chunks)) >= 1, process)
    os.kill(min(workers()), signal.SIGKILL)
    process.send_signal(signal.SIGINT)
    assert "KeyboardInterrupt" in process.communicate(timeout=60)[1]
    kept = made_in(chunks)
    assert kept and not get_set_folder(paired, sensor, tmp_path / "ray").exists()

    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: len(workers()) == 2 and len(made_in(chunks)) > len(kept), process)
    assert {name: made_in(chunks)[name] for name in kept} == kept
    os.kill(max(workers()), signal.SIGKILL)
    nodes.remove_node(next(iter(nodes.worker_nodes)), allow_graceful=False)
    assert process.wait(timeout=120) == 0, process.stderr.read()
    sets = [open_set(paired, tmp_path / name, sensor) for name in ("ray", "serial")]
    for split in SPLITS:
        spread, serial = (each.rows(split) for each in sets)
        assert {name: values.tobytes() for name, values in spread.items()} == {
            name: values.tobytes() for name, values in serial.items()
        }


def made_in(chunks: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in chunks.glob("*.npz")}


def workers() -> set[int]:
    """Processes of the cluster that are at a call."""
    found, mark = set(), f"{MARK}={os.environ[MARK]}".encode()
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if (path / "cmdline").read_bytes().startswith(b"ray::_run_pickled") and mark in (
                path / "environ"
            ).read_bytes():
                found.add(int(path.name))
        except OSError:
            continue
    return found


def wait_for(reached, process: subprocess.Popen) -> None:
    deadline = time.monotonic() + 120
    while not reached():
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_the_error_of_a_call_is_raised_here_as_it_was(monkeypatch):
    ray = pytest.importorskip("ray")
    crash = ray.exceptions.WorkerCrashedError()
    faults = [ray.exceptions.RayTaskError("_run_pickled", "", UserError("the disk is full")), crash]
    monkeypatch.setattr(ray, "get", lambda reference: (_ for _ in ()).throw(faults.pop(0)))
    with pytest.raises(UserError, match="the disk is full"):
        cluster._fetch_result(None)
    assert cluster._fetch_result(None) == cluster.WorkerDied(
        "its Ray worker died too often: WorkerCrashedError"
    )
