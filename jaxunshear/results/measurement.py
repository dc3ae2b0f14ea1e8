"""Measurements as rows for machines, what they were measured on, and what a training says of itself."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

Versions = Mapping[str, str]  # by package


@dataclass(frozen=True)
class Machine:
    """On what a figure was measured, or a network trained."""

    processor: str = ""
    cores: int = 0  # usable
    memory_gib: int = 0  # 0 where the system does not say
    system: str = ""
    device: str = ""  # of JAX
    kernels: str | None = None  # of a training: its layers
    devices: int | None = None  # likewise, where there were several


@dataclass(frozen=True)
class Source:
    """With which code a figure was measured, or a network trained."""

    version: str
    date: str  # UTC, when the process began
    commit: str | None = None  # None if the package is not run from a git checkout
    clean: bool | None = None  # whether the code was as committed


@dataclass(frozen=True)
class Measurement:
    """One figure and the bar that it should clear."""

    name: str  # the path in results.json, joined by dots
    value: float | None
    unit: str  # "1" for plain numbers
    bar: float | None
    sense: str | None  # ">=" or "<="
    ok: bool | None  # None where no bar is set
    metric: str  # the exact quantity


@dataclass(frozen=True)
class Measured:
    """What `--json` writes of a run."""

    rows: Sequence[Measurement]
    machine: Machine
    versions: Versions
    source: Source | None = None
    trained_on: Mapping[str, Machine] = field(default_factory=dict)  # by network
    trained_by: Mapping[str, Source] = field(default_factory=dict)
    command: str = ""
    test_data: str | None = None  # of a run over recordings, as its results say


@dataclass(frozen=True, kw_only=True)
class TrainingSummary:
    """What a finished training says of itself: summary.json."""

    kind: str = ""
    steps: int
    images: int = 0  # seen, with repeats
    parameters: int
    best_step: int
    best_loss: float | None = None  # validation
    train_seconds: float  # steps and their data, without compilation, validation and checkpoints
    compile_seconds: float = 0.0
    images_per_second: float
    trained_on: Machine = field(
        default_factory=Machine
    )  # that ended it; of earlier versions unknown
    trained_by: Source | None = None  # likewise
