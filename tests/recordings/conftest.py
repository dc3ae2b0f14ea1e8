"""One small recording and one small run over its pins, shared: they take seconds."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import made

from jaxunshear.cli import main

ROOT = Path(__file__).resolve().parents[2]
SHORT = (
    *("--unshear.input", "pins", "--train_pins.epochs", "12", "--train_pins.batch", "16"),
    *("--train_pins.min_steps", "1", "--train_pins.validate_every", "40"),
    *("--train_pins.rotated_below", "0"),
    *("--train_pins.optimiser", "adam"),
    *("--train_pins.learning_rate", "3e-3", "--train_pins.losses.pose_label", "1"),
    *("--pins.conv_channels", "4,6"),
)


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """160 taps and 160 slides of an edge."""
    return made.edge(tmp_path_factory.mktemp("recording") / "edge", 160, 160)


@pytest.fixture(scope="session")
def place(tmp_path_factory):
    """Where runs and data sets go."""
    return tmp_path_factory.mktemp("lab")


@pytest.fixture(scope="session")
def pins_run(recording, place):
    """A finished run over pins."""
    words = ["run", ROOT / "experiments/recorded.py", "--recordings", recording, "--name", "pins"]
    words += ["--paired.validation", "0.2"]  # enough contacts to find half-widths by
    words += [*SHORT, "--out", place / "runs", "--data", place / "datasets"]
    assert main([str(word) for word in words]) == 0
    return place / "runs" / "pins"
