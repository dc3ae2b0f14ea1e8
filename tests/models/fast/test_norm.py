"""Batch normalisation + ReLU against Flax, between all layouts; the compiled passes against XLA's."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from jaxunshear.models.fast import compiled_kernels, conv, networks, norm
from tests.helpers.convolutions import check_close

LAYOUTS = [(a, b) for a in ("plain", "blocks") for b in compiled_kernels.LAYOUTS]
WIDE = [("plain", "blocks"), ("blocks", "padded"), ("blocks", "blocks")]  # as networks have them
NARROW = [("plain", "padded"), ("blocks", "plain")]
compiled = pytest.mark.usefixtures("compiled")
CHANNELS = (5, 32)  # XLA's passes alone, and the compiled ones


def inputs(shape, offset=0.0):
    rng = np.random.default_rng(0)
    c = shape[-1]
    arrays = rng.normal(offset, 1, shape), rng.normal(1, 0.3, c), rng.normal(0, 0.5, c)
    return [jnp.asarray(a, jnp.float32) for a in arrays]


def flax_norm_relu(x, scale, bias):
    plain = nn.BatchNorm(use_running_average=False, use_fast_variance=False, epsilon=norm.EPSILON)
    stats = {"mean": jnp.zeros_like(scale), "var": jnp.ones_like(scale)}
    variables = {"params": {"scale": scale, "bias": bias}, "batch_stats": stats}
    return jax.nn.relu(plain.apply(variables, x, mutable=["batch_stats"])[0])


@pytest.mark.parametrize(
    ("source", "target", "channels"),
    [
        *((*layouts, 5) for layouts in LAYOUTS if layouts not in WIDE),
        *(pytest.param(*layouts, 5, marks=pytest.mark.long) for layouts in WIDE),
        *((*layouts, 32) for layouts in WIDE),
    ],
)
def test_equals_flax(source, target, channels):
    """Garbage outside the image reaches neither the statistics nor the output, and gets no gradient."""

    def ours(x, scale, bias):
        padded = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)), constant_values=50.0)
        given = conv.to_blocks(padded) if source == "blocks" else x
        y = norm.norm_relu(given, scale, bias, source, target)[0]
        full = norm.convert_layout(y, target, "padded")
        border = full.at[:, 1:-1, 1:-1].set(0)
        return full[:, 1:-1, 1:-1] + jnp.sum(jnp.abs(border))  # zero outside, or this disagrees

    arguments = inputs((3, 6, 8, channels))
    dy = jnp.asarray(np.random.default_rng(1).normal(size=arguments[0].shape), jnp.float32)

    def both(f):
        values, pull = jax.vjp(f, *arguments)
        return values, pull(dy)

    expected, slopes_expected = jax.jit(lambda: both(flax_norm_relu))()
    for got, slopes in (both(ours), jax.jit(lambda: both(ours))()):
        np.testing.assert_allclose(got, expected, atol=2e-5)
        for slope, slope_expected in zip(slopes, slopes_expected, strict=True):
            np.testing.assert_allclose(slope, slope_expected, atol=3e-4)


XLA = norm._moments_by_xla, norm._affine_relu_by_xla, norm._slopes_by_xla, norm._gradient_by_xla
PASSES = ("moments", "affine_relu", "slopes", "gradient")
OURS = tuple(getattr(compiled_kernels, name) for name in PASSES)


@compiled
@pytest.mark.parametrize(
    ("source", "target"),
    [
        *(*WIDE, ("plain", "plain")),
        *(pytest.param(*layouts, marks=pytest.mark.long) for layouts in NARROW),
    ],
)
def test_compiled_passes_are_xla_s(source, target):
    """Bands and tails of every kind."""
    at = {"source": source, "target": target}

    def run(passes, x, dy, factor, shift):
        moments, affine_relu, slopes, gradient = passes
        mean, constant, tilt = shift + 1, factor - 1, shift * factor
        return (
            moments(x, source=source),
            affine_relu(x, factor, shift, **at),
            slopes(x, dy, factor, shift, mean, **at),
            gradient(x, dy, factor, shift, mean, constant, tilt, **at),
        )

    odd = [(32, 7, 5)] if "blocks" not in (source, target) else []
    for channels, rows, columns in [(16, 2, 2), (112, 6, 10), (80, 32, 32), *odd]:
        plain, factor, shift = inputs((3, rows, columns, channels))
        x = norm.convert_layout(plain, "plain", source)
        dy = norm.convert_layout(plain[::-1], "plain", target)
        expected, got = (
            jax.tree.leaves(jax.jit(partial(run, passes))(x, dy, factor, shift))
            for passes in (XLA, OURS)
        )
        for one, other in zip(expected, got, strict=True):
            check_close(other, one, 2e-6 * (rows * columns) ** 0.5)


@compiled
def test_the_network_takes_the_compiled_passes_and_twice_gives_the_same_bits():
    x, scale, bias = inputs((5, 9, 9, 4 * 32))
    scale, bias = scale[:32], bias[:32]

    def total(x):
        return jnp.sum(jnp.sin(norm.norm_relu(x, scale, bias, "blocks", "padded")[0]))

    grad = jax.jit(jax.grad(total))
    text = grad.lower(x).as_text()
    for name in ("Moments", "AffineRelu", "Slopes", "Gradient"):
        assert compiled_kernels.NAMES[name] in text
    first = grad(x)
    for _ in range(5):
        np.testing.assert_array_equal(grad(x), first)


@pytest.mark.parametrize("source", ["plain", "blocks"])
def test_what_is_not_finite_spoils_its_channel_alone(source):
    x, scale, bias = inputs((2, 4, 6, 32))
    given = norm.convert_layout(x.at[1, 2, 3, 7].set(jnp.nan), "plain", source)
    y, mean, variance = norm.norm_relu(given, scale, bias, source, "plain")
    assert np.flatnonzero(np.isnan(y).any((0, 1, 2))).tolist() == [7]
    assert np.isnan(mean[7]) and np.isnan(variance[7]) and np.isfinite(np.delete(mean, 7)).all()


def test_second_derivatives_are_those_of_flax():
    x, scale, bias = inputs((2, 4, 4, 16))

    def slope(f):
        inner = jax.grad(lambda x, scale: jnp.sum(jnp.sin(f(x, scale, bias))))
        return jax.jit(jax.grad(lambda x, scale: jnp.sum(inner(x, scale) ** 2), (0, 1)))(x, scale)

    ours = slope(lambda *given: norm.norm_relu(*given, "plain", "plain")[0])
    for got, expected in zip(ours, slope(flax_norm_relu), strict=True):
        check_close(got, expected, 2e-4)


@pytest.mark.parametrize(("source", "target"), LAYOUTS)
def test_layouts_there_and_back(source, target):
    x, *_ = inputs((2, 4, 6, 3))
    given = norm.convert_layout(x, "plain", source)
    there = norm.convert_layout(given, source, target)
    assert there.shape == compiled_kernels._convert_shape(given.shape, source, target)
    np.testing.assert_array_equal(norm.convert_layout(there, target, "plain"), x)


def test_inside_marks_the_padded_ring_which_gets_no_gradient():
    mask = norm.make_inside_mask(4, 3)
    expected = np.pad(np.ones((6, 4)), 1)
    np.testing.assert_array_equal(conv.from_blocks(jnp.asarray(mask[None]))[0, ..., 0], expected)
    x, scale, bias = inputs((2, 4, 3, 8))
    gradient = jax.grad(
        lambda x: jnp.sum(norm.norm_relu(x, scale[:2], bias[:2], "blocks", "blocks")[0] ** 2)
    )(x)
    inside = np.repeat(mask, 2, -1) != 0
    assert not np.any(gradient[:, ~inside]) and np.any(gradient[:, inside])


@pytest.mark.parametrize("channels", CHANNELS)
def test_variance_of_a_large_offset_is_not_cancelled(channels):
    x, scale, bias = inputs((8, 8, 8, channels), offset=1000.0)
    _, mean, variance = norm.norm_relu(x, scale, bias, "plain", "plain")
    np.testing.assert_allclose(mean, np.mean(np.float64(x), (0, 1, 2)), rtol=1e-5)
    np.testing.assert_allclose(variance, np.var(np.float64(x), (0, 1, 2)), rtol=1e-3)


@pytest.mark.parametrize("channels", CHANNELS)
def test_constant_channel_stays_finite(channels):
    x, ones = jnp.ones((2, 4, 4, channels)), jnp.ones(channels)

    def total(x):
        return jnp.sum(norm.norm_relu(x, ones, ones, "plain", "plain")[0] ** 2)

    assert np.all(np.isfinite(jax.grad(total)(x)))


@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("source", ["plain", "blocks"])
def test_running_statistics_follow_the_batch(source, channels):
    x = norm.convert_layout(inputs((2, 6, 6, channels))[0], "plain", source)
    module = networks.NormRelu(source, "plain")
    variables = module.init(jax.random.key(0), x, True)
    np.testing.assert_array_equal(variables["batch_stats"]["mean"], 0)  # init leaves them alone
    scale = variables["params"]["scale"]
    _, mean, variance = norm.norm_relu(x, scale, jnp.zeros_like(scale), source, "plain")
    follow = jax.jit(lambda variables: module.apply(variables, x, True, mutable=["batch_stats"])[1])
    for _ in range(200):
        variables = variables | follow(variables)
    np.testing.assert_allclose(variables["batch_stats"]["mean"], mean, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(variables["batch_stats"]["var"], variance, rtol=1e-4)
    trained, _ = module.apply(variables, x, True, mutable=["batch_stats"])
    np.testing.assert_allclose(module.apply(variables, x, False), trained, atol=1e-4)
