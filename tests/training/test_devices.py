"""A step over two devices is the step over one: tried on virtual ones, in a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from jaxunshear import environment
from jaxunshear.errors import UserError
from jaxunshear.report.training_sections import read_lines
from jaxunshear.training.devices import get_devices

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = """
import dataclasses, os, sys
from pathlib import Path
from jaxunshear.training.devices import get_devices
from tests.training import small
training = dataclasses.replace(small.TRAINING, epochs=50.0, validate_every=20)
for count in ("1", "2"):
    os.environ["JAXUNSHEAR_DEVICES"] = count
    small.train(Path(sys.argv[1]) / count, training=training)
batch = get_devices(4).with_batch(small.pair(0, 4) | {"odd": small.dots(0, 3)})
assert [shard.data.shape[0] for shard in batch["sheared"].addressable_shards] == [2, 2]
assert [shard.data.shape[0] for shard in batch["odd"].addressable_shards] == [3, 3]
"""


def on_two(script: str, *words: str) -> subprocess.CompletedProcess[str]:
    """A process that sees two virtual devices."""
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", script, *words]
    return subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True)


@pytest.mark.long
def test_two_devices_train_as_one(tmp_path):
    """200 steps: every loss that is kept, of batches and of the validation."""
    on_two(SCRIPT, str(tmp_path)).check_returncode()
    one, two = (read_lines(tmp_path / count / "log.jsonl") for count in "12")
    assert one[-1]["step"] == two[-1]["step"] == 200
    for first, second in zip(one, two, strict=True):
        for part in ("train", "validation"):
            assert second[part] == pytest.approx(first[part], abs=1e-5), first["step"]
    summaries = [json.loads((tmp_path / count / "summary.json").read_text()) for count in "12"]
    assert [each["trained_on"].get("devices") for each in summaries] == [None, 2]
    assert summaries[1]["trained_on"]["kernels"] == "fast"


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


def test_all_devices_must_divide_a_batch(monkeypatch):
    monkeypatch.setenv(environment.DEVICE_COUNT, "all")
    assert get_devices(3) == (1, None)
    script = "from jaxunshear.training.devices import get_devices; get_devices(3)"
    assert "UserError: batch: 3 images cannot be split over 2" in on_two(script).stderr
