"""Networks over pins: milliseconds a step of training, a frame by itself and a frame of a batch, with plain layers and with fast ones.

    rows = bench_pin_networks()

Where E is dense, and where it convolves (`pins.convolved`). A frame goes from sheared pins to unsheared ones and to the pose read off
these. Pins are noise about the TacTip's; plain and fast layers take turns.
"""

import time
from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from benchmarks.training_steps import make_timed_step
from jaxunshear.allocator import keep_freed_memory
from jaxunshear.config.experiment import PIN_TRAINING
from jaxunshear.config.image import Camera, Preprocess
from jaxunshear.config.networks import PinPoseNet, PinUnshear
from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.files import Json
from jaxunshear.models import layer_choice, pin_networks
from jaxunshear.perception.rest_positions import compute_rest_lattice
from jaxunshear.progress import Progress
from jaxunshear.training.pin_tasks import make_pin_unshear_task
from verification.clock import time_call

NETS = {
    "dense": PinUnshear(),
    "convolves": PinUnshear(convolved=(24, 48, 96)),
}  # as the weights `skin`
BATCHES = (1, 64)
ROUNDS, TURN_S = 60, 0.1
SPREAD = 2.0  # px
POSE = 3  # numbers that PoseNet reads
COLUMNS = (
    "name",
    "what",
    "batch",
    "ms",
    "ms_p95",
    "plain_ms",
    "plain_over_fast",
    "compile_s",
    "plain_compile_s",
)
Work = Callable[[], object]


def bench_pin_networks(rounds: int = ROUNDS, turn_s: float = TURN_S) -> list[Json]:
    """A row a network and a use: median and 95th percentile of `rounds` turns of `turn_s` s; compile time apart."""
    keep_freed_memory()
    rest = compute_rest_lattice(TACTIP_331, Camera(), Preprocess()).rest
    rows = []
    with Progress("bench pinnets", 3 * len(NETS), unit="rows") as progress:
        for name, net in NETS.items():
            for what, batch in (
                ("training step", PIN_TRAINING.batch),
                *(("a frame", batch) for batch in BATCHES),
            ):
                made = {
                    way: _build_work(net, rest, what, batch, way)
                    for way in (layer_choice.FAST, layer_choice.PLAIN)
                }
                rows.append(
                    {
                        "name": name,
                        "what": what,
                        "batch": batch,
                        **_measure_work(made, rounds, turn_s),
                    }
                )
                progress.advance()
    return rows


def _build_work(
    net: PinUnshear, rest: np.ndarray, what: str, batch: int, way: str
) -> tuple[Work, float]:
    """Something to time, and the seconds that compiling it took."""
    with layer_choice.use_layers(way):
        pins = jnp.asarray(
            rest[None] + SPREAD * np.random.default_rng(0).normal(size=(batch, *rest.shape)),
            jnp.float32,
        )
        build = _step if what == "training step" else _frame
        began = time.perf_counter()
        return build(net, rest, pins), time.perf_counter() - began


def _frame(net: PinUnshear, rest: np.ndarray, pins: Array) -> Work:
    reader = PinPoseNet()
    weights = pin_networks.init(net, rest, SPREAD, jax.random.key(0))
    pose_weights = pin_networks.init(reader, rest, SPREAD, jax.random.key(1), POSE)

    def read(pins: Array) -> tuple[Array, Array]:
        unsheared = pin_networks.unshear(net, weights, pins)
        return unsheared, pin_networks.predict(reader, pose_weights, unsheared)

    run = jax.jit(read).lower(pins).compile()
    return lambda: jax.block_until_ready(run(pins))


def _step(net: PinUnshear, rest: np.ndarray, pins: Array) -> Work:
    training = replace(PIN_TRAINING, losses={"supervised": 1.0, "reconstruction": 0.3})
    task = make_pin_unshear_task(net, training, rest, SPREAD)
    step, first = make_timed_step(task, training)
    state = [first]
    batch = {"canonical_pins": pins, "sheared_pins": pins}
    program = jax.jit(step, donate_argnums=0).lower(state[0], batch).compile()

    def work() -> None:
        state[0], metrics = program(state[0], batch)
        jax.block_until_ready(metrics)

    return work


def _measure_work(made: dict[str, tuple[Work, float]], rounds: int, turn_s: float) -> Json:
    works = {way: work for way, (work, _) in made.items()}
    times = max(
        1, round(turn_s / min(time_call(work) for work in works.values() for _ in range(3)))
    )

    def turn(way: str) -> float:
        return 1e3 * time_call(lambda: [works[way]() for _ in range(times)]) / times

    fast, plain = np.array(
        [[turn(layer_choice.FAST), turn(layer_choice.PLAIN)] for _ in range(rounds)]
    ).T
    return {
        "ms": float(np.median(fast)),
        "ms_p95": float(np.percentile(fast, 95)),
        "plain_ms": float(np.median(plain)),
        "plain_over_fast": float(np.median(plain / fast)),
        "compile_s": made[layer_choice.FAST][1],
        "plain_compile_s": made[layer_choice.PLAIN][1],
    }
