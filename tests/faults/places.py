"""What the campaign damages: the smallest experiment, run to its end; a recorded one over pins; released weights."""

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.faults.outcome import commanded
from tests.recordings import made

ROOT = Path(__file__).resolve().parents[2]
TINY, RECORDED = ROOT / "experiments" / "tiny.py", ROOT / "experiments" / "recorded.py"
PINS = (
    "--unshear.input",
    "pins",
    "--train_pins.epochs",
    "2",
    "--train_pins.batch",
    "16",
    "--train_pins.validate_every",
    "8",
)


@dataclass(frozen=True)
class Places:
    root: Path

    @property
    def runs(self) -> Path:
        return self.root / "runs"

    @property
    def run(self) -> Path:
        return self.runs / "tiny"

    @property
    def pins(self) -> Path:
        return self.runs / "pins"

    @property
    def data(self) -> Path:
        return self.root / "datasets"

    @property
    def recording(self) -> Path:
        return self.root / "edge"

    @property
    def frames(self) -> Path:
        """Four images, and their labels."""
        return self.root / "few"

    @property
    def weights(self) -> Path:
        return self.root / "weights"


def make(root: Path) -> Places:
    """What is there already is kept."""
    places = Places(root)
    if not places.recording.exists():
        made.edge(root / "edge.part", 60, 60)
        (root / "edge.part").rename(places.recording)
    if not places.frames.exists():
        pose, move = made.contacts(4, True, 7)
        made.write(root / "few.part", pose, move)
        (root / "few.part").rename(places.frames)
    where = ("--out", places.runs, "--data", places.data)
    print("the smallest run", file=sys.stderr)
    commanded("run", TINY, *where)
    print("a run over recorded pins", file=sys.stderr)
    commanded("run", RECORDED, "--recordings", places.recording, "--name", "pins", *PINS, *where)
    shutil.rmtree(places.weights, ignore_errors=True)
    commanded("release", places.run, "--out", places.weights)
    return places


def flipped(data: bytes, bit: int) -> bytes:
    """With one bit turned over."""
    array = np.frombuffer(data, np.uint8).copy()
    array[bit // 8] ^= np.uint8(1 << (bit % 8))
    return array.tobytes()
