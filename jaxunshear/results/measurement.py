"""Records of measurements, of the machine and code that made them, and of trainings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

Versions = Mapping[str, str]  # by package


@dataclass(frozen=True)
class Machine:
    """The machine that measured a figure or trained a network."""

    processor: str = ""
    cores: int = 0  # usable
    memory_gib: int = 0  # 0 if the system does not report it
    system: str = ""
    device: str = ""  # of JAX
    kernels: str | None = None  # the implementation of a training's layers
    devices: int | None = None  # of a training with several


@dataclass(frozen=True)
class Source:
    """The code that measured a figure or trained a network."""

    version: str
    date: str  # UTC, of the start of the process
    commit: str | None = None  # None if the package is not run from a git checkout
    clean: bool | None = None  # whether the code equals the commit


@dataclass(frozen=True)
class Measurement:
    """One figure and the bar that it should clear."""

    name: str  # the path in results.json, with dots
    value: float | None
    unit: str  # "1" for plain numbers
    bar: float | None
    sense: str | None  # ">=" or "<="
    ok: bool | None  # None if there is no bar
    metric: str  # the exact quantity


@dataclass(frozen=True)
class Measured:
    """The content of the file that `--json` writes about a run."""

    rows: Sequence[Measurement]
    machine: Machine
    versions: Versions
    source: Source | None = None
    trained_on: Mapping[str, Machine] = field(default_factory=dict)  # by network
    trained_by: Mapping[str, Source] = field(default_factory=dict)
    command: str = ""
    test_data: str | None = None  # of a run over recordings, as in its results


@dataclass(frozen=True, kw_only=True)
class TrainingSummary:
    """The content of summary.json: a finished training."""

    kind: str = ""
    steps: int
    images: int = 0  # with repeats
    parameters: int
    operations: float = 0  # FLOPs of one frame; 0 in files of earlier versions
    best_step: int
    best_loss: float | None = None  # validation
    train_seconds: float  # steps and their data, without compilation, validation and checkpoints
    compile_seconds: float = 0.0
    images_per_second: float
    # machine and code that ended the training; unknown in files of earlier versions
    trained_on: Machine = field(default_factory=Machine)
    trained_by: Source | None = None
