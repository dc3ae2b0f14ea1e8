"""Judgement of networks at their extremes: finite or stopped by name, never wrong.

    row = examine(case)

A case computes something and hands back what it found, or raises `UserError`. It promises one
outcome (or either of two), and whatever else happens breaks the promise: a number that is not
finite, a NaN that came in and does not come out, a line that does not say where, a kept checkpoint
that cannot be used, a traceback.
"""

import contextlib
import io
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import jax
import numpy as np

from jaxunshear.errors import UserError
from jaxunshear.models.weights import list_leaves
from jaxunshear.training import checkpoint

FINITE, STOPPED, REFUSED = "finite", "stopped, and said so", "refused"
PROMISED = (FINITE, STOPPED, REFUSED)
SAYS_WHERE = ("not finite at step", "batch", "checkpoint")  # in the line of a training that stops


@dataclass(frozen=True)
class CaseOutput:
    """What a case measured."""

    arrays: Mapping[str, object]  # trees that must be finite
    # trees that must hold a NaN, as one came in
    shown: Mapping[str, object] = field(default_factory=dict)
    error: float = np.nan  # at most `bar`, where there is one
    bar: float = np.nan
    wrong: str = ""  # what else does not hold
    note: str = ""  # what holds, and is worth knowing
    steps: int = 0
    loss: float = np.nan  # of the last step
    gradient: float = np.nan  # its norm there, or the largest number of it


@dataclass(frozen=True)
class NetworkCase:
    """A computation with networks, and what it promises."""

    name: str
    run: Callable[[Path], CaseOutput]  # in an empty folder
    expects: tuple[str, ...] = (FINITE,)  # outcomes that it promises
    words: tuple[str, ...] = ()  # that the message of a stop must hold


@dataclass(frozen=True)
class NetworkRow:
    """The outcome of one case; NaN where nothing was measured."""

    case: str
    outcome: str
    holds: bool  # it came out as promised
    finite: bool | None = None
    steps: int = 0
    loss: float = np.nan
    gradient: float = np.nan
    error: float = np.nan
    bar: float = np.nan
    # step of the checkpoint that a stopped training left, loaded and found finite
    kept: int | None = None
    seconds: float = np.nan
    said: str = ""


def examine(case: NetworkCase) -> NetworkRow:
    """Run and judge one case; an exception is a judgement too, and the other cases still run."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        row = _examine(case, Path(name))
    return replace(row, seconds=time.perf_counter() - start)


def _examine(case: NetworkCase, folder: Path) -> NetworkRow:
    row = NetworkRow(case.name, "", False)
    try:
        # each little training prints its progress
        with contextlib.redirect_stderr(io.StringIO()):
            output = case.run(folder)
        return _judge(case, row, output)
    except UserError as error:
        said = str(error).replace(str(folder), "FOLDER")
        return _judge_stop(case, replace(row, said=said), folder)
    except Exception as error:
        return replace(row, outcome="crashed", said=f"{type(error).__name__}: {error}")


def _judge(case: NetworkCase, row: NetworkRow, output: CaseOutput) -> NetworkRow:
    if not jax.tree.leaves(dict(output.arrays)):
        return replace(row, outcome="nothing was measured")
    broken = list_not_finite(output.arrays)
    row = replace(
        row,
        finite=not broken,
        steps=output.steps,
        loss=output.loss,
        gradient=output.gradient,
        error=output.error,
        bar=output.bar,
    )
    if broken:
        return replace(row, outcome="not finite", said=", ".join(broken[:5]))
    hidden = [name for name, tree in output.shown.items() if not list_not_finite({name: tree})]
    if hidden:
        return replace(row, outcome="hides a NaN", said=", ".join(hidden))
    if output.wrong:
        return replace(row, outcome="wrong", said=output.wrong)
    if not (np.isnan(output.bar) or output.error <= output.bar):
        return replace(row, outcome="off by more than allowed")
    if FINITE not in case.expects:
        return replace(row, outcome=f"neither {' nor '.join(case.expects)}")
    return replace(row, outcome=FINITE, holds=True, said=output.note)


def _judge_stop(case: NetworkCase, row: NetworkRow, folder: Path) -> NetworkRow:
    outcome = STOPPED if STOPPED in case.expects else REFUSED
    if outcome not in case.expects:
        return replace(row, outcome="stopped, though it can be computed")
    missing = [word for word in case.words if word not in row.said]
    if missing or "\n" in row.said:
        without = f"stopped by a line without '{', '.join(missing)}'"
        return replace(row, outcome=without if missing else "several lines")
    kept = checkpoint.find_latest_step(folder)
    if kept is not None:
        try:
            broken = list_not_finite(checkpoint.load_best(folder))
        except UserError as error:
            broken = [str(error)]
        if broken:
            outcome = "left a checkpoint that cannot be used"
            return replace(row, outcome=outcome, said=", ".join(broken[:5]))
    return replace(row, outcome=outcome, holds=True, kept=kept)


def list_not_finite(tree: Mapping[str, object]) -> list[str]:
    """List the dotted names of the arrays that hold a NaN or an infinity."""
    names = []
    for name, leaf in list_leaves(dict(tree)).items():
        if not np.isfinite(np.asarray(leaf, np.float64)).all():
            names.append(name)
    return names
