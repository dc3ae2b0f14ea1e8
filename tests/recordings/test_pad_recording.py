"""Run the commands of docs/pads.md, and those that it names, on a simulated pad."""

import json
import re
import shlex
from pathlib import Path

import pytest
from conftest import ROOT, SHORT

from jaxunshear.demo_data import SENSORS, _write_sensor
from jaxunshear.inference.trained_model import load_model
from jaxunshear.progress import Progress
from tests.helpers.commands import succeed

CONTACTS = 40  # taps, and as many slides
PAGE = (ROOT / "docs" / "pads.md").read_text()
TINY = (*SHORT[2:3], "2", *SHORT[4:], "--paired.validation", "0.2")


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    """A folder as `demo-data demo` leaves it, with the pad alone."""
    place = tmp_path_factory.mktemp("pad")
    (pad,) = (demo for demo in SENSORS if demo.sensor.is_flat)
    with Progress("simulate", 1, unit="steps") as progress:
        _write_sensor(place / "demo" / pad.name, pad, CONTACTS, 0, progress)
    return place


def test_commands_of_the_page(command, laboratory, monkeypatch):
    monkeypatch.chdir(laboratory)
    lines = re.findall(r"^ {4}jaxunshear (.*)$", PAGE, re.MULTILINE)
    words = [shlex.split(line) for line in lines]
    chosen = [each for each in words if each[0] in ("layout", "doctor", "fit")]
    assert len(chosen) == 3
    answers = [succeed(command, *each, *(TINY if each[0] == "fit" else ())) for each in chosen]
    assert "165 light markers" in answers[0].out
    assert "layout of pad; followed in 100%" in answers[1].out
    model = load_model("runs/pad")
    assert model.sensor.pins == 165
    frames = "demo/165_markers/camera"
    pose = succeed(command, "pose", frames, "--model", "runs/pad")
    rows = [line.split(",") for line in pose.out.splitlines()]
    assert len(rows) == CONTACTS + 1 and not any(row[rows[0].index("left_out")] for row in rows[1:])
    succeed(command, "unshear", frames, "--model", "runs/pad", "--out", "unsheared")
    succeed(command, "stream", frames, "--model", "runs/pad", "--lines", "poses.jsonl")
    streamed = [json.loads(line) for line in Path("poses.jsonl").read_text().splitlines()]
    assert len(streamed) == CONTACTS and all(line["pose"] for line in streamed)
    assert set(streamed[0]["touch"]) == {"divergence", "curl"}
