"""Training: one jitted, donated step, validation, checkpoints, and going on after a kill.

>>> task = unshear_task(net, training)
>>> train(task, training, batches, validation, seed=0, folder=Path("runs/demo/disentangled"), epoch_images=2160)

`batches(start_step)` is an endless iterator of batches, the same ones whichever step it starts from; `validation()` a
finite one. All randomness of a step follows from the seed and the step's number, so a run that was killed ends with
the very bits of an undisturbed one. (The losses are in tasks.py, the step in step.py.)
"""

import dataclasses
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxunshear import storage
from jaxunshear.errors import UserError
from jaxunshear.memory import keep_freed_memory
from jaxunshear.metrics.machine import machine
from jaxunshear.progress import Progress
from jaxunshear.settings.targets import to_json
from jaxunshear.settings.training import Training
from jaxunshear.training import checkpoint
from jaxunshear.training.guard import check_state, check_terms
from jaxunshear.training.losses import kernel_sizes
from jaxunshear.training.start import Start, started
from jaxunshear.training.step import fresh, make_step, optimiser_of
from jaxunshear.training.tasks import Batch, Task, Tree

Batches = Callable[[int], Iterator[Batch]]
Validation = Callable[[], Iterator[Batch]]


@dataclass(frozen=True)
class Summary:
    """What a finished training says of itself; also in FOLDER/summary.json."""

    kind: str
    steps: int
    images: int  # seen, with repeats
    parameters: int
    best_step: int
    best_loss: float  # validation
    train_seconds: float  # steps and their data, without compilation, validation and checkpoints
    compile_seconds: float
    images_per_second: float
    trained_on: dict[str, Any] = field(default_factory=dict)  # the machine that ended it; of earlier versions unknown


SUMMED = tuple(each.name for each in dataclasses.fields(Summary) if each.name != "trained_on")


def train(
    task: Task,
    training: Training,
    batches: Batches,
    validation: Validation,
    seed: int,
    folder: Path,
    *,
    epoch_images: int,
    origin: Any = None,
    taken_over: Sequence[Any] = (),
    start: Start | None = None,
) -> Summary:
    """Train the network of `task` into `folder`, or go on where it stopped, or return at once if finished.

    Batches are those of the task. `epoch_images` examples are one epoch. `origin` is any JSON that says where the data come from,
    `taken_over` a list of more that was learnt through others (`training/origin.py`); a folder trained from other origins or with
    other settings is refused.
    `start`: weights to go on from in the place of fresh ones, wherever they have the same parts.
    Raises UserError (a loss or a state that is not finite, a damaged checkpoint, settings that do not fit).
    """
    folder = Path(folder)
    asked = {"kind": task.kind, "net": asdict(task.net), "training": asdict(training), "seed": seed}
    asked |= {"epoch_images": epoch_images, "targets": to_json(task.targets), "origin": origin}
    asked |= {"taken_over": taken_over}
    checkpoint.write_settings(folder, asked | ({"start": start.digest} if start else {}))
    if (folder / checkpoint.SUMMARY).exists():
        return _summary(folder / checkpoint.SUMMARY)
    keep_freed_memory()
    batch_size, steps_per_epoch = training.batch, epoch_images / training.batch
    steps = max(1, round(training.epochs * steps_per_epoch))
    optimiser = optimiser_of(training, steps, steps_per_epoch)
    key_init, key_steps = jax.random.split(jax.random.key(seed))

    def first(key, given):
        variables = task.init(key)
        return fresh(started(variables, given) if start else variables, optimiser)

    state = jax.jit(first, compiler_options=run_once())(key_init, start.variables if start else None)
    history: list[dict[str, Any]] = []
    best_step, best_loss, seconds, compile_seconds = 0, math.inf, 0.0, 0.0
    reached = checkpoint.latest(folder) or 0
    if reached:
        state, record = checkpoint.restore(folder, reached, state)
        history, best_step, seconds = record["history"], record["best_step"], record["train_seconds"]
        compile_seconds = record["compile_seconds"]
        best_loss = min(_ranked(line["validation"][task.rank]) for line in history)
    _write_log(folder, history)

    stream = iter(batches(reached))
    batch = jax.device_put(next(stream))
    began = time.perf_counter()
    step = jax.jit(make_step(task, training, optimiser, key_steps), donate_argnums=0).lower(state, batch).compile()
    validate, measure = jax.jit(task.validate), jax.jit(kernel_sizes)
    compile_seconds += time.perf_counter() - began

    with Progress(f"train {folder.name}", steps * batch_size, done=reached * batch_size) as progress:
        began = time.perf_counter()
        waiting: list[tuple[int, dict[str, Array], Batch]] = []
        for done in range(reached + 1, steps + 1):
            state, metrics = step(state, batch)
            waiting.append((done, metrics, batch))
            if done < steps:
                batch = jax.device_put(next(stream))  # read while the step runs
            at_checkpoint = done % training.validate_every == 0 or done == steps
            while len(waiting) > (0 if at_checkpoint else 1):
                ready = waiting.pop(0)
                last = check_terms(*ready, folder)
            progress.advance(batch_size)
            if not at_checkpoint:
                continue
            seconds += time.perf_counter() - began
            check_state(state, done, ready[2], folder)
            scores = _mean_terms(validate, state.average, validation())
            if best_step == 0 or _ranked(scores[task.rank]) < best_loss:
                best_step, best_loss = done, _ranked(scores[task.rank])
            counts = {
                "step": done,
                "epoch": done / steps_per_epoch,
                "images": done * batch_size,
                "train_seconds": seconds,
            }
            sizes = {name: float(size) for name, size in measure(state.params).items()}
            history.append(counts | {"train": last, "validation": scores, "kernels": sizes})
            times = {"train_seconds": seconds, "compile_seconds": compile_seconds}
            checkpoint.save(folder, done, state, {"history": history, "best_step": best_step} | times)
            _write_log(folder, history)
            began = time.perf_counter()

    if math.isinf(best_loss):
        hint = "check for broken data in the validation split, or lower learning_rate, and train in another folder"
        raise UserError(f"training {folder}: its validation loss ({task.rank}) was never finite; {hint}")
    summary = Summary(
        kind=task.kind,
        steps=steps,
        images=steps * batch_size,
        parameters=sum(leaf.size for leaf in jax.tree.leaves(state.params)),
        best_step=best_step,
        best_loss=best_loss,
        train_seconds=seconds,
        compile_seconds=compile_seconds,
        images_per_second=steps * batch_size / seconds,
        trained_on=machine(),
    )
    storage.write_json(folder / checkpoint.SUMMARY, asdict(summary))
    return summary


def run_once() -> dict[str, int] | None:
    """Options to compile first states with: random numbers for every kernel are much code, which took a CPU longer to optimise than
    the step. The bits are the same."""
    return {"xla_backend_optimization_level": 1} if jax.default_backend() == "cpu" else None


def _mean_terms(validate, variables: Tree, batches: Iterator[Batch]) -> dict[str, float | None]:
    """Means over all validation examples, None where one is not finite (JSON has no NaN).

    A smaller last batch is filled up, so that nothing is compiled twice.
    """
    sums: dict[str, float] = {}
    count, full = 0, 0
    for batch in batches:
        size = len(next(iter(batch.values())))
        full = max(full, size)
        filled = {name: np.resize(np.asarray(value), (full, *np.shape(value)[1:])) for name, value in batch.items()}
        for name, values in jax.device_get(validate(variables, filled)).items():
            sums[name] = sums.get(name, 0.0) + float(np.sum(values[:size], dtype=np.float64))
        count += size
    if not count:
        raise UserError("the validation split is empty: ask for more poses")
    return {name: total / count if math.isfinite(total) else None for name, total in sums.items()}


def _ranked(loss: float | None) -> float:
    """A loss that was not finite ranks last."""
    return math.inf if loss is None else loss


def _write_log(folder: Path, history: list[dict[str, Any]]) -> None:
    """log.jsonl anew from the checkpoint's history, so that it never holds a line twice or one of a lost step."""
    storage.write_text(folder / "log.jsonl", "".join(json.dumps(line) + "\n" for line in history))


def _summary(path: Path) -> Summary:
    stored = storage.read_json(path)
    try:
        known = {name: stored[name] for name in SUMMED}
        return Summary(**known, trained_on=stored.get("trained_on", {}))
    except (KeyError, TypeError) as error:
        raise UserError(f"{path} lacks {error}: delete it to go on from the latest checkpoint") from error
