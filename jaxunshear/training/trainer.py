"""Train a network: one jitted, donated step, validation, checkpoints, and resuming after a kill.

>>> task = make_unshear_task(net, training)
>>> data = TrainingData(batches, validation, epoch_images=2160)
>>> train(task, training, data, seed=0, folder=Path("runs/demo/disentangled"))

All randomness of a step follows from the seed and the step's number, so a training that was killed
ends with the very bits of an undisturbed one. The losses are in tasks.py, the step is in step.py.
"""

import contextlib
import contextvars
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import optax
from jax import Array

from jaxunshear import files
from jaxunshear.code_version import read_source
from jaxunshear.config.targets import count_outputs, to_json
from jaxunshear.config.training import Training
from jaxunshear.environment import keep_freed_memory
from jaxunshear.errors import UserError
from jaxunshear.files import Json
from jaxunshear.models import layer_choice
from jaxunshear.models.fast import compiled_kernels
from jaxunshear.models.operations import measure_size
from jaxunshear.progress import Progress
from jaxunshear.results import record_files
from jaxunshear.results.measurement import TrainingSummary
from jaxunshear.results.provenance import describe_machine
from jaxunshear.training import checkpoint
from jaxunshear.training.devices import Devices, get_devices, prefetch
from jaxunshear.training.monitor import check_state, check_terms, make_measurement, open_events
from jaxunshear.training.provenance import InitialWeights, replace_weights
from jaxunshear.training.step import State, init_state, make_optimiser, make_schedule, make_step
from jaxunshear.training.tasks import Batch, Task, Tree

RESUME_REMEDY = "delete it to go on from the latest checkpoint"


class TrainingData(NamedTuple):
    """What a network learns from and is validated on."""

    # step -> endless iterator of batches, the same ones whichever step it starts from
    batches: Callable[[int], Iterator[Batch]]
    validation: Callable[[], Iterator[Batch]]  # a finite iterator of batches
    epoch_images: int  # examples that count as one epoch


class Provenance(NamedTuple):
    """Where the data and the first weights of a training come from."""

    origin: object = None  # any JSON that describes the data set
    data: Sequence[str] = ()  # digests of all data that is learnt, see provenance.py
    start: InitialWeights | None = None  # replace fresh weights of the same parts


class TrainingRun(NamedTuple):
    """What does not change in the course of a training."""

    task: Task
    training: Training
    steps: int
    steps_per_epoch: float
    folder: Path
    devices: Devices


@dataclass
class TrainingProgress:
    """How far a training has come: what a checkpoint keeps beside its state."""

    history: list[Json] = field(default_factory=list)  # a line per checkpoint
    best_step: int = 0
    train_seconds: float = 0.0
    compile_seconds: float = 0.0

    @property
    def step(self) -> int:
        return self.history[-1]["step"] if self.history else 0

    def find_best_loss(self, term: str) -> float:
        losses = [_replace_nan(line["validation"][term]) for line in self.history]
        return min(losses, default=math.inf)


class CompiledStep(NamedTuple):
    function: Callable[[State, Batch], tuple[State, dict[str, Array]]]
    batch: Batch  # the first
    seconds: float  # that compiling took


class FinishedStep(NamedTuple):
    number: int  # the first is 1
    terms: dict[str, Array]
    batch: Batch


def train(
    task: Task,
    training: Training,
    data: TrainingData,
    seed: int,
    folder: Path,
    provenance: Provenance = Provenance(),
) -> TrainingSummary:
    """Train the network of `task` into `folder`, resume it there, or return at once if finished.

    A folder that holds a training of other settings or another provenance is refused.

    Raises UserError (a loss or a state that is not finite, a damaged checkpoint, settings that do
    not fit).
    """
    folder = Path(folder)
    settings = _describe(task, training, seed, data.epoch_images, provenance)
    checkpoint.write_settings(folder, settings)
    if (folder / checkpoint.SUMMARY).exists():
        return record_files.read_record(folder / checkpoint.SUMMARY, TrainingSummary, RESUME_REMEDY)
    steps_per_epoch = data.epoch_images / training.batch
    steps = max(training.min_steps, round(training.epochs * steps_per_epoch))
    devices = get_devices(training.batch)
    run = TrainingRun(task, training, steps, steps_per_epoch, folder, devices)
    keep_freed_memory()
    optimiser = make_optimiser(training, steps, steps_per_epoch)
    key_init, key_steps = jax.random.split(jax.random.key(seed))
    step = make_step(task, training, optimiser, key_steps)
    rate = make_schedule(training, steps, steps_per_epoch)
    # compiled kernels cannot be split over devices
    form = compiled_kernels.use_form("xla") if devices.mesh else contextlib.nullcontext()
    first = checkpoint.find_latest_step(folder) or 0
    batches = iter(data.batches(first))
    make_state = jit_first_state(task, optimiser)
    origin = (key_init, provenance.start.variables if provenance.start else None)
    with (
        form,
        contextlib.closing(prefetch(batches, devices.with_batch)) as stream,
        open_events(folder, first, rate) as log,
        ThreadPoolExecutor(1, "compile") as thread,
    ):
        # to compile the step takes one core, and what makes the first state another
        shapes = make_state.trace(*origin).out_info
        compile_step = partial(_compile_step, run, step, shapes, stream)
        compiled = thread.submit(contextvars.copy_context().run, compile_step)
        state, progress = _restore(folder, first, make_state(*origin))
        _write_log(folder, progress.history)
        measure = make_measurement(task, data.validation)
        state = _run_steps(run, compiled.result(), state, progress, stream, measure, log)
        return _finish(run, progress, state.average)


def _describe(
    task: Task, training: Training, seed: int, epoch_images: int, provenance: Provenance
) -> Json:
    """Describe a training for model.json."""
    settings = {
        "kind": task.kind,
        "net": asdict(task.net),
        "training": asdict(training),
        "seed": seed,
        "epoch_images": epoch_images,
        "targets": to_json(task.targets),
        "origin": provenance.origin,
        "data": provenance.data,
    }
    if task.slide_targets:
        settings["slides"] = to_json(task.slide_targets)
    if provenance.start:
        settings["start"] = provenance.start.digest
    return settings


def jit_first_state(task: Task, optimiser: optax.GradientTransformation) -> jax.stages.Wrapped:
    """Jit what makes the state before the first step, of a key and of weights to start from."""

    def make(key: Array, start: Tree | None = None) -> State:
        variables = task.init(key)
        if start is not None:
            variables = replace_weights(variables, start)
        return init_state(variables, optimiser)

    return jax.jit(make, compiler_options=get_compile_options())


def _restore(folder: Path, step: int, state: State) -> tuple[State, TrainingProgress]:
    """Restore the checkpoint of a step; of step 0, return `state` and no progress."""
    if not step:
        return state, TrainingProgress()
    state, record = checkpoint.restore(folder, step, state)
    kept = ("history", "best_step", "train_seconds", "compile_seconds")
    return state, TrainingProgress(**{name: record[name] for name in kept})


def _compile_step(
    run: TrainingRun,
    step: Callable[[State, Batch], tuple[State, dict[str, Array]]],
    shapes: State,
    stream: Iterator[Batch],
) -> CompiledStep:
    """Compile a step for the first batch of `stream` and for states of these shapes."""
    batch = next(stream)
    began = time.perf_counter()
    on_each = run.devices.on_each
    shapes = jax.tree.map(lambda shape: shape.update(sharding=on_each), shapes)
    jitted = jax.jit(step, donate_argnums=0, out_shardings=on_each)
    compiled = jitted.lower(shapes, batch).compile()
    return CompiledStep(compiled, batch, time.perf_counter() - began)


def _run_steps(
    run: TrainingRun,
    step: CompiledStep,
    state: State,
    progress: TrainingProgress,
    stream: Iterator[Batch],
    measure: Callable[[State], Json],
    log: Callable[[Json], None],
) -> State:
    """Run all steps that are left, with their checkpoints, and update `progress`.

    Returns the last state. The terms of a step are inspected while the next one runs.
    """
    folder, size = run.folder, run.training.batch
    state, batch = run.devices.with_state(state), step.batch
    progress.compile_seconds += step.seconds

    with Progress(f"train {folder.name}", run.steps * size, done=progress.step * size) as bar:
        began = time.perf_counter()
        unchecked: list[FinishedStep] = []
        for number in range(progress.step + 1, run.steps + 1):
            state, metrics = step.function(state, batch)
            unchecked.append(FinishedStep(number, metrics, batch))
            if number < run.steps:
                batch = next(stream)
            at_checkpoint = number % run.training.validate_every == 0 or number == run.steps
            while len(unchecked) > (0 if at_checkpoint else 1):
                finished = unchecked.pop(0)
                terms = check_terms(*finished, folder)
            bar.advance(size)
            if not at_checkpoint:
                continue
            progress.train_seconds += time.perf_counter() - began
            check_state(state, number, finished.batch, folder)
            _write_checkpoint(run, state, progress, number, {"train": terms} | measure(state))
            log(progress.history[-1])
            began = time.perf_counter()
    return state


def _write_checkpoint(
    run: TrainingRun, state: State, progress: TrainingProgress, step: int, scores: Json
) -> None:
    """Add a line to the history, and write a checkpoint that holds it."""
    term = run.task.selection_term
    loss = _replace_nan(scores["validation"][term])
    if progress.best_step == 0 or loss < progress.find_best_loss(term):
        progress.best_step = step
    counts = {
        "step": step,
        "epoch": step / run.steps_per_epoch,
        "images": step * run.training.batch,
        "train_seconds": progress.train_seconds,
    }
    progress.history.append(counts | scores)
    checkpoint.save(run.folder, step, state, asdict(progress))
    _write_log(run.folder, progress.history)


def _finish(run: TrainingRun, progress: TrainingProgress, variables: Tree) -> TrainingSummary:
    """Write the summary. Raises UserError if no validation loss was finite."""
    task, devices = run.task, run.devices
    size = measure_size(task.net, variables, count_outputs(task.targets))
    best_loss = progress.find_best_loss(task.selection_term)
    if math.isinf(best_loss):
        raise UserError(
            f"training {run.folder}: its validation loss ({task.selection_term}) was never finite; "
            "check for broken data in the validation split, or lower learning_rate, and train in "
            "another folder"
        )
    images = run.steps * run.training.batch
    summary = TrainingSummary(
        kind=task.kind,
        steps=run.steps,
        images=images,
        parameters=size.parameters,
        operations=size.operations,
        best_step=progress.best_step,
        best_loss=best_loss,
        train_seconds=progress.train_seconds,
        compile_seconds=progress.compile_seconds,
        images_per_second=images / progress.train_seconds,
        trained_on=replace(
            describe_machine(),
            kernels=layer_choice.describe_layers(),
            devices=devices.number if devices.mesh else None,
        ),
        trained_by=read_source(),
    )
    record_files.write_record(run.folder / checkpoint.SUMMARY, summary)
    return summary


def get_compile_options() -> dict[str, int] | None:
    """Get the options to compile first states with.

    Random numbers for every kernel are much code, which took a CPU longer to optimise than the
    step. The bits are the same. A level in XLA_FLAGS is kept.
    """
    level = "xla_backend_optimization_level"
    if level in os.environ.get("XLA_FLAGS", "") or jax.default_backend() != "cpu":
        return None
    return {level: 1}


def _replace_nan(loss: float | None) -> float:
    """Rank a loss that was not finite last."""
    return math.inf if loss is None else loss


def _write_log(folder: Path, history: list[Json]) -> None:
    """Write log.jsonl anew from the history of the checkpoint.

    So it never holds a line twice, or one of a lost step.
    """
    lines = [json.dumps(files.add_checksum(line)) + "\n" for line in history]
    files.write_text(folder / "log.jsonl", "".join(lines))
