"""The slide as a signal: read from both codes, with an uncertainty.

A small network learns mean and deviation of each quantity from the codes of training slides. Its deviations are then stretched until
the intervals hold 95 % of the validation slides (split conformal: no distribution is assumed), and are tested on others.

A slide that has slipped cannot be seen in full: where all the skin that touches slips, what was commanded and what is felt are two things.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from jaxunshear.evaluation.bootstrap import LEVEL, compute_interval, resample_means
from jaxunshear.evaluation.probes import fit_gaussian
from jaxunshear.files import Json

MIN_SLIP_SHARE = (
    0.99  # share of the touching skin that slips, from which on a slide counts as slipped
)
SEED = 0

Quantities = Mapping[str, np.ndarray]  # (N, 1) mm or deg by quantity


def estimate_slides(
    codes: Sequence[np.ndarray],
    targets: Sequence[Quantities],
    groups: np.ndarray,
    poses: np.ndarray,
    slipped: np.ndarray | None = None,
) -> list[Json]:
    """A row a quantity. `codes` (N, F) and `targets` of training, validation and test slides; `groups` (N,) of training poses, `poses` of
    test poses; `slipped` (M,) which test slides have, where that is known."""
    names = list(targets[0])
    learnt, calibrating, true = (np.concatenate(list(each.values()), axis=1) for each in targets)
    count = len(calibrating)
    mean, deviation = fit_gaussian(codes[0], learnt, np.concatenate(codes[1:]), groups)
    off = np.abs(mean[:count] - calibrating) / deviation[:count]
    reach = np.quantile(off, min(1.0, LEVEL * (1 + 1 / count)), axis=0)
    error, width = mean[count:] - true, reach * deviation[count:]
    parts = {"": np.ones(len(true), bool)}
    if slipped is not None:
        parts |= {"sticking": ~slipped, "slipped": slipped}
    rows = []
    for column, name in enumerate(names):
        for part, inside in parts.items():
            if inside.any():
                scores = _scores(error[inside, column], width[inside, column], poses[inside])
                rows.append(
                    {"name": name, "part": part or "all", "slides": int(inside.sum()), **scores}
                )
    return rows


def is_slipping(stuck: np.ndarray, slips: np.ndarray) -> np.ndarray:
    """(N,) bool of numbers of nodes (N,) that stick and that slip."""
    return slips >= MIN_SLIP_SHARE * np.maximum(stuck + slips, 1)


def _scores(error: np.ndarray, width: np.ndarray, poses: np.ndarray) -> Json:
    covered = (np.abs(error) <= width).astype(np.float64)
    means = resample_means(
        {"mae": np.abs(error), "square": error**2, "coverage": covered}, poses, SEED
    )
    return {
        "mae": float(np.abs(error).mean()),
        "mae interval": compute_interval(means["mae"]),
        "rmse": float(np.sqrt(np.mean(error**2))),
        "rmse interval": compute_interval(np.sqrt(means["square"])),
        "coverage": float(covered.mean()),
        "coverage interval": compute_interval(means["coverage"]),
        "half_width": float(width.mean()),
    }
