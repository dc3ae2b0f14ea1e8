"""Counts of rejected images, and errors of predictions against the labels of a folder."""

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from jaxunshear.config.targets import LABELLED_SLIDES, RECORDED_FIELDS
from jaxunshear.results.measurement import Measurement

if TYPE_CHECKING:
    from jaxunshear.data.recordings import Recordings
    from jaxunshear.inference.perceiver import Predictions

Log = Callable[[str], None]


def make_row(name: str, value: float, unit: str) -> Measurement:
    return Measurement(name, value, unit, None, None, None, name.split(".")[-1])


def count_rows(command: str, used: int, recordings: "Recordings") -> list[Measurement]:
    return [
        make_row(f"{command}.images", used, "1"),
        make_row(f"{command}.left_out", len(recordings) - used, "1"),
    ]


class RejectedImages:
    """Images that were read and rejected: counted by reason, and noted."""

    def __init__(self, recordings: "Recordings") -> None:
        self._notes = recordings.notes
        self._reasons: Counter[str] = Counter()

    @property
    def count(self) -> int:
        return self._reasons.total()

    def add(self, name: str, reason: str) -> str:
        """Count an image if there is a `reason` to reject it, which is returned."""
        reason = str(reason)
        if reason:
            self._reasons[reason] += 1
            self._notes.append(f"left out {name}: {reason}")
        return reason

    def report(self, log: Log) -> None:
        for reason, count in self._reasons.items():
            log(f"left out {count}: {reason}")


class LabelErrors:
    """Errors of predicted poses, if the labels have all the names of the poses."""

    def __init__(self, names: tuple[str, ...], recordings: "Recordings") -> None:
        labels = {"pose": recordings.poses, "move": recordings.moves}
        true = {
            name: values[:, column]
            for name, (field, column) in (RECORDED_FIELDS | LABELLED_SLIDES).items()
            if name in names and (values := labels[field]) is not None
        }
        self._true = true if len(true) == len(names) else None
        self._errors: dict[str, list[np.ndarray]] = {}

    def add(self, rows: list[int], predictions: "Predictions") -> None:
        if self._true is None:
            return
        from jaxunshear.metrics.pose_error import compute_pose_errors

        true = {name: values[rows] for name, values in self._true.items()}
        for kind, poses in predictions.poses.items():
            predicted = {name: values[: len(rows)] for name, values in poses.items()}
            for name, error in compute_pose_errors(predicted, true).items():
                finite = error[np.isfinite(error)]
                self._errors.setdefault(f"{kind}.{name}", []).append(finite)

    def means(self) -> dict[str, float]:
        means = {}
        for name, batches in self._errors.items():
            errors = np.concatenate(batches)
            if len(errors):
                means[name] = float(errors.mean(dtype=np.float64))
        return means

    def rows(self) -> list[Measurement]:
        return [
            make_row(f"pose_mae.{name}", value, name.rpartition("_")[2])
            for name, value in self.means().items()
        ]

    def report(self, log: Log) -> None:
        by_kind: dict[str, list[str]] = {}
        for name, value in self.means().items():
            kind, target = name.split(".")
            by_kind.setdefault(kind, []).append(f"{target} {value:.3f}")
        for kind, parts in by_kind.items():
            log(f"mean error against the labels, {kind}: {', '.join(parts)}")
