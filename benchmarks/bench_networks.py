"""Images per second of training, and milliseconds per image of inference, beside PyTorch in the same run.

    rows = bench_train(size=128, batch=32)

The sides take turns, a few steps at a time, and a 2048 x 2048 float32 matrix product is timed in between: `share` is the rate of
the convolutions' multiplications over the product's. Compile time stands apart. Without the extras `torch` and `onnx` only our rows come.
Where parts of the training are compiled for the processor (`models/fast/compiled_kernels.py`), training without them has a row of its own.
"""

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np

from benchmarks.multiplications import TARGETS, count_multiplications, count_posenet_multiplications
from benchmarks.training_steps import init_variables, make_noise_images, make_timed_step
from jaxunshear.allocator import keep_freed_memory
from jaxunshear.apps.export.parts import ExportedModel, ExportedNetwork
from jaxunshear.apps.robot.stream import make_perceive_function
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.registry import DISENTANGLED, POSENET
from jaxunshear.config.targets import list_target_names
from jaxunshear.config.training import Training
from jaxunshear.errors import UserError, get_first_line
from jaxunshear.files import Json
from jaxunshear.inference.perceiver import UNSHEARED
from jaxunshear.inference.perception import make_forward
from jaxunshear.models import posenet, unshearnet
from jaxunshear.models.fast import compiled_kernels
from jaxunshear.models.inference import jit_for_inference
from jaxunshear.progress import Progress
from jaxunshear.training.tasks import make_unshear_task
from verification.clock import SIZE, make_matrix_product, time_call

TRAIN_CASES = ((256, 8), (128, 32))  # size in px, batch
INFER_SIZES = (256, 128)
FROZEN: Json = {"freezing": True}  # PyTorch's weights as constants too
NOT_INSTALLED = "is not installed"  # which is no failure
Rounds = tuple[int, float]
ROUNDS: Rounds = (
    7,
    4.0,
)  # and a round's seconds: threads that still spin for the other side's work do not count
Work = Callable[[], object]
Sides = Iterator[tuple[str, Callable[[], Work]]]


def bench_train(
    size: int | None = None, batch: int | None = None, rounds: Rounds = ROUNDS
) -> list[Json]:
    """Rows `jaxunshear` and `pytorch, ...` for every size and batch, or for those asked. Raises `UserError` for a bad size."""
    plain = size is None and batch is None
    cases = (
        list(TRAIN_CASES)
        if plain
        else [(128 if size is None else size, 32 if batch is None else batch)]
    )
    return _measure_cases(
        "bench train",
        cases,
        _training_sides,
        lambda px: 6 * count_multiplications(UnshearNet(size=px), True),
        rounds,
    )


def bench_infer(
    size: int | None = None, batch: int | None = None, rounds: Rounds = ROUNDS
) -> list[Json]:
    """The same of encoder and canonical decoder, for one image at a time unless `batch` says otherwise."""
    cases = [
        (px, 1 if batch is None else batch) for px in (INFER_SIZES if size is None else (size,))
    ]
    return _measure_cases(
        "bench infer",
        cases,
        _inference_sides,
        lambda px: 2 * count_multiplications(UnshearNet(size=px), False),
        rounds,
    )


def bench_stream(size: int | None = None, rounds: Rounds = ROUNDS) -> list[Json]:
    """The same of what a robot runs for each frame: encoder, canonical decoder and PoseNet, one image at a time."""
    cases = [(px, 1) for px in (INFER_SIZES if size is None else (size,))]

    def operations(px: int) -> int:
        return 2 * (
            count_multiplications(UnshearNet(size=px), False)
            + count_posenet_multiplications(PoseNet(size=px))
        )

    return _measure_cases("bench stream", cases, _stream_sides, operations, rounds)


def _measure_cases(
    title: str,
    cases: Sequence[tuple[int, int]],
    sides: Callable[[int, int], Sides],
    operations: Callable[[int], int],
    rounds: Rounds,
) -> list[Json]:
    """Rows of all cases; `operations` of the convolutions for one image, of the size in px."""
    keep_freed_memory()
    rows = []
    with Progress(title, len(cases), unit="cases") as progress:
        for px, images in cases:
            rows += _compare_sides(sides(px, images), px, images, operations(px), rounds)
            progress.advance(1)
    return rows


def _network(size: int, batch: int) -> UnshearNet:
    if batch < 1:
        raise UserError(f"--batch {batch}: use at least 1")
    net = UnshearNet(size=size)
    unshearnet.check_net(net)
    return net


def _training_sides(size: int, batch: int) -> Sides:
    net, training = _network(size, batch), Training(batch=batch)
    canonical, sheared = make_noise_images(batch, size)

    def ours(form: str) -> Work:
        step, first = make_timed_step(make_unshear_task(net, training), training)
        state = [first]
        program = jax.jit(step, donate_argnums=0)
        given = jax.device_put({"canonical": canonical, "sheared": sheared})

        def work() -> None:
            with compiled_kernels.use_form(form):
                state[0], metrics = program(state[0], given)
            jax.block_until_ready(metrics)

        return work

    def theirs(compiled: bool) -> Work:
        torch, torch_networks = _import_torch_networks()
        torch.manual_seed(0)
        twin = (
            torch_networks.use_channels_last(torch_networks.TorchUnshearNet(net))
            .to(_place())
            .train()
        )
        step = torch_networks.training_step(twin, training, compiled)
        given = [
            torch.as_tensor(images.transpose(0, 3, 1, 2).copy()).to(_place())
            for images in (canonical, sheared)
        ]
        return lambda: float(step(*given)) and None

    yield "jaxunshear", lambda: ours("compiled")
    if compiled_kernels.is_available():
        yield "jaxunshear, XLA alone", lambda: ours("xla")
    yield "pytorch", lambda: theirs(False)
    yield "pytorch, compiled", lambda: theirs(True)


def _inference_sides(size: int, batch: int) -> Sides:
    net = _network(size, batch)
    _, sheared = make_noise_images(batch, size)

    def ours() -> Work:
        variables = init_variables(partial(unshearnet.init, net))
        run = jit_for_inference(
            lambda variables, images: unshearnet.unshear(net, variables, images), variables
        )
        given = np.asarray(sheared, np.float32) / 255
        return lambda: np.asarray(run(given)) is None

    def theirs(compiled: bool) -> Work:
        torch, torch_networks = _import_torch_networks()
        twin = (
            torch_networks.use_channels_last(torch_networks.TorchUnshearNet(net))
            .to(_place())
            .eval()
        )
        run = (
            torch.compile(twin.unshear, dynamic=False, options=FROZEN) if compiled else twin.unshear
        )
        image = torch.from_numpy(sheared.transpose(0, 3, 1, 2).astype(np.float32) / 255)
        image = image.contiguous(memory_format=torch.channels_last)

        def work() -> None:
            with torch.inference_mode():
                run(image.to(_place())).cpu().numpy()

        return work

    yield "jaxunshear", ours
    yield "pytorch", lambda: theirs(False)
    yield "pytorch, compiled", lambda: theirs(True)


def _stream_sides(size: int, batch: int) -> Sides:
    net, pose_net = _network(size, batch), PoseNet(size=size)
    image = make_noise_images(batch, size)[1, 0, ..., 0]

    def fresh_variables() -> dict[str, Any]:
        reader = init_variables(partial(posenet.init, pose_net, posenet.count_outputs(TARGETS)))
        return {DISENTANGLED: init_variables(partial(unshearnet.init, net)), POSENET: reader}

    def ours() -> Work:
        forward = make_forward({DISENTANGLED: net, POSENET: pose_net}, {POSENET: TARGETS})
        run = jit_for_inference(
            make_perceive_function(forward, list_target_names(TARGETS)), fresh_variables()
        )
        return lambda: jax.device_get(run(image)) is None

    def make_exported() -> Work:
        from jaxunshear.apps.export.onnx_file import build_onnx, make_onnx_runner

        if jax.default_backend() != "cpu":
            raise RuntimeError(
                f"onnxruntime is timed on the CPU alone, and JAX is on {jax.default_backend()}"
            )
        known = jax.device_get(fresh_variables())
        reads = ExportedNetwork(pose_net, known[POSENET])
        parts = ExportedModel(
            ExportedNetwork(net, known[DISENTANGLED]), reads, TARGETS, UNSHEARED, None, size
        )
        run = make_onnx_runner(build_onnx(parts, 1, None, {}), parts)
        return lambda: run(image[None]) is None

    def theirs(compiled: bool) -> Work:
        torch, torch_networks = _import_torch_networks()
        twin = (
            torch_networks.use_channels_last(torch_networks.TorchUnshearNet(net))
            .to(_place())
            .eval()
        )
        pose = (
            torch_networks.use_channels_last(
                torch_networks.TorchPoseNet(pose_net, posenet.count_outputs(TARGETS))
            )
            .to(_place())
            .eval()
        )

        def perceive(image: Any) -> tuple[Any, Any]:
            after = twin.unshear(image[None, None].float() / 255)
            return after, pose(after)

        run = torch.compile(perceive, dynamic=False, options=FROZEN) if compiled else perceive
        given = torch.from_numpy(image.copy())

        def work() -> None:
            with torch.inference_mode():
                after, answer = run(given.to(_place()))
                after.cpu().numpy(), answer.cpu().numpy()

        return work

    yield "jaxunshear", ours
    yield "onnxruntime", make_exported
    yield "pytorch", lambda: theirs(False)
    yield "pytorch, compiled", lambda: theirs(True)


def _import_torch_networks() -> tuple[Any, Any]:
    """PyTorch, and our networks in it. Each size is compiled for itself (`dynamic=False`): one for all sizes is what PyTorch makes of
    the second, and slower."""
    import torch

    from benchmarks import torch_networks

    return torch, torch_networks


def _place() -> str:
    """PyTorch's name of JAX' device."""
    return "cuda" if jax.default_backend() == "gpu" else "cpu"


def _compare_sides(
    sides: Sides, size: int, batch: int, operations: int, rounds: Rounds
) -> list[Json]:
    """One row a side."""
    ready: dict[str, Work] = {}
    rows: dict[str, Json] = {}
    for name, make in sides:
        rows[name] = {"name": name, "size": size, "batch": batch}
        try:
            work = make()
            started = time.perf_counter()
            work()
            rows[name]["compile_s"] = time.perf_counter() - started
            work()
            ready[name] = work
        except ModuleNotFoundError as missing:
            if name == "jaxunshear":
                raise
            extra = "torch" if missing.name == "torch" else "onnx"
            rows[name]["failed"] = (
                f"{missing.name} {NOT_INSTALLED}: pip install -c constraints.txt '.[{extra}]'"
            )
        except Exception as crash:
            if name == "jaxunshear":
                raise
            rows[name]["failed"] = f"{type(crash).__name__}: {get_first_line(crash)}"
    times: dict[str, list[float]] = {name: [] for name in ready}
    product, yard = make_matrix_product(), []
    for _ in range(rounds[0]):
        for name, work in ready.items():
            end = time.perf_counter() + rounds[1]
            while True:
                times[name].append(time_call(work))
                if time.perf_counter() >= end:
                    break
        yard += [time_call(product) for _ in range(3)]
    rate = 2 * SIZE**3 / statistics.median(yard)
    for name, spent in times.items():
        median, late = np.median(spent), np.percentile(spent, 95)
        rows[name] |= {
            "images_per_s": float(batch / median),
            "ms_per_image": float(1e3 * median / batch),
            "ms_p95": float(1e3 * late / batch),
            "ms_p99": float(1e3 * np.percentile(spent, 99) / batch),
            "share": float(batch * operations / median / rate),
            "steps": len(spent),
            "product_ms": 1e3 * statistics.median(yard),
            "failed": "",
        }
    return list(rows.values())


def table(rows: Sequence[Json]) -> str:
    """For people."""
    lines = [f"{'':22} px   batch  images/s  ms/image     p95  share  compile s"]
    for row in rows:
        head = f"{row['name']:22} {row['size']:<4} {row['batch']:<5}"
        if row["failed"]:
            absent = NOT_INSTALLED in row["failed"]
            lines.append(f"{head}  {'' if absent else 'FAILED: '}{row['failed']}")
            continue
        lines.append(
            f"{head} {row['images_per_s']:9.1f} {row['ms_per_image']:9.2f} {row['ms_p95']:7.2f} "
            f"{row['share']:6.2f} {row['compile_s']:10.1f}"
        )
    return "\n".join(lines)
