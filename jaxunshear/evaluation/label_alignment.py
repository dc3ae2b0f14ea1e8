"""Align predictions with the labels of recordings, by a sign and an offset for each label.

The labels are of taps on a straight edge. What a network predicts of them, edge distance, edge
angle and depth, has an offset and a sign of its own.
"""

from typing import NamedTuple

import numpy as np

from jaxunshear.config.targets import MIN_VARIATION, RECORDED_FIELDS
from jaxunshear.errors import UserError

LABEL_TARGETS = {  # the predicted quantity that belongs to a label
    "x_mm": "edge_mm",
    "y_mm": "edge_mm",
    "z_mm": "depth_mm",
    "Rz_deg": "edge_deg",
}


class LabelAlignment(NamedTuple):
    """label = sign * predicted target + offset."""

    target: str
    sign: int
    offset: float

    def apply(self, poses: dict[str, np.ndarray]) -> np.ndarray:
        return self.sign * poses[self.target] + self.offset


def choose_scored_labels(poses: dict[str, np.ndarray], labels: np.ndarray) -> tuple[str, ...]:
    """Choose the labels (N, 6) that vary and that a predicted quantity (N,) belongs to.

    Raises UserError if none does, or if both x and y vary: along an edge the pose is not defined.
    """
    names = []
    for name, target in LABEL_TARGETS.items():
        if target in poses and np.ptp(get_label(name, labels)) > MIN_VARIATION:
            names.append(name)
    if not names or {"x_mm", "y_mm"} <= set(names):
        raise UserError(
            "these labels are not of a straight edge, across which x or y varies: "
            "only such can be scored"
        )
    return tuple(names)


def get_label(name: str, labels: np.ndarray) -> np.ndarray:
    """Return one label (N,) of labels (N, 6)."""
    _, column = RECORDED_FIELDS[name]
    return labels[:, column]


def align_to_labels(name: str, poses: dict[str, np.ndarray], labels: np.ndarray) -> LabelAlignment:
    """Find the sign with the least scatter of one label, and the offset.

    The offset is the median of the differences, or the mean direction of an angle's. `poses` (N,)
    are NaN for taps without a prediction. Raises UserError if all are.
    """
    target = LABEL_TARGETS[name]
    predicted, label = poses[target], get_label(name, labels)
    finite = np.isfinite(predicted)
    if not finite.any():
        raise UserError("no tap could be read: these are not images of the model's sensor")
    candidates = []
    for sign in (1, -1):
        offsets = label[finite] - sign * predicted[finite]
        if name.endswith("_deg"):
            mean = np.mean(np.exp(1j * np.radians(offsets)))
            scatter, offset = 1 - abs(mean), float(np.degrees(np.angle(mean)))
        else:
            scatter, offset = float(np.std(offsets)), float(np.median(offsets))
        candidates.append((scatter, LabelAlignment(target, sign, offset)))
    _, best = min(candidates, key=lambda candidate: candidate[0])
    return best
