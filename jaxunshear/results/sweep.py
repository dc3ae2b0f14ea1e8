"""Records of a sweep: sweep.json, and row.json of each of its rows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from jaxunshear.results.measurement import Machine, Source, Versions
from jaxunshear.results.run import FullTable, Notes, Results, Scores, Settings, Span


@dataclass(frozen=True, kw_only=True)
class Costs:
    """Time and memory of a row, by network if there are several."""

    train_seconds: Mapping[str, float] = field(default_factory=dict)
    images_per_second: Mapping[str, float] = field(default_factory=dict)
    ms_per_image: FullTable = field(default_factory=dict)
    wall_seconds: float = 0.0
    peak_memory_bytes: int = 0
    device: str | None = None
    host: str | None = None


@dataclass(frozen=True, kw_only=True)
class Outcome(Costs):
    """The outcome of a task; the reason of a failure is one line."""

    status: str  # "done" or "failed"
    reason: str | None
    label: str | None = None
    seed: int | None = None
    networks: Sequence[str] | None = None
    settings: Settings | None = None
    results: Results | None = None
    ablation: Sequence[Mapping[str, object]] | None = None  # rows with a name each

    @property
    def evaluated_results(self) -> Results:
        assert self.results is not None
        return self.results


@dataclass(frozen=True)
class Figure:
    """A mean over seeds and test contacts; means of other figures have no interval."""

    mean: float
    interval: Span
    per_seed: Scores | None = None


Figures = Mapping[str, Figure]  # by metric


@dataclass(frozen=True)
class GridAxis:
    """An axis of the grid, with its printed values."""

    name: str
    fields: Sequence[str]
    values: Sequence[str]


@dataclass(frozen=True)
class Failure:
    seed: int
    reason: str | None


@dataclass(frozen=True, kw_only=True)
class CellResult:
    """The figures of one point of the grid, or one explicit row, over seeds."""

    label: str
    point: Sequence[str] | None
    settings: Mapping[str, str] = field(default_factory=dict)
    seeds: Sequence[int] = ()  # those that did not fail
    metric: Notes = field(default_factory=dict)
    metrics: Figures = field(default_factory=dict)
    difference: Figures = field(default_factory=dict)  # from the reference
    ablation: Figures = field(default_factory=dict)
    failures: Sequence[Failure] = ()
    costs: Mapping[str, Costs] = field(default_factory=dict)  # by seed


@dataclass(frozen=True, kw_only=True)
class SweepResult:
    """The content of sweep.json."""

    sweep: str
    claim: str = ""
    simulated: bool = True
    axes: Sequence[GridAxis] = ()
    seeds: Sequence[int]
    networks: Sequence[str] = ()
    spread: Notes = field(default_factory=dict)  # the meaning of the intervals
    reference: str | None
    cells: Sequence[CellResult]
    base: Settings = field(default_factory=dict)
    # labels on the frontier, by metric and cost
    efficient: Mapping[str, Mapping[str, Sequence[str]]] = field(default_factory=dict)
    command: str = ""
    machines: Sequence[Machine] = ()
    trained_on: Sequence[Machine] = ()
    versions: Sequence[Versions] = ()
    sources: Sequence[Source] = ()  # that trained or evaluated; empty if one is unknown
