"""A step over two devices is the step over one: tried on virtual ones, in a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from jaxunshear import environment
from jaxunshear.errors import UserError
from jaxunshear.training.devices import get_devices

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
