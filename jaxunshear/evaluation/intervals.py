"""Intervals: how far a mean would move on other contacts, and how far off an answer may be.

Bootstrap: slides at one pose share their tap, so they are no independent draws. Poses are drawn,
each with all its slides.

Conformal: half-widths that contain 95 % of the errors on validation contacts. No distribution is
assumed (split conformal). The coverage is guaranteed for contacts drawn like those of the
validation, so of the same session. On other recordings errors can be larger, and the widths contain
fewer of them; `compute_coverage` computes how many.
"""

import math
from collections.abc import Mapping

import numpy as np

LEVEL = 0.95
RESAMPLES = 1000
INTERVALS_OVER = "test poses of one training"
MIN_CONTACTS = 20  # no half-width contains 95 % of fewer
# coverage of unsheared slides in docs/results/locked/recorded_pins_seed0.json
COVERAGE_ELSEWHERE = {"y_mm": 0.9405, "z_mm": 0.8195, "Rz_deg": 0.9455}
_SHARES = (
    f"{100 * share:.0f} % of {name.partition('_')[0]}" for name, share in COVERAGE_ELSEWHERE.items()
)
ELSEWHERE_NOTE = (
    f"On other recordings of a public edge, unsheared over pins, they held {', '.join(_SHARES)}"
)
ByKind = dict[str, dict[str, float]]  # by kind of contact and target


def resample_means(
    values: Mapping[str, np.ndarray], poses: np.ndarray, seed: int
) -> dict[str, np.ndarray]:
    """Compute means (RESAMPLES,) of each array (N,) over resampled poses.

    `poses` (N,) says which pose each value belongs to. All arrays get the same draws, so the means
    of one do not depend on the others, and a figure made of several means can be computed draw by
    draw.
    """
    _, group = np.unique(poses, return_inverse=True)
    counts = np.bincount(group).astype(np.float64)
    draws = np.random.default_rng(seed).multinomial(
        len(counts), np.full(len(counts), 1 / len(counts)), size=RESAMPLES
    )
    return {
        name: (draws @ np.bincount(group, value.astype(np.float64))) / (draws @ counts)
        for name, value in values.items()
    }


def compute_interval(means: np.ndarray) -> list[float]:
    """Compute the interval [low, high] of 95 % of resampled figures (RESAMPLES,)."""
    return np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2]).tolist()


def compute_intervals(
    values: Mapping[str, np.ndarray], poses: np.ndarray, seed: int
) -> dict[str, list[float]]:
    """Compute the interval [low, high] of the mean of each array (N,), as `resample_means`.

    A single pose gives an interval without width.
    """
    resampled = resample_means(values, poses, seed)
    return {name: compute_interval(means) for name, means in resampled.items()}


def compute_recovery(
    unsheared: float | None, sheared: float | None, tap: float | None
) -> float | None:
    """Compute the part of a slide's damage that is undone; None if it does no damage."""
    if sheared is None or unsheared is None or tap is None or not sheared > tap:
        return None
    return (sheared - unsheared) / (sheared - tap)


def compute_recovery_interval(
    unsheared: np.ndarray, sheared: np.ndarray, tap: np.ndarray
) -> list[float] | None:
    """Compute the interval of the recovery from resampled errors (RESAMPLES,).

    None if the slide does no damage in one of the resamples, as the recovery then has no bounds,
    or if an error is NaN.
    """
    if not np.all(sheared > tap):
        return None
    return compute_interval((sheared - unsheared) / (sheared - tap))


def compute_half_widths(errors: Mapping[str, np.ndarray]) -> ByKind:
    """Compute half-widths from absolute errors (N,), mm or deg, by `pose/<kind>/<target>`."""
    widths: ByKind = {}
    for name, values in errors.items():
        table, kind, *target = name.split("/")
        count = len(values)
        if table == "pose" and count >= MIN_CONTACTS:
            rank = min(count, math.ceil(round(LEVEL * (count + 1), 9)))
            widths.setdefault(kind, {})[target[0]] = float(np.sort(values)[rank - 1])
    return widths


def compute_coverage(
    widths: Mapping[str, Mapping[str, float]], errors: Mapping[str, np.ndarray]
) -> ByKind:
    """Compute the share of other contacts' errors that the half-widths contain."""
    coverage: ByKind = {}
    for kind, targets in widths.items():
        for target, width in targets.items():
            values = errors.get(f"pose/{kind}/{target}")
            if values is not None:
                coverage.setdefault(kind, {})[target] = float(np.mean(values <= width))
    return coverage
