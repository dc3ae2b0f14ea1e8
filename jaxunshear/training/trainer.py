"""Training: one jitted, donated step, validation, checkpoints, and going on after a kill.

>>> task = unshear_task(net, training)
>>> train(task, training, batches, validation, seed=0, folder=Path("runs/demo/disentangled"), epoch_images=2160)

`batches(start_step)` is an endless iterator of batches, the same ones whichever step it starts from; `validation()` a
finite one. All randomness of a step follows from the seed and the step's number, so a run that was killed ends with
the very bits of an undisturbed one. (The losses are in tasks.py, the step in step.py.)
"""

import contextlib
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import optax
from jax import Array

from jaxunshear import files
from jaxunshear.allocator import keep_freed_memory
from jaxunshear.code_version import read_source
from jaxunshear.config.targets import to_json
from jaxunshear.config.training import Training
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.metrics.machine import describe_machine
from jaxunshear.models import layer_choice
from jaxunshear.models.fast import compiled_kernels
from jaxunshear.progress import Progress
from jaxunshear.results import record_files
from jaxunshear.results.measurement import TrainingSummary
from jaxunshear.training import checkpoint
from jaxunshear.training.devices import Devices, get_devices
from jaxunshear.training.finite_check import check_state, check_terms
from jaxunshear.training.initial_weights import InitialWeights, begin_from
from jaxunshear.training.losses import measure_kernel_sizes
from jaxunshear.training.prefetch import prefetch
from jaxunshear.training.step import State, init_state, make_optimiser, make_schedule, make_step
from jaxunshear.training.tasks import Batch, Task, Tree
from jaxunshear.training.tensorboard import open_events

Batches = Callable[[int], Iterator[Batch]]
Validation = Callable[[], Iterator[Batch]]
RESUME_REMEDY = "delete it to go on from the latest checkpoint"


class TrainingLength(NamedTuple):
    """Of a training."""

    steps: int
    steps_per_epoch: float
    batch: int  # images in a step


@dataclass
class TrainingProgress:
    """How far a training has come: what a checkpoint keeps beside its state."""

    step: int = 0
    history: list[Json] = field(default_factory=list)  # a line a checkpoint
    best_step: int = 0
    best_loss: float = math.inf
    seconds: float = 0.0
    compile_seconds: float = 0.0


def train(
    task: Task,
    training: Training,
    batches: Batches,
    validation: Validation,
    seed: int,
    folder: Path,
    *,
    epoch_images: int,
    origin: object = None,
    data: Sequence[str] = (),
    start: InitialWeights | None = None,
) -> TrainingSummary:
    """Train the network of `task` into `folder`, or go on where it stopped, or return at once if finished.

    Batches are those of the task. `epoch_images` examples are one epoch. `origin` is any JSON that says where the data come from,
    `data` the digests of all that was learnt (`training/initial_weights.py`); a folder trained from other origins or with other settings is
    refused.
    `start`: weights to go on from in the place of fresh ones, wherever they have the same parts.
    Raises UserError (a loss or a state that is not finite, a damaged checkpoint, settings that do not fit).
    """
    folder = Path(folder)
    asked = {"kind": task.kind, "net": asdict(task.net), "training": asdict(training), "seed": seed}
    asked |= {"epoch_images": epoch_images, "targets": to_json(task.targets), "origin": origin}
    asked |= {"data": data} | (
        {"slides": to_json(task.slide_targets)} if task.slide_targets else {}
    )
    checkpoint.write_settings(folder, asked | ({"start": start.digest} if start else {}))
    if (folder / checkpoint.SUMMARY).exists():
        return record_files.read_record(folder / checkpoint.SUMMARY, TrainingSummary, RESUME_REMEDY)
    devices = get_devices(training.batch)
    keep_freed_memory()
    steps_per_epoch = epoch_images / training.batch
    length = TrainingLength(
        max(1, round(training.epochs * steps_per_epoch)), steps_per_epoch, training.batch
    )
    optimiser = make_optimiser(training, length.steps, steps_per_epoch)
    key_init, key_steps = jax.random.split(jax.random.key(seed))
    state, reached = _restore_latest(
        folder, make_first_state(task, optimiser, key_init, start), task.rank
    )
    _write_log(folder, reached.history)
    step = make_step(task, training, optimiser, key_steps)
    rate = make_schedule(training, length.steps, steps_per_epoch)
    with (
        compiled_kernels.use_form("xla") if devices.mesh else contextlib.nullcontext()
    ):  # what is compiled cannot be split
        with (
            contextlib.closing(prefetch(iter(batches(reached.step)), devices.with_batch)) as stream,
            open_events(folder, reached.step, rate) as log,
        ):
            state = _run(
                step,
                state,
                reached,
                length,
                task,
                training,
                stream,
                validation,
                folder,
                devices,
                log,
            )
        parameters = sum(leaf.size for leaf in jax.tree.leaves(state.params))
        return _finish(task, parameters, reached, length, folder, devices)


def make_first_state(
    task: Task,
    optimiser: optax.GradientTransformation,
    key: Array,
    start: InitialWeights | None = None,
) -> State:
    """Before the first step."""

    def first(key: Array, given: Tree) -> State:
        variables = task.init(key)
        return init_state(begin_from(variables, given) if start else variables, optimiser)

    return jax.jit(first, compiler_options=get_compile_options())(
        key, start.variables if start else None
    )


def _restore_latest(folder: Path, state: State, rank: str) -> tuple[State, TrainingProgress]:
    """The latest checkpoint's; where there is none, `state` as it is and nothing reached."""
    step = checkpoint.find_latest_step(folder)
    if not step:
        return state, TrainingProgress()
    state, record = checkpoint.restore(folder, step, state)
    history, best_step = record["history"], record["best_step"]
    best_loss = min(_rank_loss(line["validation"][rank]) for line in history)
    return state, TrainingProgress(
        step, history, best_step, best_loss, record["train_seconds"], record["compile_seconds"]
    )


def _run(
    step: Callable[[State, Batch], tuple[State, dict[str, Array]]],
    state: State,
    training_progress: TrainingProgress,
    length: TrainingLength,
    task: Task,
    training: Training,
    stream: Iterator[Batch],
    validation: Validation,
    folder: Path,
    devices: Devices,
    log: Callable[[Json], None],
) -> State:
    """All steps that are left, with their checkpoints. Returns the last state; `training_progress` goes along."""
    state, batch = devices.with_state(state), next(stream)
    began = time.perf_counter()
    compiled = (
        jax.jit(step, donate_argnums=0, out_shardings=devices.on_each).lower(state, batch).compile()
    )
    validate, measure = jax.jit(task.validate), jax.jit(measure_kernel_sizes)
    training_progress.compile_seconds += time.perf_counter() - began

    with Progress(
        f"train {folder.name}",
        length.steps * length.batch,
        done=training_progress.step * length.batch,
    ) as progress:
        began = time.perf_counter()
        waiting: list[tuple[int, dict[str, Array], Batch]] = []
        for done in range(training_progress.step + 1, length.steps + 1):
            state, metrics = compiled(state, batch)
            waiting.append((done, metrics, batch))
            if done < length.steps:
                batch = next(stream)
            at_checkpoint = done % training.validate_every == 0 or done == length.steps
            while len(waiting) > (0 if at_checkpoint else 1):
                ready = waiting.pop(0)
                last = check_terms(*ready, folder)
            progress.advance(length.batch)
            if not at_checkpoint:
                continue
            training_progress.step, training_progress.seconds = (
                done,
                training_progress.seconds + time.perf_counter() - began,
            )
            check_state(state, done, ready[2], folder)
            scores = _mean_terms(validate, state.average, validation())
            sizes = {name: float(size) for name, size in measure(state.params).items()}
            _keep(
                state,
                training_progress,
                length,
                {"train": last, "validation": scores, "kernels": sizes},
                task.rank,
                folder,
            )
            log(training_progress.history[-1])
            began = time.perf_counter()
    return state


def _keep(
    state: State,
    training_progress: TrainingProgress,
    length: TrainingLength,
    scores: Json,
    rank: str,
    folder: Path,
) -> None:
    """A line of the history and a checkpoint that holds it."""
    loss = _rank_loss(scores["validation"][rank])
    if training_progress.best_step == 0 or loss < training_progress.best_loss:
        training_progress.best_step, training_progress.best_loss = training_progress.step, loss
    counts = {
        "step": training_progress.step,
        "epoch": training_progress.step / length.steps_per_epoch,
        "images": training_progress.step * length.batch,
        "train_seconds": training_progress.seconds,
    }
    training_progress.history.append(counts | scores)
    times = {
        "train_seconds": training_progress.seconds,
        "compile_seconds": training_progress.compile_seconds,
    }
    record = {
        "history": training_progress.history,
        "best_step": training_progress.best_step,
    } | times
    checkpoint.save(folder, training_progress.step, state, record)
    _write_log(folder, training_progress.history)


def _finish(
    task: Task,
    parameters: int,
    training_progress: TrainingProgress,
    length: TrainingLength,
    folder: Path,
    devices: Devices,
) -> TrainingSummary:
    """Raises UserError where no validation loss was finite."""
    if math.isinf(training_progress.best_loss):
        hint = "check for broken data in the validation split, or lower learning_rate, and train in another folder"
        raise UserError(
            f"training {folder}: its validation loss ({task.rank}) was never finite; {hint}"
        )
    images = length.steps * length.batch
    summary = TrainingSummary(
        kind=task.kind,
        steps=length.steps,
        images=images,
        parameters=parameters,
        best_step=training_progress.best_step,
        best_loss=training_progress.best_loss,
        train_seconds=training_progress.seconds,
        compile_seconds=training_progress.compile_seconds,
        images_per_second=images / training_progress.seconds,
        trained_on=replace(
            describe_machine(),
            kernels=layer_choice.describe_layers(),
            devices=devices.number if devices.mesh else None,
        ),
        trained_by=read_source(),
    )
    record_files.write_record(folder / checkpoint.SUMMARY, summary)
    return summary


def get_compile_options() -> dict[str, int] | None:
    """Options to compile first states with: random numbers for every kernel are much code, which took a CPU longer to optimise than
    the step. The bits are the same."""
    return {"xla_backend_optimization_level": 1} if jax.default_backend() == "cpu" else None


def _mean_terms(
    validate: Callable[[Tree, Batch], dict[str, Array]], variables: Tree, batches: Iterator[Batch]
) -> dict[str, float | None]:
    """Means over all validation examples, None where one is not finite (JSON has no NaN).

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


def _rank_loss(loss: float | None) -> float:
    """A loss that was not finite ranks last."""
    return math.inf if loss is None else loss


def _write_log(folder: Path, history: list[Json]) -> None:
    """log.jsonl anew from the checkpoint's history, so that it never holds a line twice or one of a lost step."""
    files.write_text(
        folder / "log.jsonl",
        "".join(json.dumps(files.add_checksum(line)) + "\n" for line in history),
    )
