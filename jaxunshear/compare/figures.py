"""Figures of several runs side by side, and what each differs from the first by. Pure functions of what runs left.

A difference is of pairs: both runs were scored on the same contacts, so each resample draws the same poses for both.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxunshear.compare.runs import OWN, Run, same_inputs, same_test
from jaxunshear.evaluation import spread
from jaxunshear.report import words
from jaxunshear.results.sweep import Figure
from jaxunshear.storage import Json
from jaxunshear.sweep.scores import called, names_in, same_contacts
from jaxunshear.sweep.summary import differences, metrics, recoveries, recovery_errors, redrawn_recovery

LIKENESS = ("ms_ssim", "swap", "pins", "pin_error")  # of images or pins, which must be of one kind
WITHIN = "difference"  # of networks of one run: its report has them
BETTER = {"ms_ssim": 1, "pose_recovery": 1, "pose": -1, "read": -1, "pins": -1, "pin_error": -1, "half_width": -1}


class Compared(NamedTuple):
    """`mean` and `interval` (None where there is none) in each run; `less` is that less the first run's. None where it has none."""

    name: str  # as a sweep calls it: `pose/tap/edge_mm`, `unseen: ms_ssim/disentangled`
    of: tuple[Figure | None, ...]
    less: tuple[Figure | None, ...]

    @property
    def table(self) -> str:
        return table_of(self.name)

    def verdict(self, run: int) -> str:
        """Of a difference whose interval is known: better, worse, or within chance."""
        less, sign = self.less[run], BETTER.get(self.table, 0)
        if not less or not less.interval or not sign:
            return ""
        low, high = less.interval
        return "within chance" if low <= 0 <= high else "better" if low * sign > 0 else "worse"


def table_of(name: str) -> str:
    return name.rpartition(": ")[2].partition("/")[0]


def figures(runs: Sequence[Run]) -> list[Compared]:
    """All that any of the runs has; names in the order of the first that has them."""
    found = [metrics(run.rows) for run in runs]
    less = [{}, *(_differences(run, runs[0]) for run in runs[1:])]
    names = dict.fromkeys(name for each in found for name in each if table_of(name) != WITHIN)
    return [Compared(name, *(tuple(each.get(name) for each in column) for column in (found, less))) for name in names]


def _differences(run: Run, first: Run) -> dict[str, Figure]:
    """Nothing where the runs were scored on different contacts."""
    if not same_test(run, first):
        return {}
    found = differences(run.rows, first.rows) | _recoveries(run, first)
    return {name: figure for name, figure in found.items() if same_inputs(run, first) or table_of(name) not in LIKENESS}


def _recoveries(run: Run, first: Run) -> dict[str, Figure]:
    """Of the shares of the damage undone, which are no means over contacts: resample by resample."""
    found = {}
    (mine, own), (theirs, other) = ((recoveries(each.rows), _redrawn(each)) for each in (run, first))
    for name in mine.keys() & theirs.keys() & own.keys() & other.keys():
        (tests, redrawn), (_, others) = own[name], other[name]
        if not all(same_contacts(run.rows, first.rows, test) for test in tests):
            continue
        interval = None if redrawn is None or others is None else spread.interval(redrawn - others)
        found[name] = Figure(mine[name].mean - theirs[name].mean, interval)
    return found


def _redrawn(run: Run) -> dict[str, tuple[list[str], np.ndarray | None]]:
    """By name of a recovery: the tests that its errors are of, and its resamples where it has bounds in all of them."""
    found = {}
    names = dict.fromkeys(names_in(run.rows))
    for test, name in names:
        errors = recovery_errors(run.rows, names, test, name)
        if errors is not None:
            redrawn = redrawn_recovery([(values, poses) for _, values, poses in errors])
            found[called(test, name.replace("pose/", "pose_recovery/", 1))] = [place for place, _, _ in errors], redrawn
    return found


def main_figures(runs: Sequence[Run], every: Sequence[Compared]) -> list[Compared]:
    """Those that a terminal has room for: of the network that the runs are about, at most seven."""
    kind = runs[0].shown if len({run.shown for run in runs}) == 1 else OWN
    chief = words.chief(runs[0].results)
    wanted = [f"ms_ssim/{kind}", *(f"{table}/{kind}/{q}" for table in ("pose", "pose_recovery") for q in chief)]
    if kind == "sheared":
        wanted = [f"pose/{way}/{q}" for way in ("tap", "sheared_learnt") for q in chief]
    named = {figure.name: figure for figure in every}
    return [named[name] for name in wanted if name in named][:7]


def rows_of(runs: Sequence[Run], every: Sequence[Compared]) -> list[Json]:
    """For machines: a row a figure and run."""
    return [
        {"name": figure.name, "run": str(run.folder)}
        | {"value": of and of.mean, "interval": of and of.interval}
        | {"difference": less and less.mean, "difference_interval": less and less.interval}
        for figure in every
        for run, of, less in zip(runs, figure.of, figure.less, strict=True)
    ]
