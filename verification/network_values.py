"""Losses, metrics and inference at their extremes.

Values and gradients must be finite, NaN never hidden, and float32 near float64. Inference is that
of networks trained for `LEARNT` steps: fresh ones give nearly the same for every image.
"""

import functools
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.config.networks import PoseNet
from jaxunshear.metrics import images as metrics
from jaxunshear.models import distances, posenet
from jaxunshear.models.weights import Variables
from jaxunshear.training import checkpoint
from verification.network_images import (
    KINDS,
    convert_to_floats,
    corrupt_images,
    insert_nan,
    make_pairs,
)
from verification.network_steps import (
    TARGETS,
    Net,
    build_programs,
    get_images,
    get_loss_name,
    infer_all,
    run_steps,
)
from verification.network_trainings import NET, POSENET, TRAINING, get_kind, make_batch
from verification.stability_networks import CaseOutput, NetworkCase

LEARNT, UNSEEN = 60, 500  # steps, and the step whose batch is none of theirs
SATURATED = 1e4  # a logit whose sigmoid is 0 or 1 to the last bit
FLOAT64_MOST = 1e-5  # by which any output in [0, 1] may differ between float32 and float64
# largest allowed gradient where it is zero by definition: of an image's similarity to itself
EQUAL_SLOPE = 1e-6
VALUE, CAST = "value and gradient", "parameters, statistics and images cast"
SIZES = {"ms_ssim": 128, "ssim": 64}
Metric = Callable[..., jax.Array]


def list_value_cases() -> Iterator[NetworkCase]:
    """List all cases of values; names are unique and begin with "network"."""
    yield from _list_losses()
    yield from _list_metrics()
    for net in (NET, POSENET):
        yield from _list_inference(net)


def _make_case(
    name: str, line: str, measure: Callable[..., CaseOutput], *inputs: object, **options: object
) -> NetworkCase:
    return NetworkCase(f"network {name}", lambda folder: measure(*inputs, **options), line)


# Losses: of logits, as the trainings take them.


def _list_losses() -> Iterator[NetworkCase]:
    dots = convert_to_floats(make_pairs(0, 4, 64)["canonical"])
    others = convert_to_floats(make_pairs(1, 4, 64)["canonical"])
    sharp = SATURATED * (2 * dots - 1)
    for logit in (SATURATED, -SATURATED):
        logits = np.full_like(sharp, logit)
        yield _make_case(f"losses, logits {logit:g}", VALUE, _measure_losses, logits, others)
    for name, kind in KINDS.items():
        name = f"losses, images {name}"
        yield _make_case(name, VALUE, _measure_losses, sharp, kind(others))
    yield _make_case("losses, equal images", VALUE, _measure_losses, sharp, dots, equal=True)
    for net in (NET, POSENET):
        yield _make_case(
            f"{get_kind(net)}, saturated outputs", "a training step", _step_when_saturated, net
        )


def _measure_losses(logits: np.ndarray, images: np.ndarray, equal: bool = False) -> CaseOutput:
    """Measure all losses of images and poses from a sigmoid, and their slopes by its logits."""
    side, target = logits.shape[1], jnp.asarray(images)
    counts = distances.count_crop_coverage(
        distances.sample_corners(jax.random.key(0), len(logits), 20, side, 10), side, 10
    )
    terms: dict[str, Callable[[jax.Array], jax.Array]] = {
        "supervised": lambda x: distances.compute_supervised_loss(x, target),
        "reconstruction": lambda x: distances.compute_supervised_loss(x, target),
        "patch": lambda x: distances.compute_patch_loss(x, target, counts),
        "pose": lambda x: distances.compute_pose_loss(
            x[:, :5, 0, 0], target[:, :5, 0, 0], posenet.list_output_weights(TARGETS)
        ),
    }
    arrays = {}
    for name, term in terms.items():
        total = jax.value_and_grad(lambda x, term=term: jnp.sum(term(jax.nn.sigmoid(x))))
        arrays[name] = total(jnp.asarray(logits))
    largest = max(float(np.max(np.abs(slope))) for _, slope in arrays.values())
    most = max(float(value) for value, _ in arrays.values())
    if equal:
        return CaseOutput(arrays, error=max(most, largest), bar=0.0)
    return CaseOutput(arrays, loss=most, gradient=largest)


def _step_when_saturated(net: Net) -> CaseOutput:
    """Take a training step of a network whose last layers saturate its outputs at 0 or 1."""
    start, step, infer = build_programs(net, TRAINING)
    params = dict(train_briefly(net)["params"])
    if isinstance(net, PoseNet):
        params["Dense_1"] = _scale_up(params["Dense_1"])
    else:
        for decoder in ("DC", "DS"):
            last = _scale_up(params[decoder]["Last_0"])
            params[decoder] = params[decoder] | {"Last_0": last}
    variables = {"params": params, "batch_stats": train_briefly(net)["batch_stats"]}
    state, batch = start._replace(**variables, average=variables), _make_floats(net, 1)
    rate, patch_weight = np.float32(TRAINING.learning_rate), np.float32(TRAINING.losses["patch"])
    after, terms = step(state, batch, rate, patch_weight)
    outputs = dict(infer(variables, get_images(batch)))
    values = np.asarray(outputs["outputs" if isinstance(net, PoseNet) else "unsheared"])
    saturated = np.isin(values, (0, 1)).mean() > 0.9
    return CaseOutput(
        {"terms": terms, "state": after, "answers": outputs},
        wrong="" if saturated else "the outputs are not saturated: nothing was tried",
        loss=float(terms[get_loss_name(net)]),
        gradient=float(terms["gradient"]),
    )


def _scale_up(layer: Variables) -> Variables:
    return jax.tree.map(lambda leaf: 1e8 * leaf, layer)


# Metrics.


def _list_metrics() -> Iterator[NetworkCase]:
    for name, size in SIZES.items():
        metric = get_metric(name)
        dots = convert_to_floats(make_pairs(0, 2, size)["canonical"])
        other = convert_to_floats(make_pairs(1, 2, size)["canonical"])
        black, white, grey = np.zeros_like(dots), np.ones_like(dots), np.full_like(dots, 0.5)
        near = dots.copy()
        near[:, size // 2, size // 2] = 1 - near[:, size // 2, size // 2]
        for title, a, b in (
            ("black against white", black, white),
            ("white against black", white, black),
            ("inverted", dots, 1 - dots),
            ("black against dots", black, dots),
            ("grey against dots", grey, dots),
            ("other dots", dots, other),
            ("one pixel apart", dots, near),
        ):
            yield _make_case(f"{name}, {title}", VALUE, _measure_score, metric, a, b)
        for title, a in (("black", black), ("white", white), ("grey", grey), ("dots", dots)):
            itself = f"{name}, {title} against itself"
            yield _make_case(itself, VALUE, _measure_score, metric, a, a, equal=True)
        yield _make_case(f"{name}, a NaN", VALUE, _measure_nan_score, metric, dots, other)


def get_metric(name: str) -> Metric:
    if name == "ssim":
        return metrics.ssim
    return functools.partial(metrics.ms_ssim, scales=metrics.count_scales(SIZES[name]))


def _measure_score(metric: Metric, a: np.ndarray, b: np.ndarray, equal: bool = False) -> CaseOutput:
    values = np.asarray(metric(a, b))
    slopes = np.asarray(jax.grad(lambda x: jnp.sum(metric(x, b)))(jnp.asarray(a)))
    arrays = {"values": values, "slopes": slopes}
    largest = float(np.max(np.abs(slopes)))
    outside = "" if (np.abs(values) <= 1 + 1e-5).all() else f"{values.tolist()} is beyond 1"
    if equal:
        if not outside and np.abs(values - 1).max() >= 1e-5:
            outside = f"{values.tolist()} of equal images"
        return CaseOutput(arrays, error=largest, bar=EQUAL_SLOPE, wrong=outside)
    return CaseOutput(arrays, gradient=largest, loss=float(values[0]), wrong=outside)


def _measure_nan_score(metric: Metric, a: np.ndarray, b: np.ndarray) -> CaseOutput:
    """Measure scores with a NaN in the second image, which must show in its score alone."""
    spoilt = a.copy()
    spoilt[1, 20, 20] = np.nan
    clean, scores = np.asarray(metric(a, b)), np.asarray(metric(spoilt, b))
    return CaseOutput(
        {"others": scores[0]}, {"score": scores[1]}, error=float(abs(scores[0] - clean[0])), bar=0.0
    )


# Inference.


@functools.cache
def train_briefly(net: Net) -> Variables:
    """Train for a few steps and return the variables."""
    training = replace(TRAINING, learning_rate=1e-2)
    with tempfile.TemporaryDirectory() as folder:
        run_steps(net, training, lambda step: _make_floats(net, step), Path(folder), LEARNT)
        return jax.device_get(checkpoint.load_best(Path(folder)))


def _make_floats(net: Net, step: int) -> dict[str, np.ndarray]:
    return corrupt_images(convert_to_floats, make_batch(net, step, 4))


def _list_inference(net: Net) -> Iterator[NetworkCase]:
    name = f"{get_kind(net)}, inference"
    nan = f"{name}, one image with a NaN"
    yield _make_case(nan, "outputs image by image", _infer_with_nan, net)
    yield _make_case(f"{name} in float64", CAST, _infer_in, net, jnp.float64, FLOAT64_MOST)


def _infer_with_nan(net: Net) -> CaseOutput:
    """Infer with a NaN in the second image, which must show in its outputs alone."""
    infer, images = build_programs(net, TRAINING).infer, get_images(make_batch(net, UNSEEN, 4))
    clean = jax.device_get(infer(train_briefly(net), convert_to_floats(images)))
    broken = jax.device_get(infer(train_briefly(net), insert_nan(images)))
    others = {name: np.delete(values, 1, 0) for name, values in broken.items()}
    errors = [np.abs(np.delete(clean[name], 1, 0) - others[name]) for name in others]
    error = max(float(np.max(values)) for values in errors)
    second = {name: values[1] for name, values in broken.items()}
    return CaseOutput(others, second, error=error, bar=0.0)


def _infer_in(net: Net, kind: type, bar: float) -> CaseOutput:
    names = ("outputs",) if isinstance(net, PoseNet) else ("unsheared", "sheared")
    inputs = (train_briefly(net), get_images(_make_floats(net, UNSEEN)))
    return compare_precision(functools.partial(infer_all, net), inputs, names, kind, bar)


def compare_precision(
    run: Callable[..., dict], inputs: tuple, names: Sequence[str], kind: type, bar: float
) -> CaseOutput:
    """Compare the outputs `names`, in [0, 1], of inputs as float32 and as `kind`."""

    def run_in_precision(kind: type) -> dict[str, np.ndarray]:
        outputs = jax.jit(run)(*jax.tree.map(lambda leaf: jnp.asarray(leaf, kind), inputs))
        return {name: np.asarray(outputs[name], np.float64) for name in names}

    usual = run_in_precision(jnp.float32)
    with jax.enable_x64(kind == jnp.float64):
        other = run_in_precision(kind)
    difference = np.concatenate([(usual[name] - other[name]).ravel() for name in names])
    error = np.abs(difference).max()
    spread = min(float(values.std(0).max()) for values in usual.values())
    wrong = ""
    if not spread > 0.02:
        wrong = "the network gives the same for every image: nothing was compared"
    elif not error > 0:
        wrong = "not one number differs: nothing was cast"
    return CaseOutput({"float32": usual, "other": other}, error=float(error), bar=bar, wrong=wrong)
