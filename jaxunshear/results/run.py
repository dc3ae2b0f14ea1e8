"""What the evaluation of a run says: results.json. Tables are open: their names are those of networks, shapes and targets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from jaxunshear.config.targets import Target
from jaxunshear.results.measurement import Machine, Source, Versions

EVALUATE_REMEDY = "run `jaxunshear evaluate` again"  # what makes a file of it anew
Settings = Mapping[str, Any]  # as `settings.serialization.to_json` makes them
Notes = Mapping[str, str | int]  # what exactly a name of a table stands for
Scores = Mapping[str, float | None]  # by target or shape
Table = Mapping[str, Scores]  # by kind of contact
Span = Sequence[float] | None  # 95 % interval
Spans = Mapping[str, Mapping[str, Span]]
EstimatorTables = Mapping[str, Table]  # by reader
FullTable = Mapping[str, Mapping[str, float]]  # a table without gaps
# recorded contacts that a network is tested on: kept out of those that it learnt from, or others
TestData = Literal["same session", "other recordings"]


@dataclass(frozen=True, kw_only=True)
class PoseSpread:
    pose_mae: Spans = field(default_factory=dict)
    pose_recovery: Spans = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Spread(PoseSpread):
    """Intervals of tables of the same names."""

    what: str = ""
    over: str | None = None
    resamples: int = 0
    seed: int = 0
    ms_ssim: Spans = field(default_factory=dict)
    difference: Spans = field(default_factory=dict)
    readers: Mapping[str, Spans] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Poses:
    """Errors of poses, mm and deg, over those on sheared contacts, and the part of the damage undone."""

    pose_mae: Table = field(default_factory=dict)
    pose_ratio: Table = field(default_factory=dict)
    pose_recovery: Table = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class PartPoses(Poses):
    """Of a part of the contacts."""

    spread: PoseSpread


Parts = Mapping[str, PartPoses | None]  # None where no contact is


@dataclass(frozen=True, kw_only=True)
class CodeSwapScore:
    """What a decoder makes of codes, compared with the image it should draw."""

    target: str
    mse: float | None = None
    ssim: float | None = None
    ms_ssim: float | None = None


@dataclass(frozen=True, kw_only=True)
class Tables(Poses):
    """All that is reported of the scores of one test."""

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
    pose_smooth: PartPoses | None = None  # edge angles where the nearest edge has one direction


@dataclass(frozen=True, kw_only=True)
class FurtherTest(Tables):
    """A test of its own, with what it was made of."""

    stimuli: Sequence[str] = ()
    tap_depth_jitter_mm: float = 0.0
    ranges: Mapping[str, float] | None = None  # of earlier versions those of the settings
    contacts: int = 0
    followed: Table | None = None


@dataclass(frozen=True)
class Counts:
    """Contacts, by what became of them; None where it is not counted."""

    train: int | None = None
    validation: int | None = None
    test: int | None = None
    test_poses: int | None = None  # poses or, of recordings, slides that are scored
    test_smooth: int | None = None  # contacts whose nearest edge has one direction
    test_taps: int | None = None  # that are scored
    test_unsure: int | None = None  # slides that are left out, since they were not understood
    test_by_stimulus: Mapping[str, int] = field(default_factory=dict)
    pin_images: int | None = None
    contacts: int | None = None
    retried: int | None = None
    dropped: int | None = None
    reader_taps: Mapping[str, int] | None = None
    known_taps: int | None = None
    unread_taps: int | None = None  # left out likewise


@dataclass(frozen=True)
class Recordings:
    """What a run learnt from."""

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
    """How slides are paired; by split how far their partners' poses are off, by target, and how many `pairs` there are."""

    way: str
    gaps: Mapping[str, Mapping[str, Scores | int]]


@dataclass(frozen=True)
class ResultBar:
    sense: str
    bar: float


@dataclass(frozen=True, kw_only=True)
class Results(Tables):
    """results.json."""

    experiment: str = ""
    claim: str = ""
    simulated: bool = True
    settings: Settings
    metric: Notes
    pin_error: Table
    tests: Mapping[str, FurtherTest] = field(default_factory=dict)
    baselines: Table = field(default_factory=dict)
    contact: Table | None = None
    test_data: TestData | None = None  # of simulated runs and of earlier versions unknown
    recordings: Recordings | None = None
    pairing: Pairing | None = None
    targets: Sequence[Target] | None = None
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
    source: Source | None = None  # that evaluated; of earlier versions unknown
    trained_by: Mapping[str, Source] = field(default_factory=dict)  # by network
    command: str = ""

    @property
    def sources(self) -> list[Source]:
        """Return the code that evaluated and that trained; nothing if some of it is not known."""
        if self.source is None or self.trained_on.keys() - self.trained_by.keys():
            return []
        return [self.source, *self.trained_by.values()]

    @property
    def recorded_facts(self) -> tuple[Recordings, Pairing]:
        """Of a run over recordings. Raises KeyError."""
        if self.recordings is None or self.pairing is None:
            raise KeyError("recordings")
        return self.recordings, self.pairing
