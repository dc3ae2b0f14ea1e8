"""Pin error: how far the pins seen in an image stand from where they should.

Similarity of images is blind to a grid shifted by a full pitch; centroids matched one to one are not.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from scipy.optimize import linear_sum_assignment

from jaxunshear.perception.pin_detection import find_pins


class PinMatch(NamedTuple):
    """Pins matched one to one: distances (K,) of the pairs, how many true pins were missed, how many found are extra."""

    error_px: np.ndarray
    missed: int
    extra: int


def match_pins(
    found: Float[np.ndarray, "N 2"], true: Float[np.ndarray, "P 2"], limit_px: float
) -> PinMatch:
    """Found pins to true pins, px, one to one with the least sum of squares; none beyond `limit_px`."""
    if len(found) == 0 or len(true) == 0:
        return PinMatch(np.zeros(0), len(true), len(found))
    distance = np.linalg.norm(np.asarray(found)[:, None] - np.asarray(true)[None], axis=-1)
    # Beyond the limit all are equally bad: a far outlier must not bend the pairs of the others.
    rows, columns = linear_sum_assignment(np.minimum(distance, 2 * limit_px) ** 2)
    error = distance[rows, columns]
    error = error[error <= limit_px]
    return PinMatch(error, len(true) - len(error), len(found) - len(error))


def measure_pin_error(
    images: UInt8[np.ndarray, "B S S"], true_px: Float[np.ndarray, "B P 2"], limit_px: float
) -> dict[str, float]:
    """`rms_px`, the root mean square distance of the pins found in images, white from half of full scale on, from true pins px as
    (column, row), matched within `limit_px`, NaN where none matched; `missed_per_image` and `extra_per_image`.
    """
    matches = [
        match_pins(find_pins(image), true, limit_px)
        for image, true in zip(images, true_px, strict=True)
    ]
    squares = np.concatenate([match.error_px for match in matches]) ** 2
    return {
        "rms_px": float(np.sqrt(squares.mean())) if squares.size else float("nan"),
        "missed_per_image": float(np.mean([match.missed for match in matches])),
        "extra_per_image": float(np.mean([match.extra for match in matches])),
    }
