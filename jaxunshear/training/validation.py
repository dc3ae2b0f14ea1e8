"""Measure the state of a training: its losses on the validation split, and its kernels."""

import math
from collections.abc import Callable, Iterator

import jax
import numpy as np
from jax import Array

from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.training.step import State, measure_kernel_sizes
from jaxunshear.training.tasks import Batch, Task, Tree


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
