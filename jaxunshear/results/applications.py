"""What networks and pins were put to use for: the tables that the command line writes, a file each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class TrajectoryScore:
    """Walks around one object by one way of perceiving: means over its walks, distances over all of their steps.

    `mean_mm`, `p95_mm` and `largest_mm`: of the trajectory, which the controller holds to the edge, from the outline; `walk_mm` its
    mean walk by walk; `seen_mean_mm`: of where the edge was perceived to be, from the outline. A walk that was lost counts until there.
    """

    name: str  # stimulus/way
    stimulus: str
    way: str
    starts: int
    completed: float  # share of the outline
    closed: int  # walks that came round
    mean_mm: float
    walk_mm: Sequence[float]
    p95_mm: float
    largest_mm: float
    seen_mean_mm: float | None
    ends: Mapping[str, int]  # of how many walks, by what ended them
    unsolved: int  # contacts that did not converge
    steps: int
    unfollowed: int  # steps whose pins were not identified for sure, of networks over pins; the sensor then goes straight on
    perceive_ms: float  # a step


@dataclass(frozen=True)
class TrajectoryScores:
    """servo.json"""

    rows: Sequence[TrajectoryScore]


@dataclass(frozen=True, kw_only=True)
class PinScore:
    """One image."""

    name: str
    matched: int  # pins; 0 where identities are not sure
    sure: bool
    doubt: float | None
    missed: int
    extra: int
    largest_motion_px: float | None


@dataclass(frozen=True, kw_only=True)
class PinScores:
    """pins.json"""

    rows: Sequence[PinScore]
    pins: int
    image_px: int
    motion_from: str  # what motions are from, in words
    fit_s: float  # for finding where pins stand untouched
    ms_per_image: float
    left_out: Sequence[str]  # files, and why


@dataclass(frozen=True, kw_only=True)
class ObjectScore:
    """Objects that walks around one stimulus, by one way of perceiving, enclose as one maker sees them; means over these walks."""

    name: str  # stimulus/object/way
    stimulus: str
    object: str  # its maker
    way: str
    walks: int
    closed: int  # of these
    iou: float  # with the true shape
    walk_iou: Sequence[float]
    iou_felt: float  # where the skin was
    mean_mm: float  # between both outlines
    hausdorff_mm: float
    height_rms_mm: float | None  # of the felt top from the object's, where values are heights
    level: float | None  # over which the object lies; none where it is what a ridge surrounds
    unmatched: int  # steps whose pins were not identified for sure


@dataclass(frozen=True)
class ObjectScores:
    """reconstruct.json"""

    rows: Sequence[ObjectScore]


@dataclass(frozen=True, kw_only=True)
class GeometryScore:
    """One kind of image and way from pins to heights, of one stimulus or of all: mean correlation with the true indentation and rms
    error, with their intervals; of images of no contact the correlation with the taps' indentation, as a floor, and the largest height."""

    name: str  # stimulus/kind/way
    stimulus: str
    kind: str
    way: str
    contacts: int
    unmatched: int  # of these, whose pins were not identified for sure; where that is all of them there is no score
    ms_per_image: float
    largest_mm: float | None = None
    correlation: float | None = None
    correlation_interval: Sequence[float] | None = None
    rmse_mm: float | None = None
    rmse_mm_interval: Sequence[float] | None = None


@dataclass(frozen=True)
class GeometryScores:
    """geometry.json"""

    rows: Sequence[GeometryScore]
    mm_per_height: Mapping[str, float]  # by way, as fitted to taps that are not scored
    dropped: int  # contacts that did not converge


@dataclass(frozen=True, kw_only=True)
class StreamResult:
    """stream.json: what became of the frames of a stream.

    Milliseconds and their percentiles are of the frames that were used, from their coming to their line, and of the networks alone.
    """

    frames: int  # used, skipped and dropped
    used: int
    skipped: int  # could not be used
    dropped: int  # came while another was at work
    problems: Mapping[str, int]  # of how many frames
    live: bool  # of a camera, or played as one
    frames_per_s: float
    confidence: float | None  # mean
    pose_mae: Mapping[str, float]  # by quantity, where there are labels
    latency_ms: Mapping[str, float] | None  # p50, p95, p99
    networks_ms: Mapping[str, float] | None
