"""conv_valid, the blocked forms and products of patches against the convolutions they replace."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from jaxunshear.models.fast import conv
from tests.helpers.convolutions import (
    LAYOUT,
    check_close,
    check_same_function,
    convolve,
    draw_normal,
    transpose,
)

TOLERANCE = {jnp.float32: 1e-5, jnp.float64: 1e-12}


@pytest.fixture(
    params=[jnp.float32, pytest.param(jnp.float64, marks=pytest.mark.long)], ids=["f32", "f64"]
)
def dtype(request):
    with jax.enable_x64(request.param == jnp.float64):
        yield request.param


def check(ours, reference, x_shape, w_shape, dtype):
    x, w = draw_normal(*x_shape, dtype=dtype), draw_normal(*w_shape, dtype=dtype)
    check_same_function(ours, reference, x, w, TOLERANCE[dtype])


@pytest.mark.parametrize(
    ("k", "border", "c", "n"),
    [
        *((1, 0, 3, 5), (2, 0, 3, 5), (2, 0, 5, 3), (3, 0, 4, 4), (3, 0, 2, 7), (4, 0, 6, 1)),
        *((2, 1, 3, 5), (2, 1, 5, 3), (3, 1, 4, 4), (3, 2, 2, 7), (4, 2, 6, 1)),
    ],
)
def test_conv_valid_is_the_plain_convolution_and_leaves_out_a_border(k, border, c, n, dtype):
    check(
        lambda x, w: conv.conv_valid(conv.pad(x, border), w, border),
        lambda x, w: convolve(x, w, padding=2 * [(border, border)]),
        (3, 9, 7, c),
        (k, k, c, n),
        dtype,
    )
    x, w = (
        conv.pad(draw_normal(3, 9, 7, c, dtype=dtype), border),
        draw_normal(k, k, c, n, dtype=dtype),
    )
    dx = jax.grad(lambda x: jnp.sum(conv.conv_valid(x, w, border) ** 2))(x)
    assert not np.any(dx[0, :border]) and not np.any(dx[0, :, 7 + border :])


@pytest.mark.parametrize("images", [23, 36])  # an image in a slice, and several
@pytest.mark.parametrize(("k", "border", "c", "n"), [(2, 0, 3, 5), (2, 1, 5, 3), (3, 1, 4, 4)])
def test_both_forms_of_a_kernels_gradient_agree(k, border, c, n, images, dtype):
    x = conv.pad(draw_normal(images, 9, 8, c, dtype=dtype), border)
    dy = draw_normal(images, x.shape[1] - k + 1, x.shape[2] - k + 1, n, dtype=dtype)
    assert dy[0, ..., 0].size * 2 < conv.SLICE < dy[..., 0].size
    ours, expected = conv._multiply_gradient(x, dy, k, border), conv._convolve_gradient(x, dy)
    check_close(ours, expected, TOLERANCE[dtype])


def test_down_is_a_convolution_of_stride_two(dtype):
    def ours(x, w):
        return conv.conv_valid(conv.to_blocks(conv.pad(x, 1)), conv.down_kernel(w))

    def plain(x, w):
        return convolve(x, w, 2, ((1, 1), (1, 1)))

    check(ours, plain, (2, 12, 8, 3), (4, 4, 3, 5), dtype)


def test_up_is_a_transposed_convolution_in_bordered_blocks(dtype):
    def ours(x, w):
        blocks = conv.conv_valid(conv.pad(x, 1), conv.up_kernel(w), 1)
        return conv.from_blocks(blocks)[:, 1:-1, 1:-1]

    def flax(x, w):
        layer = nn.ConvTranspose(4, (4, 4), (2, 2), padding="SAME", use_bias=False)
        return layer.apply({"params": {"kernel": w}}, x)

    for reference in (transpose, flax):
        check(ours, reference, (2, 6, 5, 3), (4, 4, 3, 4), dtype)


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("side", [1, 2, 7, 20])
def test_one_product_of_patches_is_the_plain_convolution(side, stride, dtype):
    def ours(x, w):
        return conv.convolve(x, w, 2 * (stride,), "SAME", dimension_numbers=LAYOUT)

    def plain(x, w):
        return convolve(x, w, stride, "SAME")

    check(ours, plain, (2, side, side + 1, 3), (3, 3, 3, 5), dtype)


def test_blocks_there_and_back():
    x = draw_normal(2, 8, 12, 3)
    blocks = conv.to_blocks(x)
    np.testing.assert_array_equal(conv.from_blocks(blocks), x)
    np.testing.assert_array_equal(blocks[1, 1, 2].reshape(2, 2, 3), x[1, 2:4, 4:6])


def test_wrong_channels_are_refused():
    with pytest.raises((TypeError, ValueError)):
        conv.conv_valid(draw_normal(1, 4, 4, 3), draw_normal(2, 2, 5, 1))
