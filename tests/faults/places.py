"""What the campaign damages: the smallest run, a recorded one over pins, released weights."""

import shutil
import sys
from pathlib import Path
from typing import NamedTuple

from tests.faults.outcome import run_command
from tests.recordings import made

ROOT = Path(__file__).resolve().parents[2]
TINY, RECORDED = ROOT / "experiments" / "tiny.py", ROOT / "experiments" / "recorded.py"
_EPOCHS = ("--train_pins.epochs", "2", "--train_pins.min_steps", "1")
PINS = (
    "--unshear.input",
    "pins",
    "--train_pins.batch",
    "16",
    *_EPOCHS,
    "--train_pins.validate_every",
    "8",
)


class Places(NamedTuple):
    """Folders."""

    run: Path  # of images
    pins: Path  # a run of pins
    data: Path
    recording: Path
    frames: Path  # four images, and their labels
    weights: Path


def make_places(root: Path) -> Places:
    """Make the folders below `root`; what is there already is kept."""
    runs = root / "runs"
    folders = (root / name for name in ("datasets", "edge", "few", "weights"))
    places = Places(runs / "tiny", runs / "pins", *folders)
    if not places.recording.exists():
        made.edge(root / "edge.part", 60, 60)
        (root / "edge.part").rename(places.recording)
    if not places.frames.exists():
        pose, move = made.contacts(4, True, 7)
        made.write(root / "few.part", pose, move)
        (root / "few.part").rename(places.frames)
    where = ("--out", runs, "--data", places.data)
    print("the smallest run", file=sys.stderr)
    run_command("run", TINY, *where)
    print("a run over recorded pins", file=sys.stderr)
    recording = ("--recordings", places.recording, "--name", "pins")
    run_command("run", RECORDED, *recording, *PINS, *where)
    shutil.rmtree(places.weights, ignore_errors=True)
    run_command("release", places.run, "--out", places.weights)
    return places
