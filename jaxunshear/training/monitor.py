"""Watch a training: its losses on the validation split, its kernels, numbers that are not finite.

Terms are inspected after every step, and the state before each checkpoint: the terms of a step come
from before its update, so they do not show weights that this update has broken.
"""

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np
import optax
from jax import Array

from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.models.weights import list_leaves
from jaxunshear.training import checkpoint
from jaxunshear.training.step import State, measure_kernel_sizes
from jaxunshear.training.tasks import Batch, Task, Tree

MAX_NAMED = 8  # examples in the line
GROUPS = ("train", "validation", "kernels")  # of a line of log.jsonl


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
    kept, checkpoints = checkpoint.list_kept_steps(folder), "no checkpoint was written yet"
    if kept:
        steps = " and the better one of step ".join(map(str, kept))
        checkpoints = f"the checkpoint of step {steps} is kept"
    return UserError(
        f"training {folder} stopped: {what} not finite at step {step}, of batch {number} "
        f"(batches({number}) begins with it again) {description}; "
        f"{checkpoints}; {remedy}"
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


def make_measurement(
    task: Task, validation: Callable[[], Iterator[Batch]]
) -> Callable[[State], Json]:
    """Make the function that measures a state on the validation split."""
    validate, measure_sizes = jax.jit(task.validate), jax.jit(measure_kernel_sizes)

    def measure(state: State) -> Json:
        scores = _mean_terms(validate, state.average, validation())
        sizes = {name: float(size) for name, size in measure_sizes(state.params).items()}
        return {"validation": scores, "kernels": sizes}

    return measure


def _mean_terms(
    validate: Callable[[Tree, Batch], dict[str, Array]], variables: Tree, batches: Iterator[Batch]
) -> dict[str, float | None]:
    """Average terms over all validation examples; None for a mean that is not finite (no JSON).

    A smaller last batch is filled up, so that nothing is compiled twice.
    """
    sums: dict[str, float] = {}
    count, full = 0, 0
    for batch in batches:
        size = len(next(iter(batch.values())))
        full = max(full, size)
        filled = {
            name: np.resize(np.asarray(value), (full, *np.shape(value)[1:]))
            for name, value in batch.items()
        }
        for name, values in jax.device_get(validate(variables, filled)).items():
            sums[name] = sums.get(name, 0.0) + float(np.sum(values[:size], dtype=np.float64))
        count += size
    if not count:
        raise UserError("the validation split is empty: ask for more poses")
    return {name: total / count if math.isfinite(total) else None for name, total in sums.items()}


@contextlib.contextmanager
def open_events(folder: Path, step: int, rate: optax.Schedule) -> Iterator[Callable[[Json], None]]:
    """Open an event file in `folder`; yield a function that appends a line of the log to it.

    TensorBoard then drops what a stopped process wrote beyond `step`. `rate` returns the learning
    rate of a step from 0. Without tensorboardX nothing is written.
    """
    try:
        # EventsWriter writes at once: no thread can fail unnoticed
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog
        from tensorboardX.proto.summary_pb2 import Summary
    except ImportError:
        yield lambda line: None
        return

    def append(line: Json) -> None:
        values = list_scalars(line) | {"learning_rate": float(rate(line["step"] - 1))}
        summary = Summary(
            value=[Summary.Value(tag=tag, simple_value=value) for tag, value in values.items()]
        )
        writer.write_event(Event(wall_time=time.time(), step=line["step"], summary=summary))
        writer.flush()

    with contextlib.closing(EventsWriter(str(folder / "events"))) as writer:
        start = SessionLog(status=SessionLog.START)
        writer.write_event(Event(wall_time=time.time(), step=step + 1, session_log=start))
        yield append


def list_scalars(line: Json) -> dict[str, float]:
    """Return the known figures of a line of log.jsonl by tag."""
    return {
        f"{group}/{name}": float(value)
        for group in GROUPS
        for name, value in (line.get(group) or {}).items()
        if value is not None
    }
