"""Estimate the slide from both codes, with an uncertainty.

A small network learns mean and deviation of each quantity from the codes of training slides. Its
deviations are then scaled until the intervals contain 95 % of the validation slides (split
conformal: no distribution is assumed), and are tested on others.

Once all the skin that touches slips, the camera does not show how far the sensor went: the
commanded slide and the shear of the skin differ.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from jaxunshear.evaluation.bootstrap import LEVEL, compute_interval, resample_means
from jaxunshear.evaluation.probes import fit_gaussian
from jaxunshear.files import Json

MIN_SLIP_SHARE = 0.99  # share of the touching skin that slips in a slide that counts as slipped
SEED = 0

Quantities = Mapping[str, np.ndarray]  # (N, 1) mm or deg by quantity


def estimate_slides(
    codes: Sequence[np.ndarray],
    targets: Sequence[Quantities],
    groups: np.ndarray,
    poses: np.ndarray,
    slipped: np.ndarray | None = None,
) -> list[Json]:
    """Estimate the slides of a test, and return a row of errors for each quantity.

    Args:
        codes: (N, F) of training, validation and test slides.
        targets: The slides of these three.
        groups: (N,) poses of training slides.
        poses: (M,) poses of test slides.
        slipped: (M,) which test slides have slipped, if that is known.
    """
    training_codes, *other_codes = codes
    training, validation, true = [_stack_quantities(each) for each in targets]
    count = len(validation)
    mean, deviation = fit_gaussian(training_codes, training, np.concatenate(other_codes), groups)
    scores = np.abs(mean[:count] - validation) / deviation[:count]
    scale = np.quantile(scores, min(1.0, LEVEL * (1 + 1 / count)), axis=0)
    error, half_width = mean[count:] - true, scale * deviation[count:]
    parts = {"all": np.ones(len(true), bool)}
    if slipped is not None:
        parts |= {"sticking": ~slipped, "slipped": slipped}
    rows = []
    for column, name in enumerate(targets[0]):
        for part, inside in parts.items():
            if inside.any():
                row = {"name": name, "part": part, "slides": int(inside.sum())}
                rows.append(
                    row | _score(error[inside, column], half_width[inside, column], poses[inside])
                )
    return rows


def is_slipping(stuck: np.ndarray, slips: np.ndarray) -> np.ndarray:
    """Say (N,) which slides have slipped, by the numbers of nodes that stick and that slip."""
    return slips >= MIN_SLIP_SHARE * np.maximum(stuck + slips, 1)


def _stack_quantities(quantities: Quantities) -> np.ndarray:
    return np.concatenate(list(quantities.values()), axis=1)


def _score(error: np.ndarray, half_width: np.ndarray, poses: np.ndarray) -> Json:
    covered = (np.abs(error) <= half_width).astype(np.float64)
    scores = {"mae": np.abs(error), "square": error**2, "coverage": covered}
    means = resample_means(scores, poses, SEED)
    return {
        "mae": float(np.abs(error).mean()),
        "mae interval": compute_interval(means["mae"]),
        "rmse": float(np.sqrt(np.mean(error**2))),
        "rmse interval": compute_interval(np.sqrt(means["square"])),
        "coverage": float(covered.mean()),
        "coverage interval": compute_interval(means["coverage"]),
        "half_width": float(half_width.mean()),
    }
