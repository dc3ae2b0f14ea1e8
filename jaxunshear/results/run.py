"""The record of a run's evaluation, results.json.

Keys of its tables are names of networks, kinds of contact, shapes and targets.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from jaxunshear.config.targets import Target
from jaxunshear.results.measurement import Machine, Source, Versions

EVALUATE_REMEDY = "run `jaxunshear evaluate` again"  # makes the file again
Settings = Mapping[str, Any]  # from `config.serialization.to_json`
Notes = Mapping[str, str | int]  # the exact meaning of a table's name
Scores = Mapping[str, float | None]  # by target or shape
Table = Mapping[str, Scores]  # by kind of contact
Span = Sequence[float] | None  # 95 % interval
Spans = Mapping[str, Mapping[str, Span]]
EstimatorTables = Mapping[str, Table]  # by pose estimator
FullTable = Mapping[str, Mapping[str, float]]  # a table without gaps
# recorded test contacts: held out from those of the training, or from another session
TestData = Literal["same session", "other recordings"]


@dataclass(frozen=True, kw_only=True)
class PoseSpread:
    """Intervals of the tables of poses."""

    pose_mae: Spans = field(default_factory=dict)
    pose_recovery: Spans = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Spread(PoseSpread):
    """Intervals of the tables with the same names."""

    what: str = ""
    over: str | None = None
    resamples: int = 0
    seed: int = 0
    ms_ssim: Spans = field(default_factory=dict)
    difference: Spans = field(default_factory=dict)
    readers: Mapping[str, Spans] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Poses:
    """Errors of poses in mm and deg, their ratios to those on sheared contacts, recoveries."""

    pose_mae: Table = field(default_factory=dict)
    pose_ratio: Table = field(default_factory=dict)
    pose_recovery: Table = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class PartPoses(Poses):
    spread: PoseSpread


Parts = Mapping[str, PartPoses | None]  # None for parts without contacts


@dataclass(frozen=True, kw_only=True)
class CodeSwapScore:
    """Scores of a decoder's output against its target image."""

    target: str
    mse: float | None = None
    ssim: float | None = None
    ms_ssim: float | None = None


@dataclass(frozen=True, kw_only=True)
class Tables(Poses):
    """All tables of one test."""

    ms_ssim: Table = field(default_factory=dict)
    pose_by_stimulus: Parts = field(default_factory=dict)
    difference: Table = field(default_factory=dict)
    swap: Mapping[str, CodeSwapScore] = field(default_factory=dict)
    spread: Spread = field(default_factory=Spread)
    readers: EstimatorTables = field(default_factory=dict)
    reader_images: Mapping[str, Mapping[str, Mapping[str, int]]] = field(default_factory=dict)
    pins: Table | None = None
    pose_by_depth: Parts | None = None
    pose_by_slide: Parts | None = None
    pose_smooth: PartPoses | None = None  # contacts whose nearest edge has one direction


@dataclass(frozen=True, kw_only=True)
class FurtherTest(Tables):
    """A further test, with the settings of its contacts."""

    stimuli: Sequence[str] = ()
    tap_depth_jitter_mm: float = 0.0
    ranges: Mapping[str, float] | None = None  # None in files of earlier versions
    contacts: int = 0
    followed: Table | None = None


@dataclass(frozen=True)
class Counts:
    """Numbers of contacts; None if not counted."""

    train: int | None = None
    validation: int | None = None
    test: int | None = None
    test_poses: int | None = None  # scored poses or, in recordings, slides
    test_smooth: int | None = None  # contacts whose nearest edge has one direction
    test_taps: int | None = None  # that are scored
    test_unsure: int | None = None  # slides left out by the sensor check
    test_by_stimulus: Mapping[str, int] = field(default_factory=dict)
    pin_images: int | None = None
    contacts: int | None = None
    retried: int | None = None
    dropped: int | None = None
    reader_taps: Mapping[str, int] | None = None
    known_taps: int | None = None
    unread_taps: int | None = None  # taps left out by the sensor check


@dataclass(frozen=True)
class Recordings:
    tap_folder: str
    slide_folder: str
    digest: str
    sensor: str
    pins: int
    pins_sure: float
    contacts: int
    dropped: int
    unsure: int
    taps: Mapping[str, int]  # by split
    slides: Mapping[str, int]
    dropped_frames: Sequence[str]
    labelled: float
    notes: Sequence[str]


@dataclass(frozen=True)
class Pairing:
    """The pairing of slides."""

    way: str
    # by split: distances of partners' poses by target, and the number of `pairs`
    gaps: Mapping[str, Mapping[str, Scores | int]]


@dataclass(frozen=True)
class TaskFrame:
    """How the pins of one task's frames fit those of the first task."""

    shift_px: Sequence[float]
    left_px: float  # rms distance of all rest positions that is left over


@dataclass(frozen=True)
class ResultBar:
    """The bar that a figure should clear."""

    sense: str  # ">=" or "<="
    bar: float

    def is_met(self, value: float | None) -> bool:
        if value is None:
            return False
        return value >= self.bar if self.sense == ">=" else value <= self.bar


@dataclass(frozen=True, kw_only=True)
class Results(Tables):
    """The content of results.json."""

    experiment: str = ""
    claim: str = ""
    simulated: bool = True
    settings: Settings
    metric: Notes
    pin_error: Table
    tests: Mapping[str, FurtherTest] = field(default_factory=dict)
    baselines: Table = field(default_factory=dict)
    contact: Table | None = None
    test_data: TestData | None = None  # None in simulated runs and files of earlier versions
    recordings: Recordings | None = None
    pairing: Pairing | None = None
    targets: Sequence[Target] | None = None
    frames: Mapping[str, TaskFrame] = field(default_factory=dict)  # by task, if there are several
    counts: Counts = field(default_factory=Counts)
    bars: Mapping[str, ResultBar] = field(default_factory=dict)
    paper: Mapping[str, FullTable] = field(default_factory=dict)
    seeds: Mapping[str, int] = field(default_factory=dict)
    half_width: FullTable | None = None
    coverage: FullTable | None = None
    trained_in: str | None = None
    ms_per_image: FullTable = field(default_factory=dict)
    time_s: Mapping[str, float] = field(default_factory=dict)
    machine: Machine = field(default_factory=Machine)
    trained_on: Mapping[str, Machine] = field(default_factory=dict)
    versions: Versions = field(default_factory=dict)
    source: Source | None = None  # that evaluated; None in files of earlier versions
    trained_by: Mapping[str, Source] = field(default_factory=dict)  # by network
    command: str = ""

    @property
    def sources(self) -> list[Source]:
        """Return the code that evaluated and trained the run; empty if a part is unknown."""
        if self.source is None or self.trained_on.keys() - self.trained_by.keys():
            return []
        return [self.source, *self.trained_by.values()]
