"""Measures whether a training step ever waits for its examples.

    rows = bench_input()

It compares steps that read each batch from a data set, as training does, with steps whose batch is
already in memory. Both take turns, a few steps at a time. The data set has random examples, as many
as a training has.
"""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from scipy.stats import bootstrap

from benchmarks.training_steps import make_noise_images, make_timed_step
from jaxunshear.config.experiment import PIN_TRAINING
from jaxunshear.config.networks import PinUnshear, UnshearNet
from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.config.training import Training
from jaxunshear.data.chunks import pack_bits
from jaxunshear.data.reader import Batch, Reader
from jaxunshear.environment import keep_freed_memory
from jaxunshear.files import Json
from jaxunshear.models.registry import InitFacts
from jaxunshear.progress import Progress
from jaxunshear.text_table import format_text_table
from jaxunshear.training.devices import prefetch
from jaxunshear.training.tasks import Task, make_unshear_task
from verification.clock import time_call

SECONDS = 60.0  # of each kind of step
MIN_ROUNDS = 2
EXAMPLES, SLIDES = 2000, 4  # slides, and how many share a pose
COLUMNS = (
    *("name", "batch", "ms_there", "ms_drawn"),
    *("ratio", "ratio_low", "ratio_high", "ratio_p95", "compile_s"),
)
format_table = partial(format_text_table, columns=COLUMNS)


class Case(NamedTuple):
    """A training to be timed."""

    name: str
    task: Task
    training: Training
    stored: Batch  # all training examples, as a set holds them
    size: int  # px
    steps: int  # per turn: a third of a second of two cores


def bench_input(
    seconds: float = SECONDS, widths: tuple[int, ...] = UnshearNet().widths
) -> list[Json]:
    """Measure both kinds of steps for `seconds` each, and return a row for each kind of network.

    A row has ms per step with a batch in memory and with one that is drawn, and their ratio: the
    median with its 95 % bootstrap interval, and the 95th percentile of turns.
    """
    keep_freed_memory()
    cases = [_make_image_case(widths), _make_pin_case()]
    with Progress("bench input", len(cases), unit="cases") as progress:
        rows = []
        for case in cases:
            rows.append(_measure_case(case, seconds))
            progress.advance(1)
    return rows


def _make_image_case(widths: tuple[int, ...]) -> Case:
    net, training = UnshearNet(size=128, widths=widths), Training(batch=16)
    canonical, sheared = make_noise_images(EXAMPLES, net.size)[..., 0]
    stored = {"canonical": pack_bits(canonical), "sheared": pack_bits(sheared)}
    return Case(
        "images", make_unshear_task(net, training), training, stored | _make_poses(), net.size, 2
    )


def _make_pin_case() -> Case:
    training = replace(PIN_TRAINING, losses={"supervised": 1.0, "reconstruction": 0.3})
    pins = (
        np.random.default_rng(0)
        .normal(64, 20, (2, EXAMPLES, TACTIP_331.pins, 2))
        .astype(np.float32)
    )
    facts = InitFacts(rest=pins[0].mean(axis=0), spread=20.0)
    task = make_unshear_task(PinUnshear(), training, facts=facts)
    stored = {"canonical_pins": pins[0], "sheared_pins": pins[1]}
    return Case("pins", task, training, stored | _make_poses(), 128, 40)


def _make_poses() -> Batch:
    return {"stimulus": np.zeros(EXAMPLES, int), "pose_id": np.arange(EXAMPLES) // SLIDES}


def _measure_case(case: Case, seconds: float) -> Json:
    training = case.training
    fields = tuple(name for name in case.stored if name not in ("stimulus", "pose_id"))
    reader = Reader(lambda split: case.stored, case.size)
    batches = reader.train_batches(training.batch, 0, training.shift, fields)
    stream = prefetch(batches(0), jax.device_put)
    repeated = itertools.repeat(next(stream))
    step, first = make_timed_step(case.task, training)
    state = [first]
    lowered = jax.jit(step, donate_argnums=0).lower(state[0], next(repeated))
    programs: list[jax.stages.Compiled] = []
    compile_s = time_call(lambda: programs.append(lowered.compile()))

    def take_turn(batches: Iterator[Mapping[str, jax.Array]]) -> None:
        """Run steps as training does: it waits for the step before the last."""
        batch, before = next(batches), None
        for _ in range(case.steps):
            state[0], metrics = programs[0](state[0], batch)
            batch = next(batches)
            jax.block_until_ready(before)
            before = metrics
        jax.block_until_ready(before)

    take_turn(stream)
    take_turn(repeated)
    rounds = max(MIN_ROUNDS, round(seconds / time_call(lambda: take_turn(repeated))))
    times = np.empty((rounds, 2))
    for turn in times:
        turn[:] = time_call(lambda: take_turn(repeated)), time_call(lambda: take_turn(stream))
    ratio = times[:, 1] / times[:, 0]
    spread = bootstrap((ratio,), np.median, method="percentile", rng=0).confidence_interval
    ms_there, ms_drawn = 1e3 * np.median(times, axis=0) / case.steps
    return {
        "name": case.name,
        "batch": training.batch,
        "ms_there": float(ms_there),
        "ms_drawn": float(ms_drawn),
        "ratio": float(np.median(ratio)),
        "ratio_low": float(spread.low),
        "ratio_high": float(spread.high),
        "ratio_p95": float(np.percentile(ratio, 95)),
        "compile_s": compile_s,
    }
