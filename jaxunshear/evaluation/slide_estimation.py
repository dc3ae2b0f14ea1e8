"""Estimate the slide from both codes, with an uncertainty.

A small network learns mean and deviation of each quantity from the codes of training slides. Its
deviations are then scaled until the intervals contain 95 % of the validation slides (split
conformal: no distribution is assumed), and are tested on others.

Once all the skin that touches slips, the camera does not show how far the sensor went: the
commanded slide and the shear of the skin differ.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxunshear.evaluation.bootstrap import LEVEL, compute_interval, resample_means
from jaxunshear.evaluation.probes import fit_gaussian, prepare_task
from jaxunshear.files import Json

MIN_SLIP_SHARE = 0.99  # share of the touching skin that slips in a slide that counts as slipped
SEED = 0


class CodedSlides(NamedTuple):
    codes: np.ndarray  # (N, F)
    slides: Mapping[str, np.ndarray]  # (N, 1) mm or deg by quantity
    poses: np.ndarray  # (N,) which pose a slide belongs to

    def stack_slides(self) -> np.ndarray:
        return np.concatenate(list(self.slides.values()), axis=1)


def estimate_slides(
    splits: Mapping[str, CodedSlides], contact_state: Mapping[str, np.ndarray]
) -> list[Json]:
    """Estimate the slides of the test split; return errors by quantity and `split_by_slip`."""
    train, validation, test = splits["train"], splits["validation"], splits["test"]
    codes = np.concatenate([validation.codes, test.codes])
    task = prepare_task(train.codes, train.stack_slides(), codes, train.poses)
    mean, deviation = fit_gaussian(task)
    count, true = len(validation.codes), test.stack_slides()
    scores = np.abs(mean[:count] - validation.stack_slides()) / deviation[:count]
    scale = np.quantile(scores, min(1.0, LEVEL * (1 + 1 / count)), axis=0)
    error, half_width = mean[count:] - true, scale * deviation[count:]
    parts = {"all": np.ones(len(true), bool), **split_by_slip(contact_state)}
    rows = []
    for column, name in enumerate(test.slides):
        for part, inside in parts.items():
            if inside.any():
                row = {"name": name, "part": part, "slides": int(inside.sum())}
                errors = error[inside, column], half_width[inside, column]
                rows.append(row | _score(*errors, test.poses[inside]))
    return rows


def split_by_slip(contact_state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Say (N,) which slides still stick somewhere, and which slip everywhere.

    `contact_state` has the numbers of nodes that are `stuck` and `slipping`; nothing is known of
    recorded slides, which lack both.
    """
    if "stuck" not in contact_state:
        return {}
    stuck, slipping = contact_state["stuck"], contact_state["slipping"]
    slipped = slipping >= MIN_SLIP_SHARE * np.maximum(stuck + slipping, 1)
    return {"sticking": ~slipped, "slipped": slipped}


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
