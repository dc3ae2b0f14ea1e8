"""What is counted while a folder is answered: images that are left out, and errors against the labels that came with the others."""

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
    """Images that were read and not understood: counted by reason, and noted."""

    def __init__(self, recordings: "Recordings") -> None:
        self._notes = recordings.notes
        self._reasons: Counter[str] = Counter()

    @property
    def count(self) -> int:
        return self._reasons.total()

    def add(self, name: str, doubt: str) -> str:
        """Count an image if there is a `doubt`, which is returned."""
        if doubt:
            self._reasons[str(doubt)] += 1
            self._notes.append(f"left out {name}: {doubt}")
        return str(doubt)

    def report(self, log: Log) -> None:
        for reason, count in self._reasons.items():
            log(f"left out {count}: {reason}")


class LabelErrors:
    """Errors of what a model reads against the labels that came with the images, where these are of the same names."""

    def __init__(self, names: tuple[str, ...], recordings: "Recordings") -> None:
        labels = {"pose": recordings.poses, "move": recordings.moves}
        true = {
            name: values[:, column]
            for name, (field, column) in (RECORDED_FIELDS | LABELLED_SLIDES).items()
            if name in names and (values := labels[field]) is not None
        }
        self._true = true if len(true) == len(names) else None
        self._found: dict[str, list[np.ndarray]] = {}

    def add(self, rows: list[int], answers: "Predictions") -> None:
        if self._true is None:
            return
        from jaxunshear.metrics.pose_error import compute_pose_errors

        true = {name: values[rows] for name, values in self._true.items()}
        for way, poses in answers.poses.items():
            for name, error in compute_pose_errors(
                {n: v[: len(rows)] for n, v in poses.items()}, true
            ).items():
                self._found.setdefault(f"{way}.{name}", []).append(error[np.isfinite(error)])

    def means(self) -> dict[str, float]:
        found = {name: np.concatenate(parts) for name, parts in self._found.items()}
        return {
            name: float(errors.mean(dtype=np.float64))
            for name, errors in found.items()
            if len(errors)
        }

    def rows(self) -> list[Measurement]:
        return [
            make_row(f"pose_mae.{name}", value, name.rpartition("_")[2])
            for name, value in self.means().items()
        ]

    def report(self, log: Log) -> None:
        by_way: dict[str, list[str]] = {}
        for name, value in self.means().items():
            way, target = name.split(".")
            by_way.setdefault(way, []).append(f"{target} {value:.3f}")
        for way, parts in by_way.items():
            log(f"mean error against the labels, {way}: {', '.join(parts)}")
