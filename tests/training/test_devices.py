"""A step over two devices is the step over one: tried on virtual ones, in a process of its own."""

import contextlib
import itertools
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from jaxunshear import environment
from jaxunshear.errors import UserError
from jaxunshear.training.devices import get_devices, prefetch

SCRIPT = """
import sys, dataclasses, os
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import small
from jaxunshear.training import trainer
small.TRAINING = dataclasses.replace(small.TRAINING, epochs=50.0, validate_every=20)
for count in ("1", "2"):
    os.environ["JAXUNSHEAR_DEVICES"] = count
    small.train(Path(sys.argv[2]) / count)
from jaxunshear.training.devices import get_devices
batch = get_devices(4).with_batch(small.pair(0, 4) | {"odd": small.dots(0, 3)})
assert [shard.data.shape[0] for shard in batch["sheared"].addressable_shards] == [2, 2]
assert [shard.data.shape[0] for shard in batch["odd"].addressable_shards] == [3, 3]
"""
UNEVEN = """
from jaxunshear.training.devices import get_devices
get_devices(3)
"""


def on_two(script: str, *words: str) -> subprocess.CompletedProcess[str]:
    """A process that sees two virtual devices."""
    flags = {
        "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2",
        "JAX_PLATFORMS": "cpu",
    }
    command = [sys.executable, "-c", script, *words]
    return subprocess.run(
        command, env=os.environ | flags, check=False, capture_output=True, text=True
    )


@pytest.mark.long
def test_two_devices_train_as_one(tmp_path):
    """200 steps: every loss that is kept, of batches and of the validation."""
    on_two(SCRIPT, str(Path(__file__).parent), str(tmp_path)).check_returncode()
    one, two = (
        [json.loads(line) for line in (tmp_path / count / "log.jsonl").read_text().splitlines()]
        for count in "12"
    )
    assert one[-1]["step"] == two[-1]["step"] == 200
    for first, second in zip(one, two, strict=True):
        for part in ("train", "validation"):
            for name in first[part]:
                assert abs(second[part][name] - first[part][name]) < 1e-5, (first["step"], name)
    trained_on = [
        json.loads((tmp_path / count / "summary.json").read_text())["trained_on"] for count in "12"
    ]
    assert [each.get("devices") for each in trained_on] == [None, 2]
    assert trained_on[1]["kernels"] == "fast"


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        ("2", "JAX sees 1 here"),
        ("0", "use a number of devices"),
        ("some", "use a number of devices"),
    ],
)
def test_what_cannot_be_is_one_line(monkeypatch, asked, line):
    monkeypatch.setenv(environment.DEVICE_COUNT, asked)
    with pytest.raises(UserError, match=f"JAXUNSHEAR_DEVICES={asked}: {line}"):
        get_devices(4)


def test_an_uneven_batch_is_refused(monkeypatch):
    monkeypatch.setenv(environment.DEVICE_COUNT, "all")
    assert "UserError: batch: 3 images cannot be split over 2" in on_two(UNEVEN).stderr


def test_all_of_one_is_one(monkeypatch):
    monkeypatch.setenv(environment.DEVICE_COUNT, "all")
    assert get_devices(3) == (1, None)


def test_in_order_and_one_ahead_in_a_thread_of_their_own():
    drawn, threads = [], set()

    def put(number):
        drawn.append(number)
        threads.add(threading.get_ident())
        return -number

    with contextlib.closing(prefetch(itertools.count(), put)) as stream:
        assert list(itertools.islice(stream, 5)) == [0, -1, -2, -3, -4]
    assert drawn == [0, 1, 2, 3, 4, 5]
    assert len(threads) == 1
    assert threading.get_ident() not in threads
    assert not any(thread.ident in threads for thread in threading.enumerate())


def test_what_drawing_raises_comes_after_the_batches_before_it():
    stream = prefetch((1 / (3 - number) for number in itertools.count()), float)
    assert [next(stream) for _ in range(3)] == [1 / 3, 1 / 2, 1.0]
    with pytest.raises(ZeroDivisionError):
        next(stream)
