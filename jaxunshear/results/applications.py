"""Records of the results of commands that use trained networks, one file each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class TrajectoryScore:
    """The walks around one object by one method of perceiving.

    `mean_mm`, `p95_mm` and `largest_mm` are distances of the trajectory from the outline over all
    steps; `walk_mm` is the mean of each walk, and `seen_mean_mm` the mean distance of the perceived
    edge from the outline. A walk that left the object counts up to there.
    """

    name: str  # stimulus/way
    stimulus: str
    way: str
    starts: int
    completed: float  # share of the outline
    closed: int  # walks that closed the outline
    mean_mm: float
    walk_mm: Sequence[float]
    p95_mm: float
    largest_mm: float
    seen_mean_mm: float | None
    ends: Mapping[str, int]  # numbers of walks by their reason to end
    unsolved: int  # contacts that did not converge
    steps: int
    # steps without certain pin identities, if networks use pins; the sensor then goes straight on
    unfollowed: int
    perceive_ms: float  # per step


@dataclass(frozen=True, kw_only=True)
class PinScore:
    """The pins of one image."""

    name: str
    matched: int  # pins; 0 if identities are not certain
    sure: bool
    doubt: float | None
    missed: int
    extra: int
    largest_motion_px: float | None


@dataclass(frozen=True, kw_only=True)
class PinScores:
    """The content of pins.json."""

    rows: Sequence[PinScore]
    pins: int
    image_px: int
    motion_from: str  # the origin of motions, in words
    fit_s: float  # for finding the rest positions
    ms_per_image: float
    left_out: Sequence[str]  # files, and why


@dataclass(frozen=True, kw_only=True)
class ObjectScore:
    """The objects from walks around one stimulus, by one method and shape estimator; means."""

    name: str  # stimulus/object/way
    stimulus: str
    object: str  # the shape estimator
    way: str
    walks: int
    closed: int  # of these walks
    iou: float  # with the true shape
    walk_iou: Sequence[float]
    iou_felt: float  # where the skin touched
    mean_mm: float  # between both outlines
    hausdorff_mm: float
    height_rms_mm: float | None  # from the object's top, if values are heights
    level: float | None  # the object is above it; none if a ridge surrounds the object
    unmatched: int  # steps without certain pin identities


@dataclass(frozen=True)
class ScoreTable:
    """The content of servo.json, or of reconstruct.json."""

    rows: Sequence[TrajectoryScore] | Sequence[ObjectScore]


@dataclass(frozen=True, kw_only=True)
class GeometryScore:
    """The contact geometry of one kind of image by one method, for one stimulus or for all.

    Mean correlation with the true indentation and rms error, with their intervals. For images
    without contact the correlation is with the indentation of the taps, as a lower bound.
    """

    name: str  # stimulus/kind/way
    stimulus: str
    kind: str
    way: str
    contacts: int
    unmatched: int  # contacts without certain pin identities; if these are all, there is no score
    ms_per_image: float
    largest_mm: float | None = None
    correlation: float | None = None
    correlation_interval: Sequence[float] | None = None
    rmse_mm: float | None = None
    rmse_mm_interval: Sequence[float] | None = None


@dataclass(frozen=True)
class GeometryScores:
    """The content of geometry.json."""

    rows: Sequence[GeometryScore]
    mm_per_height: Mapping[str, float]  # by method, fitted to taps that are not scored
    dropped: int  # contacts that did not converge


@dataclass(frozen=True, kw_only=True)
class StreamResult:
    """The content of stream.json."""

    frames: int  # used, skipped and dropped
    used: int
    skipped: int  # could not be used
    dropped: int  # arrived while another was processed
    problems: Mapping[str, int]  # numbers of frames by problem
    live: bool  # from a camera, or played at its rate
    lost: str  # why a live source gave no more frames; empty if it ended otherwise
    frames_per_s: float
    confidence: float | None  # mean
    pose_mae: Mapping[str, float]  # by quantity, if there are labels
    latency_ms: Mapping[str, float] | None  # p50, p95, p99 from arrival to output, of used frames
    networks_ms: Mapping[str, float] | None  # likewise, of the networks alone
