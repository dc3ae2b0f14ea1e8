"""Losses, metrics and inference at their extremes: values and gradients finite, NaN never hidden, narrow numbers near wide ones.

Inference is that of networks trained for `LEARNT` steps: fresh ones make nearly the same of every
image.
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
from jaxunshear.models import posenet
from jaxunshear.models.weights import Variables
from jaxunshear.training import checkpoint, losses
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
    infer_all,
    run_steps,
)
from verification.network_trainings import NET, POSENET, TRAINING, get_kind, make_batch
from verification.stability_networks import CaseOutput, NetworkCase

LEARNT, UNSEEN = 60, 500  # steps, and the step whose batch is none of theirs
SATURATED = 1e4  # a logit whose sigmoid is 0 or 1 to the last bit
FLOAT64_MOST = 1e-5  # by which any output in [0, 1] may differ between float32 and float64
EQUAL_SLOPE = (
    1e-6  # allowed of a gradient that is zero by definition, an image's similarity to itself
)
VALUE, CAST = "value and gradient", "parameters, statistics and images cast"
SIZES = {"ms_ssim": 128, "ssim": 64}
Metric = Callable[..., jax.Array]


def list_value_cases() -> Iterator[NetworkCase]:
    """All of them; names are unique and begin with "network"."""
    yield from _losses()
    yield from _metrics()
    for net in (NET, POSENET):
        yield from _inference(net)


def _case(
    name: str, line: str, find: Callable[..., CaseOutput], *given: object, **more: object
) -> NetworkCase:
    return NetworkCase(f"network {name}", lambda folder: find(*given, **more), line)


# Losses: of logits, as the trainings take them.


def _losses() -> Iterator[NetworkCase]:
    dots, usual = (make_pairs(step, 4, 64)["canonical"] for step in (0, 1))
    sharp = SATURATED * (2 * convert_to_floats(dots) - 1)
    for logit in (SATURATED, -SATURATED):
        yield _case(
            f"losses, logits {logit:g}",
            VALUE,
            _loss,
            np.full_like(sharp, logit),
            convert_to_floats(usual),
        )
    for name, kind in KINDS.items():
        yield _case(f"losses, images {name}", VALUE, _loss, sharp, kind(convert_to_floats(usual)))
    yield _case("losses, equal images", VALUE, _loss, sharp, convert_to_floats(dots), equal=True)
    for net in (NET, POSENET):
        yield _case(f"{get_kind(net)}, saturated outputs", "a training step", _check_saturated, net)


def _loss(logits: np.ndarray, images: np.ndarray, equal: bool = False) -> CaseOutput:
    """All losses of images and of poses that come out of a sigmoid, and their slopes by its logits."""
    side, target = logits.shape[1], jnp.asarray(images)
    counts = losses.count_crop_coverage(
        losses.sample_corners(jax.random.key(0), len(logits), 20, side, 10), side, 10
    )
    terms: dict[str, Callable[[jax.Array], jax.Array]] = {
        "supervised": lambda x: losses.compute_supervised_loss(x, target),
        "reconstruction": lambda x: losses.compute_reconstruction_loss(x, target),
        "patch": lambda x: losses.compute_patch_loss(x, target, counts),
        "pose": lambda x: losses.compute_pose_loss(
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


def _check_saturated(net: Net) -> CaseOutput:
    """A network whose last layers shout: every output is 0 or 1, and a training step must live with it."""
    start, step, use = build_programs(net, TRAINING)
    params = dict(train_briefly(net)["params"])
    if isinstance(net, PoseNet):
        params["Dense_1"] = _loud(params["Dense_1"])
    else:
        params |= {
            decoder: params[decoder] | {"Last_0": _loud(params[decoder]["Last_0"])}
            for decoder in ("DC", "DS")
        }
    variables = {"params": params, "batch_stats": train_briefly(net)["batch_stats"]}
    state, batch = start._replace(**variables, average=variables), _floats(net, 1)
    after, terms = step(
        state, batch, np.float32(TRAINING.learning_rate), np.float32(TRAINING.patch_weight)
    )
    reported = dict(use(variables, get_images(batch)))
    outputs = np.asarray(reported["outputs" if isinstance(net, PoseNet) else "unsheared"])
    wrong = (
        ""
        if np.isin(outputs, (0, 1)).mean() > 0.9
        else "the outputs are not saturated: nothing was tried"
    )
    loss, gradient = (
        float(terms[name])
        for name in ("pose" if isinstance(net, PoseNet) else "supervised", "gradient")
    )
    return CaseOutput(
        {"terms": terms, "state": after, "answers": reported},
        wrong=wrong,
        loss=loss,
        gradient=gradient,
    )


def _loud(layer: Variables) -> Variables:
    return jax.tree.map(lambda leaf: 1e8 * leaf, layer)


# Metrics.


def _metrics() -> Iterator[NetworkCase]:
    for name, size in SIZES.items():
        metric = get_metric(name)
        dots, other = (convert_to_floats(make_pairs(step, 2, size)["canonical"]) for step in (0, 1))
        black, white, grey = (np.full_like(dots, value) for value in (0.0, 1.0, 0.5))
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
            yield _case(f"{name}, {title}", VALUE, _score, metric, a, b)
        for title, a in (("black", black), ("white", white), ("grey", grey), ("dots", dots)):
            yield _case(f"{name}, {title} against itself", VALUE, _score, metric, a, a, equal=True)
        yield _case(f"{name}, a NaN", VALUE, _score_nan, metric, dots, other)


def get_metric(name: str) -> Metric:
    if name == "ssim":
        return metrics.ssim
    return functools.partial(metrics.ms_ssim, scales=metrics.count_scales(SIZES[name]))


def _score(metric: Metric, a: np.ndarray, b: np.ndarray, equal: bool = False) -> CaseOutput:
    values, slopes = (
        np.asarray(metric(a, b)),
        np.asarray(jax.grad(lambda x: jnp.sum(metric(x, b)))(jnp.asarray(a))),
    )
    largest = float(np.max(np.abs(slopes)))
    outside = "" if (np.abs(values) <= 1 + 1e-5).all() else f"{values.tolist()} is beyond 1"
    if equal:
        off = np.abs(values - 1).max()
        outside = outside or ("" if off < 1e-5 else f"{values.tolist()} of equal images")
        return CaseOutput(
            {"values": values, "slopes": slopes}, error=largest, bar=EQUAL_SLOPE, wrong=outside
        )
    return CaseOutput(
        {"values": values, "slopes": slopes}, gradient=largest, loss=float(values[0]), wrong=outside
    )


def _score_nan(metric: Metric, a: np.ndarray, b: np.ndarray) -> CaseOutput:
    """A NaN in the second image is seen in its score, and in no other."""
    spoilt = a.copy()
    spoilt[1, 20, 20] = np.nan
    clean, scores = np.asarray(metric(a, b)), np.asarray(metric(spoilt, b))
    return CaseOutput(
        {"others": scores[0]}, {"score": scores[1]}, error=float(abs(scores[0] - clean[0])), bar=0.0
    )


# Inference.


@functools.cache
def train_briefly(net: Net) -> Variables:
    """Variables of a short training."""
    with tempfile.TemporaryDirectory() as folder:
        run_steps(
            net,
            replace(TRAINING, learning_rate=1e-2),
            lambda step: _floats(net, step),
            Path(folder),
            LEARNT,
        )
        return jax.device_get(checkpoint.load_best(Path(folder)))


def _floats(net: Net, step: int) -> dict[str, np.ndarray]:
    return corrupt_images(convert_to_floats, make_batch(net, step, 4))


def _inference(net: Net) -> Iterator[NetworkCase]:
    name = f"{get_kind(net)}, inference"
    yield _case(f"{name}, one image with a NaN", "outputs image by image", _nan_inference, net)
    yield _case(f"{name} in float64", CAST, _precision, net, jnp.float64, FLOAT64_MOST)


def _nan_inference(net: Net) -> CaseOutput:
    """A NaN in the second image reaches what is inferred from it, and from no other image."""
    run, images = build_programs(net, TRAINING).infer, get_images(make_batch(net, UNSEEN, 4))
    clean, broken = (
        jax.device_get(run(train_briefly(net), given))
        for given in (convert_to_floats(images), insert_nan(images))
    )
    others = {name: np.delete(values, 1, 0) for name, values in broken.items()}
    apart = max(
        float(np.max(np.abs(np.delete(clean[name], 1, 0) - others[name]))) for name in others
    )
    return CaseOutput(
        others, {name: values[1] for name, values in broken.items()}, error=apart, bar=0.0
    )


def _precision(net: Net, kind: type, bar: float) -> CaseOutput:
    names = ("outputs",) if isinstance(net, PoseNet) else ("unsheared", "sheared")
    return compare_precision(
        functools.partial(infer_all, net),
        (train_briefly(net), get_images(_floats(net, UNSEEN))),
        names,
        kind,
        bar,
    )


def compare_precision(
    run: Callable[..., dict], given: tuple, names: Sequence[str], kind: type, bar: float
) -> CaseOutput:
    """`run` of arrays, `given` as float32 against `kind`, over all of its outputs `names`, in [0, 1]: the largest
    difference."""

    def run_in_precision(kind: type) -> dict[str, np.ndarray]:
        found = jax.jit(run)(*jax.tree.map(lambda leaf: jnp.asarray(leaf, kind), given))
        return {name: np.asarray(found[name], np.float64) for name in names}

    usual = run_in_precision(jnp.float32)
    with jax.enable_x64(kind == jnp.float64):
        other = run_in_precision(kind)
    difference = np.concatenate([(usual[name] - other[name]).ravel() for name in names])
    error = np.abs(difference).max()
    spread = min(float(values.std(0).max()) for values in usual.values())
    wrong = (
        "" if spread > 0.02 else "the network gives the same for every image: nothing was compared"
    )
    wrong = wrong or ("" if error > 0 else "not one number differs: nothing was cast")
    return CaseOutput({"float32": usual, "other": other}, error=float(error), bar=bar, wrong=wrong)
