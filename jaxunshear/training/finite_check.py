"""Stop a training whose numbers are no longer finite.

Terms are inspected after every step, and the state before each checkpoint: the terms of a step come
from before its update, so they do not show weights that this update has broken.
"""

import math
from pathlib import Path

import jax
import numpy as np
from jax import Array

from jaxunshear.errors import UserError
from jaxunshear.models.weights import list_leaves
from jaxunshear.training import checkpoint
from jaxunshear.training.step import State
from jaxunshear.training.tasks import Batch

MAX_NAMED = 8  # examples in the line


def check_terms(step: int, terms: dict[str, Array], batch: Batch, folder: Path) -> dict[str, float]:
    """Return the terms of a step (the first is 1) as floats.

    Raises UserError if one is not finite.
    """
    values = {name: float(value) for name, value in jax.device_get(terms).items()}
    broken = [name for name, value in values.items() if not math.isfinite(value)]
    if broken:
        causes = [name for name in broken if name != "gradient"]  # it follows from the others
        raise _make_error(", ".join(causes or broken), step, batch, folder)
    return values


def check_state(state: State, step: int, batch: Batch, folder: Path) -> None:
    """Raise UserError if an array of the state after `step` is not finite."""
    for name, leaf in list_leaves(jax.device_get(state)).items():
        if not np.isfinite(leaf).all():
            raise _make_error(name, step, batch, folder)


def _make_error(what: str, step: int, batch: Batch, folder: Path) -> UserError:
    """Make the error that names step, term, batch, the checkpoints that are kept and a remedy."""
    number = step - 1
    description, remedy = _inspect_batch(batch)
    return UserError(
        f"training {folder} stopped: {what} not finite at step {step}, of batch {number} "
        f"(batches({number}) begins with it again) {description}; "
        f"{_describe_checkpoints(folder)}; {remedy}"
    )


def _inspect_batch(batch: Batch) -> tuple[str, str]:
    """Return a description of the batch, and the remedy."""
    arrays = {name: np.asarray(values) for name, values in jax.device_get(batch).items()}
    wrong = []
    for name, array in arrays.items():
        rows = np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(1)).tolist()
        if rows:
            more = ", ..." if len(rows) > MAX_NAMED else ""
            wrong.append(f"{name} of examples {', '.join(map(str, rows[:MAX_NAMED]))}{more}")
    if wrong:
        return (
            f"with NaN or infinity in {'; '.join(wrong)}",
            "fix the data, then run the same command",
        )
    least = min(array.min() for array in arrays.values())
    most = max(array.max() for array in arrays.values())
    remedy = "if these are as they should be, lower learning_rate (in another folder)"
    return f"whose numbers are {least:g} to {most:g}", remedy


def _describe_checkpoints(folder: Path) -> str:
    steps = checkpoint.list_kept_steps(folder)
    if not steps:
        return "no checkpoint was written yet"
    return f"the checkpoint of step {' and the better one of step '.join(map(str, steps))} is kept"
