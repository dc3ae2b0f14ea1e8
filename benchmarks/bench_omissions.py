"""What leaving out saves: operations and seconds of the same work with and without a part that it may not need.

    rows = bench_needs(size=128)

Each case is compiled both ways. `operations` are those of the compiled program, as XLA counts them, with kernels' gradients as
convolutions (of other forms it counts none, or one turn of a loop): a part that is not needed must be gone from it, not merely
unused. Both ways take turns in being timed.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import jax
import numpy as np

from benchmarks.training_steps import init_variables, make_noise_images, make_timed_step
from jaxunshear.allocator import keep_freed_memory
from jaxunshear.config.data import Ranges
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.registry import DISENTANGLED, ENTANGLED, POSENET
from jaxunshear.config.targets import make_range_targets
from jaxunshear.config.training import Training
from jaxunshear.evaluation.network_outputs import make_image_run
from jaxunshear.files import Json
from jaxunshear.models import posenet, unshearnet
from jaxunshear.models.fast import compiled_kernels
from jaxunshear.models.weights import Variables
from jaxunshear.progress import Progress
from jaxunshear.training.tasks import make_unshear_task
from verification.clock import time_call

ROUNDS = 15
BATCH = 8
WIDTHS = (16, 32, 64, 128, 256)  # the demo's


@dataclass
class Computation:
    """A function of arrays, and its arguments; several cases may hold the same one."""

    call: Callable[..., object]
    arguments: tuple[object, ...]

    @cached_property
    def compiled_program(self) -> tuple[Callable[..., object], float]:
        """The program, and the seconds that compiling it took."""
        lowered, started = jax.jit(self.call).lower(*self.arguments), time.perf_counter()
        return lowered.compile(), time.perf_counter() - started

    @cached_property
    def operations(self) -> float:
        with compiled_kernels.use_form("counted"):
            counted = (
                jax.jit(lambda *arguments: self.call(*arguments)).lower(*self.arguments).compile()
            )
        return float((counted.cost_analysis() or {})["flops"])


def bench_needs(
    size: int = 128, widths: tuple[int, ...] = WIDTHS, rounds: int = ROUNDS
) -> list[Json]:
    """A row a case: `operations`, `time_call` (median), `p95` and `compile_s` by "with" and "without". Raises UserError for a bad size."""
    keep_freed_memory()
    net = UnshearNet(size=size, widths=widths)
    unshearnet.check_net(net)
    cases = list(_cases(net))
    rows = []
    with Progress("bench needs", len(cases), unit="cases") as progress:
        for name, left_out, full, less in cases:
            rows.append(
                {"name": name, "left_out": left_out, "size": size}
                | _measure_case(full, less, rounds)
            )
            progress.advance(1)
    return rows


def _measure_case(full: Computation, less: Computation, rounds: int) -> Json:
    works: dict[str, Callable[[], object]] = {}
    found: dict[str, dict[str, float]] = {}
    for kind, way in (("with", full), ("without", less)):
        run, spent = way.compiled_program
        found[kind] = {"operations": way.operations, "compile_s": spent}
        works[kind] = partial(_run, run, way.arguments)
        works[kind]()
    times: dict[str, list[float]] = {kind: [] for kind in works}
    for _ in range(rounds):
        for kind, work in works.items():
            times[kind].append(time_call(work))
    for kind, laps in times.items():
        found[kind] |= {"seconds": float(np.median(laps)), "p95": float(np.percentile(laps, 95))}
    ratios = {
        f"{name}_ratio": found["without"][name] / found["with"][name]
        for name in ("operations", "seconds")
    }
    return found | ratios


def _run(compiled: Callable[..., object], arguments: tuple[object, ...]) -> object:
    return jax.block_until_ready(compiled(*arguments))


def _cases(net: UnshearNet) -> Iterator[tuple[str, str, Computation, Computation]]:
    """Name, what is left out, with it, without it."""
    variables = init_variables(partial(unshearnet.init, net))
    images = np.zeros((1, net.size, net.size, 1), np.float32)
    yield (
        "unshear one image",
        "shear code and DS",
        Computation(lambda v, x: _both_decoders(net, v, x), (variables, images)),
        Computation(lambda v, x: unshearnet.unshear(net, v, x), (variables, images)),
    )
    training = Training(batch=BATCH)
    regular, usual = replace(training, l1=1e-3, l2=1e-3), _step(net, training)
    yield (
        "training step",
        "crops: lambda 0",
        usual,
        _step(net, replace(training, losses={"supervised": 1.0, "reconstruction": 1.0})),
    )
    yield "training step", "shear channels", usual, _step(replace(net, shear_channels=0), training)
    yield "training step", "weights on kernels: l1 and l2 of 0", _step(net, regular), usual
    yield _evaluation(net, variables)


def _both_decoders(
    net: UnshearNet, variables: Variables, images: jax.Array
) -> tuple[jax.Array, jax.Array]:
    z_p, z_s = unshearnet.encode(net, variables, images)
    sheared = unshearnet.decode_sheared(net, variables, z_p, z_s)  # type: ignore[arg-type]
    return jax.nn.sigmoid(unshearnet.decode_canonical(net, variables, z_p)), jax.nn.sigmoid(sheared)


def _step(net: UnshearNet, training: Training) -> Computation:
    step, state = make_timed_step(make_unshear_task(net, training), training)
    canonical, sheared = make_noise_images(training.batch, net.size)
    return Computation(step, (state, {"canonical": canonical, "sheared": sheared}))


def _evaluation(net: UnshearNet, variables: Variables) -> tuple[str, str, Computation, Computation]:
    entangled, pose = replace(net, disentangled=False), PoseNet(size=net.size)
    nets = {ENTANGLED: entangled, DISENTANGLED: net, POSENET: pose}
    targets = make_range_targets((), Ranges())
    values = {
        ENTANGLED: init_variables(partial(unshearnet.init, entangled), 1),
        DISENTANGLED: variables,
        POSENET: init_variables(partial(posenet.init, pose, posenet.count_outputs(targets)), 2),
    }
    images = np.zeros((BATCH, net.size, net.size, 1), np.uint8)

    def way(names: tuple[str, ...]) -> Computation:
        run = make_image_run({name: nets[name] for name in names}, dict.fromkeys(names, targets))
        return Computation(run, ({name: values[name] for name in names}, None, images, images))

    return (
        "evaluation of a batch",
        "networks that are not asked for",
        way(tuple(nets)),
        way((ENTANGLED,)),
    )


def table(rows: list[Json]) -> str:
    """For people."""
    lines = [f"{'':22} {'left out':35} Mflop with   without  ratio    ms with   without  ratio"]
    for row in rows:
        operations, times = (
            [row[kind][name] for kind in ("with", "without")] for name in ("operations", "seconds")
        )
        lines.append(
            f"{row['name']:22} {row['left_out']:35} {operations[0] / 1e6:10.1f} {operations[1] / 1e6:9.1f} {row['operations_ratio']:6.2f} "
            f"{1e3 * times[0]:10.2f} {1e3 * times[1]:9.2f} {row['seconds_ratio']:6.2f}"
        )
    return "\n".join(lines)
