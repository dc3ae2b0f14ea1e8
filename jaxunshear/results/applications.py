"""What networks and pins were put to use for: the rows of servo.json and pins.json, which the command line writes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class WalkScore:
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
    unfollowed: (
        int  # steps whose pins were not identified for sure, of networks over pins; the sensor then goes straight on
    )
    perceive_ms: float  # a step


@dataclass(frozen=True)
class WalkScores:
    """servo.json"""

    rows: Sequence[WalkScore]


@dataclass(frozen=True, kw_only=True)
class PinRow:
    """One image."""

    name: str
    matched: int  # pins; 0 where identities are not sure
    sure: bool
    doubt: float | None
    missed: int
    extra: int
    largest_motion_px: float | None


@dataclass(frozen=True, kw_only=True)
class PinRows:
    """pins.json"""

    rows: Sequence[PinRow]
    pins: int
    image_px: int
    motion_from: str  # what motions are from, in words
    fit_s: float  # for finding where pins stand untouched
    ms_per_image: float
    left_out: Sequence[str]  # files, and why
