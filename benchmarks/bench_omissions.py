"""Measures what a part costs that some settings do not need, in operations and seconds.

    rows = bench_needs(size=128)

Each case compiles two programs, with and without the part. `operations` is XLA's count for the
compiled program. XLA cannot count our faster forms of the kernels' gradients, so these are computed
as convolutions here. A part that is not needed must not be in the program at all. The two programs
are timed in turns.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import jax
import numpy as np

from benchmarks.training_steps import init_variables, make_noise_images, make_timed_step
from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import DISENTANGLED, ENTANGLED, POSENET, PoseNet, UnshearNet
from jaxunshear.config.targets import count_outputs, make_range_targets
from jaxunshear.config.training import Training
from jaxunshear.config.types import raise_first_problem
from jaxunshear.environment import keep_freed_memory
from jaxunshear.evaluation.network_outputs import make_run
from jaxunshear.files import Json
from jaxunshear.models import posenet, unshearnet
from jaxunshear.models.fast import compiled_kernels
from jaxunshear.models.modality import IMAGES
from jaxunshear.models.weights import Variables
from jaxunshear.progress import Progress
from jaxunshear.text_table import format_text_table
from jaxunshear.training.tasks import make_unshear_task
from verification.clock import time_call

ROUNDS = 15
BATCH, SIZE = 8, 128
WIDTHS = (16, 32, 64, 128, 256)  # the demo's


@dataclass
class Computation:
    """A function of arrays, and its arguments; several cases may share one."""

    call: Callable[..., object]
    arguments: tuple[object, ...]

    @cached_property
    def compiled_program(self) -> tuple[Callable[..., object], float]:
        """The program, and the seconds that compiling it took."""
        lowered = jax.jit(self.call).lower(*self.arguments)
        start = time.perf_counter()
        return lowered.compile(), time.perf_counter() - start

    @cached_property
    def operations(self) -> float:
        """The operations of the program, as XLA counts them."""
        with compiled_kernels.use_form("counted"):
            function = jax.jit(lambda *arguments: self.call(*arguments))
            program = function.lower(*self.arguments).compile()
        return float((program.cost_analysis() or {})["flops"])


class Case(NamedTuple):
    """Some work, with and without a part."""

    name: str
    left_out: str
    full: Computation
    reduced: Computation


def bench_needs(
    size: int | None = None, widths: tuple[int, ...] = WIDTHS, rounds: int = ROUNDS
) -> list[Json]:
    """Return a row for each case, with operations and times by "with" and "without".

    Raises UserError for a bad size.
    """
    keep_freed_memory()
    net = UnshearNet(size=size or SIZE, widths=widths)
    raise_first_problem(net, "UnshearNet")
    cases = list(_list_cases(net))
    rows = []
    with Progress("bench needs", len(cases), unit="cases") as progress:
        for case in cases:
            row = {"name": case.name, "left_out": case.left_out, "size": net.size}
            rows.append(row | _measure_case(case, rounds))
            progress.advance(1)
    return rows


def _measure_case(case: Case, rounds: int) -> Json:
    works: dict[str, Callable[[], object]] = {}
    row: dict[str, dict[str, float]] = {}
    for kind, computation in (("with", case.full), ("without", case.reduced)):
        program, compile_s = computation.compiled_program
        row[kind] = {"operations": computation.operations, "compile_s": compile_s}
        works[kind] = partial(_run, program, computation.arguments)
        works[kind]()
    times: dict[str, list[float]] = {kind: [] for kind in works}
    for _ in range(rounds):
        for kind, work in works.items():
            times[kind].append(time_call(work))
    for kind, laps in times.items():
        row[kind] |= {"seconds": float(np.median(laps)), "p95": float(np.percentile(laps, 95))}
    ratios = {
        f"{name}_ratio": row["without"][name] / row["with"][name]
        for name in ("operations", "seconds")
    }
    return row | ratios


def _run(compiled: Callable[..., object], arguments: tuple[object, ...]) -> object:
    return jax.block_until_ready(compiled(*arguments))


def _list_cases(net: UnshearNet) -> Iterator[Case]:
    variables = init_variables(partial(unshearnet.init, net))
    images = np.zeros((1, net.size, net.size, 1), np.float32)
    yield Case(
        "unshear one image",
        "shear code and DS",
        Computation(lambda v, x: _decode_both(net, v, x), (variables, images)),
        Computation(lambda v, x: unshearnet.unshear(net, v, x), (variables, images)),
    )
    training = Training(batch=BATCH)
    usual = _make_step(net, training)
    name = "training step"
    no_patches = _make_step(
        net, replace(training, losses={"supervised": 1.0, "reconstruction": 1.0})
    )
    yield Case(name, "crops: lambda 0", usual, no_patches)
    no_shear_code = _make_step(replace(net, shear_channels=0), training)
    yield Case(name, "shear channels", usual, no_shear_code)
    regularised = _make_step(net, replace(training, l1=1e-3, l2=1e-3))
    yield Case(name, "weights on kernels: l1 and l2 of 0", regularised, usual)
    yield _make_evaluation_case(net, variables)


def _decode_both(
    net: UnshearNet, variables: Variables, images: jax.Array
) -> tuple[jax.Array, jax.Array]:
    z_p, z_s = unshearnet.encode(net, variables, images)
    sheared = unshearnet.decode_sheared(net, variables, z_p, z_s)  # type: ignore[arg-type]
    return jax.nn.sigmoid(unshearnet.decode_canonical(net, variables, z_p)), jax.nn.sigmoid(sheared)


def _make_step(net: UnshearNet, training: Training) -> Computation:
    step, state = make_timed_step(make_unshear_task(net, training), training)
    canonical, sheared = make_noise_images(training.batch, net.size)
    return Computation(step, (state, {"canonical": canonical, "sheared": sheared}))


def _make_evaluation_case(net: UnshearNet, variables: Variables) -> Case:
    entangled, pose = replace(net, disentangled=False), PoseNet(size=net.size)
    nets = {ENTANGLED: entangled, DISENTANGLED: net, POSENET: pose}
    targets = make_range_targets((), Ranges())
    values = {
        ENTANGLED: init_variables(partial(unshearnet.init, entangled), 1),
        DISENTANGLED: variables,
        POSENET: init_variables(partial(posenet.init, pose, count_outputs(targets)), 2),
    }
    images = np.zeros((BATCH, net.size, net.size, 1), np.uint8)

    def make_computation(names: tuple[str, ...]) -> Computation:
        run = make_run({name: nets[name] for name in names}, dict.fromkeys(names, targets), IMAGES)
        return Computation(run, ({name: values[name] for name in names}, None, images, images))

    return Case(
        "evaluation of a batch",
        "networks that are not asked for",
        make_computation(tuple(nets)),
        make_computation((ENTANGLED,)),
    )


def format_table(rows: list[Json]) -> str:
    """Format rows for people."""
    flat = []
    for row in rows:
        cells = {"work": row["name"], "left out": row["left_out"]}
        for kind in ("with", "without"):
            cells[f"Mflop {kind}"] = row[kind]["operations"] / 1e6
            cells[f"ms {kind}"] = 1e3 * row[kind]["seconds"]
        flat.append(cells)
    return format_text_table(flat, tuple(flat[0]))
