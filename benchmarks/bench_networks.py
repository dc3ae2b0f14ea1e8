"""Measures the speed of training and inference, beside PyTorch in the same run.

    rows = bench_train(size=128, batch=32)

The programs take turns, a few steps at a time. Between the turns a 2048 x 2048 float32 matrix
product is timed. `share` is the rate of the convolutions, in multiplications per second, over the
rate of this product. Compile time is separate. The rows of PyTorch and ONNX Runtime need the extras
`torch` and `onnx`. Further rows time plain layers, and training without the compiled kernels
(`models/fast/compiled_kernels.py`), if there are any: on a GPU there are none, and no file of ONNX
Runtime is timed.
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
from jaxunshear.apps.export.parts import ExportedModel
from jaxunshear.apps.export.sensor_check import make_sensor_check
from jaxunshear.config.networks import DISENTANGLED, POSENET, PoseNet, UnshearNet
from jaxunshear.config.sensor import TACTIP_331, Camera, Preprocess
from jaxunshear.config.targets import count_outputs
from jaxunshear.config.training import Training
from jaxunshear.config.types import raise_first_problem
from jaxunshear.environment import FAST, PLAIN, keep_freed_memory
from jaxunshear.errors import UserError, get_first_line
from jaxunshear.files import Json
from jaxunshear.inference.forward import compile_networks, jit_for_inference
from jaxunshear.models import posenet, unshearnet
from jaxunshear.models.fast import compiled_kernels
from jaxunshear.models.layer_choice import use_layers
from jaxunshear.models.registry import scale_inputs
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.progress import Progress
from jaxunshear.training.checkpoint import TrainedNetwork
from jaxunshear.training.tasks import make_unshear_task
from verification.clock import SIZE, make_matrix_product, time_call

TRAIN_CASES = ((256, 8), (128, 32))  # size in px, batch
INFER_SIZES = (256, 128)
FROZEN: Json = {"freezing": True}  # PyTorch's weights as constants too
NOT_INSTALLED = "is not installed"  # which is no failure
Rounds = tuple[int, float]  # how many, and seconds of each
# long enough that threads that still spin for the other side's work do not count
ROUNDS: Rounds = (7, 4.0)
Work = Callable[[], object]
Sides = Iterator[tuple[str, Callable[[], Work]]]


def bench_train(
    size: int | None = None, batch: int | None = None, rounds: Rounds = ROUNDS
) -> list[Json]:
    """Time training steps of TRAIN_CASES, or of a size and batch.

    Raises UserError for a bad size.
    """
    cases = list(TRAIN_CASES)
    if size is not None or batch is not None:
        cases = [(128 if size is None else size, 32 if batch is None else batch)]

    def count_operations(px: int) -> int:
        return 6 * count_multiplications(UnshearNet(size=px), True)

    return _measure_cases("bench train", cases, _make_training_sides, count_operations, rounds)


def bench_infer(
    size: int | None = None, batch: int | None = None, rounds: Rounds = ROUNDS
) -> list[Json]:
    """Time encoder and canonical decoder, for `batch` images at a time (1)."""
    sizes = INFER_SIZES if size is None else (size,)
    cases = [(px, 1 if batch is None else batch) for px in sizes]

    def count_operations(px: int) -> int:
        return 2 * count_multiplications(UnshearNet(size=px), False)

    return _measure_cases("bench infer", cases, _make_inference_sides, count_operations, rounds)


def bench_frame(size: int | None = None, rounds: Rounds = ROUNDS) -> list[Json]:
    """Time encoder, canonical decoder and PoseNet, one image at a time as for a robot."""
    cases = [(px, 1) for px in (INFER_SIZES if size is None else (size,))]

    def count_operations(px: int) -> int:
        return 2 * (
            count_multiplications(UnshearNet(size=px), False)
            + count_posenet_multiplications(PoseNet(size=px))
        )

    return _measure_cases("bench frame", cases, _make_frame_sides, count_operations, rounds)


def _measure_cases(
    title: str,
    cases: Sequence[tuple[int, int]],
    make_sides: Callable[[int, int], Sides],
    count_operations: Callable[[int], int],
    rounds: Rounds,
) -> list[Json]:
    """Time the sides of all cases; `count_operations` is of one image, by its size in px."""
    keep_freed_memory()
    rows = []
    with Progress(title, len(cases), unit="cases") as progress:
        for px, images in cases:
            rows += _compare_sides(make_sides(px, images), px, images, count_operations(px), rounds)
            progress.advance(1)
    return rows


def _make_network(size: int, batch: int) -> UnshearNet:
    if batch < 1:
        raise UserError(f"--batch {batch}: use at least 1")
    net = UnshearNet(size=size)
    raise_first_problem(net, "UnshearNet")
    return net


def _make_training_sides(size: int, batch: int) -> Sides:
    net, training = _make_network(size, batch), Training(batch=batch)
    canonical, sheared = make_noise_images(batch, size)

    def ours(layers: str, form: str) -> Work:
        step, first = make_timed_step(make_unshear_task(net, training), training)
        state = [first]
        program = jax.jit(step, donate_argnums=0)
        inputs = jax.device_put({"canonical": canonical, "sheared": sheared})

        def work() -> None:
            with use_layers(layers), compiled_kernels.use_form(form):
                state[0], metrics = program(state[0], inputs)
            jax.block_until_ready(metrics)

        return work

    def theirs(compiled: bool) -> Work:
        torch, torch_networks = _import_torch_networks()
        torch.manual_seed(0)
        twin = _make_torch_unshearnet(net, rounds=True).train()
        step = torch_networks.make_training_step(twin, training, compiled)
        inputs = [
            torch.as_tensor(images.transpose(0, 3, 1, 2).copy()).to(_get_torch_device())
            for images in (canonical, sheared)
        ]
        return lambda: float(step(*inputs)) and None

    yield "jaxunshear", lambda: ours(FAST, "compiled")
    if compiled_kernels.is_available():
        yield "jaxunshear, XLA alone", lambda: ours(FAST, "xla")
    yield "jaxunshear, plain layers", lambda: ours(PLAIN, "xla")
    yield "pytorch", lambda: theirs(False)
    yield "pytorch, compiled", lambda: theirs(True)


def _make_inference_sides(size: int, batch: int) -> Sides:
    net = _make_network(size, batch)
    _, sheared = make_noise_images(batch, size)

    def ours(layers: str) -> Work:
        variables = init_variables(partial(unshearnet.init, net))
        run = jit_for_inference(partial(unshearnet.unshear, net), variables)
        inputs = np.asarray(sheared, np.float32) / 255

        def work() -> None:
            with use_layers(layers):
                np.asarray(run(inputs))

        return work

    def theirs(compiled: bool) -> Work:
        torch, _ = _import_torch_networks()
        run = _make_torch_unshearnet(net).eval().unshear
        if compiled:
            run = torch.compile(run, dynamic=False, options=FROZEN)
        image = torch.from_numpy(sheared.transpose(0, 3, 1, 2).astype(np.float32) / 255)
        image = image.contiguous(memory_format=torch.channels_last)

        def work() -> None:
            with torch.inference_mode():
                run(image.to(_get_torch_device())).cpu().numpy()

        return work

    yield "jaxunshear", lambda: ours(FAST)
    yield "jaxunshear, plain layers", lambda: ours(PLAIN)
    yield "pytorch", lambda: theirs(False)
    yield "pytorch, compiled", lambda: theirs(True)


def _make_frame_sides(size: int, batch: int) -> Sides:
    net, pose_net = _make_network(size, batch), PoseNet(size=size)
    image = make_noise_images(batch, size)[1, 0, ..., 0]

    def ours(layers: str) -> Work:
        run = compile_networks(_make_stream_networks(net, pose_net), False)

        def work() -> None:
            with use_layers(layers):
                jax.device_get(run(scale_inputs(image[None])))

        return work

    yield "jaxunshear", lambda: ours(FAST)
    yield "jaxunshear, plain layers", lambda: ours(PLAIN)
    if jax.default_backend() == "cpu":  # the only device of ONNX Runtime here
        yield "jaxunshear, by onnxruntime", lambda: _make_engine_work(net, pose_net, image)
        yield "onnxruntime", lambda: _make_exported_work(net, pose_net, image)
    yield "pytorch", lambda: _make_torch_stream_work(net, pose_net, image, False)
    yield "pytorch, compiled", lambda: _make_torch_stream_work(net, pose_net, image, True)


def _make_stream_networks(net: UnshearNet, pose_net: PoseNet) -> dict[str, TrainedNetwork]:
    unshears = init_variables(partial(unshearnet.init, net))
    reads_poses = init_variables(partial(posenet.init, pose_net, count_outputs(TARGETS)))
    return {
        DISENTANGLED: TrainedNetwork(net, unshears, ()),
        POSENET: TrainedNetwork(pose_net, reads_poses, TARGETS),
    }


def _make_engine_work(net: UnshearNet, pose_net: PoseNet, image: np.ndarray) -> Work:
    from jaxunshear.apps.export.engine import compile_for_frames

    run = compile_for_frames(_make_stream_networks(net, pose_net), False)
    return lambda: run(scale_inputs(image[None])) is None


def _make_exported_work(net: UnshearNet, pose_net: PoseNet, image: np.ndarray) -> Work:
    from jaxunshear.apps.export.onnx_file import build_onnx, make_onnx_runner

    lattice = compute_rest_lattice(TACTIP_331, Camera(), Preprocess(size=net.size))
    networks = jax.device_get(_make_stream_networks(net, pose_net))
    parts = ExportedModel(networks, None, make_sensor_check(lattice.rest, net.size))
    run = make_onnx_runner(build_onnx(parts, 1, None, {}), parts)
    return lambda: run(image[None]) is None


def _make_torch_stream_work(
    net: UnshearNet, pose_net: PoseNet, image: np.ndarray, compiled: bool
) -> Work:
    torch, torch_networks = _import_torch_networks()
    unshear_twin = _make_torch_unshearnet(net).eval()
    outputs = count_outputs(TARGETS)
    pose_twin = torch_networks.use_channels_last(torch_networks.TorchPoseNet(pose_net, outputs))
    pose_twin = pose_twin.to(_get_torch_device()).eval()

    def perceive(image: Any) -> tuple[Any, Any]:
        unsheared = unshear_twin.unshear(image[None, None].float() / 255)
        return unsheared, pose_twin(unsheared)

    run = torch.compile(perceive, dynamic=False, options=FROZEN) if compiled else perceive
    inputs = torch.from_numpy(image.copy())

    def work() -> None:
        with torch.inference_mode():
            unsheared, pose = run(inputs.to(_get_torch_device()))
            unsheared.cpu().numpy(), pose.cpu().numpy()

    return work


def _import_torch_networks() -> tuple[Any, Any]:
    """Import PyTorch, and our networks in it.

    Each size is compiled for itself (`dynamic=False`): from the second size on PyTorch compiles one
    program for all sizes, which is slower.
    """
    import torch

    from benchmarks import torch_networks

    return torch, torch_networks


def _make_torch_unshearnet(net: UnshearNet, rounds: bool = False) -> Any:
    """Make the network on JAX' device; `rounds`: on a GPU products have ten bits, as JAX trains.

    JAX' inference has full float32 on all devices (`jit_for_inference`).
    """
    torch, torch_networks = _import_torch_networks()
    torch.set_float32_matmul_precision("high" if rounds else "highest")
    torch.backends.cudnn.allow_tf32 = rounds
    twin = torch_networks.TorchUnshearNet(net)
    return torch_networks.use_channels_last(twin).to(_get_torch_device())


def _get_torch_device() -> str:
    """Return PyTorch's name of JAX' device."""
    return "cuda" if jax.default_backend() == "gpu" else "cpu"


def _compare_sides(
    sides: Sides, size: int, batch: int, operations: int, rounds: Rounds
) -> list[Json]:
    """Time the sides in turns, and return a row for each."""
    works: dict[str, Work] = {}
    rows: dict[str, Json] = {}
    for name, make_work in sides:
        rows[name] = {"name": name, "size": size, "batch": batch}
        try:
            work = make_work()
            start = time.perf_counter()
            work()
            rows[name]["compile_s"] = time.perf_counter() - start
            work()
            works[name] = work
        except Exception as error:
            if name == "jaxunshear":
                raise
            rows[name]["failed"] = _describe_failure(error)
    times, product_s = _time_in_turns(works, rounds)
    rate = 2 * SIZE**3 / product_s
    first = np.median(next(iter(times.values())))
    for name, seconds in times.items():
        median = np.median(seconds)
        rows[name] |= {
            "images_per_s": float(batch / median),
            "ms_per_image": float(1e3 * median / batch),
            "ms_p95": float(1e3 * np.percentile(seconds, 95) / batch),
            "ms_p99": float(1e3 * np.percentile(seconds, 99) / batch),
            "ratio": float(median / first),  # of the time to ours
            "share": float(batch * operations / median / rate),
            "steps": len(seconds),
            "product_ms": 1e3 * product_s,
            "failed": "",
        }
    return list(rows.values())


def _describe_failure(error: Exception) -> str:
    if isinstance(error, ModuleNotFoundError):
        extra = "torch" if error.name == "torch" else "onnx"
        return f"{error.name} {NOT_INSTALLED}: pip install -c constraints.txt '.[{extra}]'"
    return f"{type(error).__name__}: {get_first_line(error)}"


def _time_in_turns(works: dict[str, Work], rounds: Rounds) -> tuple[dict[str, list[float]], float]:
    """Return the seconds of each work, and the median of a matrix product in between."""
    times: dict[str, list[float]] = {name: [] for name in works}
    product, product_times = make_matrix_product(), []
    count, seconds = rounds
    for _ in range(count):
        for name, work in works.items():
            end = time.perf_counter() + seconds
            while True:
                times[name].append(time_call(work))
                if time.perf_counter() >= end:
                    break
        product_times += [time_call(product) for _ in range(3)]
    return times, statistics.median(product_times)


def format_table(rows: Sequence[Json]) -> str:
    """Format rows for people."""
    lines = [f"{'':26} px   batch  images/s  ms/image     p95  ratio  share  compile s"]
    for row in rows:
        head = f"{row['name']:26} {row['size']:<4} {row['batch']:<5}"
        if row["failed"]:
            absent = NOT_INSTALLED in row["failed"]
            lines.append(f"{head}  {'' if absent else 'FAILED: '}{row['failed']}")
            continue
        lines.append(
            f"{head} {row['images_per_s']:9.1f} {row['ms_per_image']:9.2f} {row['ms_p95']:7.2f} "
            f"{row['ratio']:6.2f} {row['share']:6.2f} {row['compile_s']:10.1f}"
        )
    return "\n".join(lines)
