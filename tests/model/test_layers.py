"""Batch normalisation + ReLU against Flax, on plain arrays and on bordered blocks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from jaxunshear.model import conv, layers


def inputs(shape, offset=0.0):
    rng = np.random.default_rng(0)
    c = shape[-1]
    arrays = rng.normal(offset, 1, shape), rng.normal(1, 0.3, c), rng.normal(0, 0.5, c)
    return [jnp.asarray(a, jnp.float32) for a in arrays]


def flax_norm_relu(x, scale, bias):
    norm = nn.BatchNorm(use_running_average=False, use_fast_variance=False, epsilon=layers.EPSILON)
    stats = {"mean": jnp.zeros_like(scale), "var": jnp.ones_like(scale)}
    y, _ = norm.apply({"params": {"scale": scale, "bias": bias}, "batch_stats": stats}, x, mutable=["batch_stats"])
    return jax.nn.relu(y)


def agree(ours, reference, arguments):
    for f in (ours, jax.jit(ours)):
        expected, pull_expected = jax.vjp(reference, *arguments)
        got, pull = jax.vjp(f, *arguments)
        np.testing.assert_allclose(got, expected, atol=2e-5)
        dy = jnp.asarray(np.random.default_rng(1).normal(size=expected.shape), jnp.float32)
        for gradient, gradient_expected in zip(pull(dy), pull_expected(dy), strict=True):
            np.testing.assert_allclose(gradient, gradient_expected, atol=3e-4)


def test_equals_flax():
    agree(lambda *a: layers.norm_relu(*a, False)[0], flax_norm_relu, inputs((4, 6, 6, 5)))


def test_bordered_blocks_count_only_the_pixels_inside():
    """Garbage outside the image reaches neither the statistics nor the output, and gets no gradient."""

    def ours(x, scale, bias):
        padded = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)), constant_values=50.0)
        y = layers.norm_relu(conv.to_blocks(padded, 2), scale, bias, True)[0]
        whole = conv.from_blocks(y, 2)
        border = whole.at[:, 1:-1, 1:-1].set(0)
        return whole[:, 1:-1, 1:-1] + jnp.sum(jnp.abs(border))  # zero outside, or this disagrees

    agree(ours, flax_norm_relu, inputs((3, 6, 8, 5)))


def test_gradient_outside_is_zero():
    x, scale, bias = inputs((2, 4, 4, 8))
    gradient = jax.grad(lambda x: jnp.sum(layers.norm_relu(x, scale[:2], bias[:2], True)[0] ** 2))(x)
    outside = np.repeat(layers.inside(4, 4), 2, -1) == 0
    assert np.all(np.asarray(gradient)[:, outside] == 0)
    assert np.any(np.asarray(gradient)[:, ~outside] != 0)


def test_inside_marks_the_padded_ring():
    mask = conv.from_blocks(jnp.asarray(layers.inside(4, 3))[None], 2)[0, ..., 0]
    expected = np.zeros((8, 6))
    expected[1:-1, 1:-1] = 1
    np.testing.assert_array_equal(mask, expected)


def test_variance_of_a_large_offset_is_not_cancelled():
    x, scale, bias = inputs((8, 8, 8, 4), offset=1000.0)
    _, mean, variance = layers.norm_relu(x, scale, bias, False)
    np.testing.assert_allclose(mean, np.mean(np.float64(x), (0, 1, 2)), rtol=1e-5)
    np.testing.assert_allclose(variance, np.var(np.float64(x), (0, 1, 2)), rtol=1e-3)


def test_constant_channel_stays_finite():
    x = jnp.ones((2, 4, 4, 3))
    gradient = jax.grad(lambda x: jnp.sum(layers.norm_relu(x, jnp.ones(3), jnp.ones(3), False)[0] ** 2))(x)
    assert np.all(np.isfinite(gradient))


@pytest.mark.parametrize("bordered", [False, True])
def test_running_statistics_follow_the_batch(bordered):
    x, *_ = inputs((2, 6, 6, 8))
    module = layers.NormRelu(bordered)
    variables = module.init(jax.random.key(0), x, True)
    np.testing.assert_array_equal(variables["batch_stats"]["mean"], 0)  # init leaves them alone
    scale = variables["params"]["scale"]
    _, mean, variance = layers.norm_relu(x, scale, jnp.zeros_like(scale), bordered)
    for _ in range(200):
        _, updates = module.apply(variables, x, True, mutable=["batch_stats"])
        variables = variables | updates
    np.testing.assert_allclose(variables["batch_stats"]["mean"], mean, rtol=1e-4)
    np.testing.assert_allclose(variables["batch_stats"]["var"], variance, rtol=1e-4)
    trained, _ = module.apply(variables, x, True, mutable=["batch_stats"])
    np.testing.assert_allclose(module.apply(variables, x, False), trained, atol=1e-4)
