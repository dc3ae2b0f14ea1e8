"""conv_valid and the blocked forms against the plain convolutions they replace."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxunshear.config.networks import PinUnshear
from jaxunshear.models import layer_choice, pin_networks
from jaxunshear.models.fast import conv
from jaxunshear.models.fast.conv import convolve

ORDER = ("NHWC", "HWIO", "NHWC")


def normal(*shape: int, dtype=jnp.float32) -> jax.Array:
    return jnp.asarray(np.random.default_rng(sum(shape)).normal(size=shape), dtype)


def plain(x, w, stride=1, padding="VALID"):
    return jax.lax.conv_general_dilated(
        x, w, (stride, stride), padding, dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def close(got, expected, dtype) -> None:
    tolerance = 1e-5 if dtype == jnp.float32 else 1e-12
    assert got.shape == expected.shape
    assert got.dtype == dtype
    np.testing.assert_allclose(
        got, expected, atol=tolerance * float(np.abs(expected).max()), rtol=0
    )


def same_function(ours: Callable, reference: Callable, x, w, dtype) -> None:
    """Values and both gradients, with and without jit."""
    dy = normal(*jax.eval_shape(reference, x, w).shape, dtype=dtype)

    def both(f: Callable) -> tuple[jax.Array, ...]:
        values, pull = jax.vjp(f, x, w)
        return values, *pull(dy)

    expected = jax.jit(lambda: both(reference))()
    for got in (both(ours), jax.jit(lambda: both(ours))()):
        for one, wanted in zip(got, expected, strict=True):
            close(one, wanted, dtype)


@pytest.fixture(
    params=[jnp.float32, pytest.param(jnp.float64, marks=pytest.mark.long)], ids=["f32", "f64"]
)
def dtype(request):
    with jax.enable_x64(request.param == jnp.float64):
        yield request.param


@pytest.mark.parametrize(
    ("k", "c", "n"), [(1, 3, 5), (2, 3, 5), (2, 5, 3), (3, 4, 4), (3, 2, 7), (4, 6, 1)]
)
def test_conv_valid_is_the_plain_convolution(k, c, n, dtype):
    same_function(
        conv.conv_valid,
        plain,
        normal(3, 9, 7, c, dtype=dtype),
        normal(k, k, c, n, dtype=dtype),
        dtype,
    )


@pytest.mark.parametrize(
    ("k", "border", "c", "n"),
    [(2, 1, 3, 5), (2, 1, 5, 3), (3, 1, 4, 4), (3, 2, 2, 7), (4, 2, 6, 1)],
)
def test_a_border_of_zeros_is_left_out_of_the_gradient(k, border, c, n, dtype):
    width = 2 * [(border, border)]
    same_function(
        lambda x, w: conv.conv_valid(conv.pad(x, border), w, border),
        lambda x, w: plain(x, w, padding=width),
        normal(3, 9, 7, c, dtype=dtype),
        normal(k, k, c, n, dtype=dtype),
        dtype,
    )
    x, w = conv.pad(normal(3, 9, 7, c, dtype=dtype), border), normal(k, k, c, n, dtype=dtype)
    dx = jax.grad(lambda x: jnp.sum(conv.conv_valid(x, w, border) ** 2))(x)
    np.testing.assert_array_equal(dx[0, :border], 0)
    np.testing.assert_array_equal(dx[0, :, -border:], 0)


@pytest.mark.parametrize("images", [23, 36])  # an image in a slice, and several
@pytest.mark.parametrize(("k", "border", "c", "n"), [(2, 0, 3, 5), (2, 1, 5, 3), (3, 1, 4, 4)])
def test_both_forms_of_a_kernels_gradient_agree(k, border, c, n, images, dtype):
    x = conv.pad(normal(images, 9, 8, c, dtype=dtype), border)
    dy = normal(images, x.shape[1] - k + 1, x.shape[2] - k + 1, n, dtype=dtype)
    assert dy[0, ..., 0].size * 2 < conv.SLICE < dy[..., 0].size
    close(conv._multiply_gradient(x, dy, k, border), conv._convolve_gradient(x, dy), dtype)


def test_down_is_a_convolution_of_stride_two(dtype):
    def ours(x, w):
        return conv.conv_valid(conv.to_blocks(conv.pad(x, 1)), conv.down_kernel(w))

    same_function(
        ours,
        lambda x, w: plain(x, w, 2, ((1, 1), (1, 1))),
        normal(2, 12, 8, 3, dtype=dtype),
        normal(4, 4, 3, 5, dtype=dtype),
        dtype,
    )


def transposed(x, w):
    return jax.lax.conv_transpose(x, w, (2, 2), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


def test_up_is_a_transposed_convolution_in_bordered_blocks(dtype):
    def ours(x, w):
        return conv.from_blocks(conv.conv_valid(conv.pad(x, 1), conv.up_kernel(w), 1))[
            :, 1:-1, 1:-1
        ]

    same_function(
        ours, transposed, normal(2, 6, 5, 3, dtype=dtype), normal(4, 4, 3, 4, dtype=dtype), dtype
    )


def test_blocks_there_and_back():
    x = normal(2, 8, 12, 3)
    blocks = conv.to_blocks(x)
    np.testing.assert_array_equal(conv.from_blocks(blocks), x)
    np.testing.assert_array_equal(blocks[1, 1, 2].reshape(2, 2, 3), x[1, 2:4, 4:6])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("side", [1, 2, 7, 20])
def test_values_and_gradients_are_those_of_a_convolution(side, stride, dtype):
    with jax.enable_x64(dtype is np.float64):
        given = (
            jax.random.normal(jax.random.key(0), (2, side, side + 1, 3), dtype),
            jax.random.normal(jax.random.key(1), (3, 3, 3, 5), dtype),
        )

        def found(way):
            def loss(x, w):
                y = way(x, w, (stride, stride), "SAME", dimension_numbers=ORDER)
                return jnp.sum(jnp.sin(y)), y

            return jax.jit(jax.value_and_grad(loss, (0, 1), has_aux=True))(*given)

        ours, theirs = found(convolve), found(lax.conv_general_dilated)
    near = partial(
        np.testing.assert_allclose, rtol=0, atol=(1e-4 if dtype is np.float32 else 1e-12)
    )
    assert all(leaf.dtype == dtype for leaf in jax.tree.leaves(ours))
    jax.tree.map(near, ours, theirs)


def test_a_trunk_over_pins_is_the_same_with_plain_layers():
    net = PinUnshear(hidden=8, layers=1, convolved=(4, 6))
    rest = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0)), -1).reshape(-1, 2) * 7
    variables = pin_networks.init(net, rest, 2.0, jax.random.key(0))
    pins = rest[None] + jax.random.normal(jax.random.key(1), (3, *rest.shape))

    def found(way):
        with layer_choice.use_layers(way):
            return np.asarray(jax.jit(partial(pin_networks.unshear, net))(variables, pins))

    fast, plain = found(layer_choice.FAST), found(layer_choice.PLAIN)
    np.testing.assert_allclose(fast, plain, atol=1e-4)
    assert np.abs(plain - rest[None]).max() > 1e-3
