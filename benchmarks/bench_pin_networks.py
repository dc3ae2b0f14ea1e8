"""Measures networks over pins: training steps, single frames and frames of a batch.

    rows = bench_pinnets()

The encoder E has dense layers, or convolutions (`pins.conv_channels`). For a frame the networks
compute the unsheared pins from the sheared ones, and the pose from the unsheared pins. The pins
stand as on the TacTip, with random motions. Plain and fast layers take turns.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks.training_steps import make_timed_step
from jaxunshear.config.experiment import PIN_TRAINING
from jaxunshear.config.networks import PinPoseNet, PinUnshear
from jaxunshear.config.sensor import TACTIP_331, Camera, Preprocess
from jaxunshear.environment import keep_freed_memory
from jaxunshear.files import Json
from jaxunshear.models import layer_choice, pin_networks
from jaxunshear.models.registry import InitFacts
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.progress import Progress
from jaxunshear.text_table import format_text_table
from jaxunshear.training.tasks import make_unshear_task
from verification.clock import time_call

NETS = {
    "dense": PinUnshear(),
    "convolves": PinUnshear(conv_channels=(24, 48, 96)),
}  # second: `skin`
BATCHES = (1, 64)
ROUNDS, TURN_S = 60, 0.1
SPREAD = 2.0  # px
POSE_OUTPUTS = 3
COLUMNS = (
    *("name", "what", "batch", "ms", "ms_p95"),
    *("plain_ms", "plain_over_fast", "compile_s", "plain_compile_s"),
)
format_table = partial(format_text_table, columns=COLUMNS)
Work = Callable[[], object]


class CompiledWork(NamedTuple):
    """Something to time, and the seconds that compiling it took."""

    work: Work
    compile_s: float


def bench_pinnets(rounds: int = ROUNDS, turn_s: float = TURN_S) -> list[Json]:
    """Return a row for each network and use: times over `rounds` turns of `turn_s` s."""
    keep_freed_memory()
    rest = compute_rest_lattice(TACTIP_331, Camera(), Preprocess()).rest
    uses = [("training step", PIN_TRAINING.batch), *(("a frame", batch) for batch in BATCHES)]
    rows = []
    with Progress("bench pinnets", len(uses) * len(NETS), unit="rows") as progress:
        for name, net in NETS.items():
            for use, batch in uses:
                fast = _build_work(net, rest, use, batch, layer_choice.FAST)
                plain = _build_work(net, rest, use, batch, layer_choice.PLAIN)
                row = {"name": name, "what": use, "batch": batch}
                rows.append(row | _measure_work(fast, plain, rounds, turn_s))
                progress.advance()
    return rows


def _build_work(
    net: PinUnshear, rest: np.ndarray, use: str, batch: int, layers: str
) -> CompiledWork:
    noise = np.random.default_rng(0).normal(size=(batch, *rest.shape))
    with layer_choice.use_layers(layers):
        pins = jnp.asarray(rest[None] + SPREAD * noise, jnp.float32)
        build = _build_step if use == "training step" else _build_frame
        start = time.perf_counter()
        work = build(net, rest, pins)
        return CompiledWork(work, time.perf_counter() - start)


def _build_frame(net: PinUnshear, rest: np.ndarray, pins: Array) -> Work:
    pose_net = PinPoseNet()
    weights = pin_networks.init(net, rest, SPREAD, jax.random.key(0))
    pose_weights = pin_networks.init(pose_net, rest, SPREAD, jax.random.key(1), POSE_OUTPUTS)

    def perceive(pins: Array) -> tuple[Array, Array]:
        unsheared = pin_networks.unshear(net, weights, pins)
        return unsheared, pin_networks.predict(pose_net, pose_weights, unsheared)

    run = jax.jit(perceive).lower(pins).compile()
    return lambda: jax.block_until_ready(run(pins))


def _build_step(net: PinUnshear, rest: np.ndarray, pins: Array) -> Work:
    training = replace(PIN_TRAINING, losses={"supervised": 1.0, "reconstruction": 0.3})
    task = make_unshear_task(net, training, facts=InitFacts(rest=rest, spread=SPREAD))
    step, first = make_timed_step(task, training)
    state = [first]
    batch = {"canonical_pins": pins, "sheared_pins": pins}
    program = jax.jit(step, donate_argnums=0).lower(state[0], batch).compile()

    def work() -> None:
        state[0], metrics = program(state[0], batch)
        jax.block_until_ready(metrics)

    return work


def _measure_work(fast: CompiledWork, plain: CompiledWork, rounds: int, turn_s: float) -> Json:
    seconds = [time_call(compiled.work) for compiled in (fast, plain) for _ in range(3)]
    repeats = max(1, round(turn_s / min(seconds)))

    def measure_ms(work: Work) -> float:
        return 1e3 * time_call(lambda: [work() for _ in range(repeats)]) / repeats

    times_ms = np.empty((rounds, 2))
    for turn in times_ms:
        turn[:] = measure_ms(fast.work), measure_ms(plain.work)
    fast_ms, plain_ms = times_ms.T
    return {
        "ms": float(np.median(fast_ms)),
        "ms_p95": float(np.percentile(fast_ms, 95)),
        "plain_ms": float(np.median(plain_ms)),
        "plain_over_fast": float(np.median(plain_ms / fast_ms)),
        "compile_s": fast.compile_s,
        "plain_compile_s": plain.compile_s,
    }
