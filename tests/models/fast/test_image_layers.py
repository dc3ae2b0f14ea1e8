"""The first and the last layer's convolution, in both forms, against the plain ones they replace."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.models.fast import compiled_kernels, image_layers, norm
from tests.helpers.convolutions import (
    check_close,
    check_same_function,
    convolve,
    draw_normal,
    transpose,
)

compiled = pytest.mark.usefixtures("compiled")
SHAPES = [
    *((3, 8, 16), (2, 72, 16)),
    *(
        pytest.param(*shape, marks=pytest.mark.long)
        for shape in ((1, 16, 32), (2, 32, 48), (5, 4, 16))
    ),
]  # images, side, channels: tiles that fit and reach back


def plain_first(x, w):
    return convolve(x, w, 2, 2 * [(1, 1)])


def as_first(compiled):
    def run(x, w):
        blocks = image_layers.apply_first(x, w, compiled)
        return norm.convert_layout(blocks, "blocks", "plain")

    return run


def as_last(compiled):
    def run(x, w):
        return image_layers.apply_last(norm.convert_layout(x, "plain", "blocks"), w, compiled)

    return run


@pytest.mark.parametrize("dtype", [jnp.float32, pytest.param(jnp.float64, marks=pytest.mark.long)])
def test_windows_are_the_plain_convolutions(dtype):
    with jax.enable_x64(dtype == jnp.float64):
        tolerance = 1e-5 if dtype == jnp.float32 else 1e-12
        x, w = (draw_normal(*shape, dtype=dtype) for shape in ((2, 12, 8, 2), (4, 4, 2, 3)))
        check_same_function(as_first(False), plain_first, x, w, tolerance)
        x, w = (draw_normal(*shape, dtype=dtype) for shape in ((2, 6, 8, 3), (4, 4, 3, 1)))
        check_same_function(as_last(False), transpose, x, w, tolerance)


@compiled
@pytest.mark.parametrize(("images", "side", "channels"), SHAPES)
def test_compiled_forms_are_the_plain_convolutions(images, side, channels):
    x, w = draw_normal(images, side, side, 1), draw_normal(4, 4, 1, channels)
    assert "jaxunshear_Gather" in jax.jit(as_first(True)).lower(x, w).as_text()
    check_same_function(as_first(True), plain_first, x, w, 1e-5)
    x, w = draw_normal(images, side // 2, side // 2, channels), draw_normal(4, 4, channels, 1)
    assert "jaxunshear_Scatter" in jax.jit(as_last(True)).lower(x, w).as_text()
    check_same_function(as_last(True), transpose, x, w, 1e-5)


@compiled
def test_what_lies_outside_is_zero_and_is_not_read():
    x, k = draw_normal(2, 12, 12, 1), draw_normal(16, 16)
    blocks = image_layers.gather(x, k)
    outside = np.repeat(norm.make_inside_mask(4, 4), 16, -1) == 0
    assert np.all(np.asarray(blocks)[:, outside] == 0)
    garbage = jnp.where(outside, 7.0, blocks)
    np.testing.assert_array_equal(image_layers.scatter(garbage, k), image_layers.scatter(blocks, k))
    np.testing.assert_array_equal(image_layers.outer(x, garbage), image_layers.outer(x, blocks))


@compiled
def test_each_is_a_slope_of_the_others():
    """Of both orders, and the form for other devices is the same."""
    x, k = draw_normal(2, 16, 16, 1), draw_normal(16, 16)
    y = norm.convert_layout(draw_normal(2, 8, 8, 16), "plain", "blocks")

    def compute_second(f, a, b):
        inner = jax.grad(lambda b, a: jnp.sum(f(a, b) ** 2))
        return jax.jit(jax.grad(lambda a: jnp.sum(jnp.sin(inner(b, a) / 50))))(a)

    for ours, reference, a, b in (
        (image_layers.gather, image_layers._gather, x, k),
        (image_layers.scatter, image_layers._scatter, y, k),
        (image_layers.outer, image_layers._outer, x, y),
    ):
        check_same_function(ours, reference, a, b, 1e-5)
        check_close(compute_second(ours, a, b), compute_second(reference, a, b), 1e-4)


@compiled
def test_twice_gives_the_same_bits():
    x, w = draw_normal(5, 32, 32, 1), draw_normal(4, 4, 1, 32)
    run = jax.jit(jax.grad(lambda w: jnp.sum(jnp.sin(image_layers.apply_first(x, w, True)))))
    first = run(w)
    for _ in range(5):
        np.testing.assert_array_equal(run(w), first)


@compiled
@pytest.mark.parametrize(
    ("image", "channels", "dtype"),
    [
        ((1, 8, 12, 1), 16, jnp.float32),
        ((1, 8, 8, 3), 16, jnp.float32),
        ((1, 10, 10, 1), 16, jnp.float32),
        ((1, 8, 8, 1), 12, jnp.float32),
        ((1, 8, 8, 1), 16, jnp.bfloat16),
    ],
)
def test_other_images_are_left_to_xla(image, channels, dtype):
    kernel = jnp.zeros((4, 4, image[-1], channels), dtype)
    assert not compiled_kernels.can_compute_image(jnp.zeros(image, dtype), kernel)
    image, kernel = jnp.zeros((1, 8, 8, 1)), jnp.zeros((4, 4, 1, 16))
    assert compiled_kernels.can_compute_image(image, kernel)
    with compiled_kernels.use_form("xla"):
        assert not compiled_kernels.can_compute_image(image, kernel)


def test_blocks_of_windows_keep_their_place():
    x = draw_normal(1, 8, 8, 1)
    seen = image_layers.extract_windows(x)
    assert seen.shape == (1, 3, 3, 36)
    np.testing.assert_array_equal(seen[0, 1, 1].reshape(6, 6), x[0, 1:7, 1:7, 0])
    summed = image_layers.from_windows(jnp.ones((1, 3, 3, 36)))
    np.testing.assert_array_equal(summed[0, :4, 0, 0], [1, 2, 2, 1])
