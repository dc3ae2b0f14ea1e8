"""The first and the last layer's convolution, in both forms, against the plain ones they replace."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.models.fast import compiled_kernels, image_layers, norm

LAYOUT = ("NHWC", "HWIO", "NHWC")
compiled = pytest.mark.usefixtures("compiled")
SHAPES = [
    (3, 8, 16),
    pytest.param(1, 16, 32, marks=pytest.mark.long),
    pytest.param(2, 32, 48, marks=pytest.mark.long),
    (2, 72, 16),
    pytest.param(5, 4, 16, marks=pytest.mark.long),
]  # images, side, channels: tiles that fit and reach back


def normal(*shape, dtype=jnp.float32):
    return jnp.asarray(np.random.default_rng(sum(shape)).normal(size=shape), dtype)


def plain_first(x, w):
    return jax.lax.conv_general_dilated(x, w, (2, 2), 2 * [(1, 1)], dimension_numbers=LAYOUT)


def plain_last(x, w):
    return jax.lax.conv_transpose(x, w, (2, 2), "SAME", dimension_numbers=LAYOUT)


def as_first(compiled):
    def run(x, w):
        blocks = image_layers.apply_first(x, w, compiled)
        return norm.convert_layout(blocks, "blocks", "plain")

    return run


def as_last(compiled):
    return lambda x, w: image_layers.apply_last(
        norm.convert_layout(x, "plain", "blocks"), w, compiled
    )


def same_function(ours, reference, x, w, tolerance):
    """Values and both gradients, with and without jit."""
    shaped = jax.eval_shape(reference, x, w)
    dy = normal(*shaped.shape, dtype=shaped.dtype)

    def both(f):
        values, pull = jax.vjp(f, x, w)
        return values, *pull(dy)

    expected = jax.jit(lambda: both(reference))()
    for got in (both(ours), jax.jit(lambda: both(ours))()):
        for one, wanted in zip(got, expected, strict=True):
            assert one.dtype == wanted.dtype
            np.testing.assert_allclose(
                one, wanted, atol=tolerance * float(np.abs(wanted).max()), rtol=0
            )


@pytest.mark.parametrize("dtype", [jnp.float32, pytest.param(jnp.float64, marks=pytest.mark.long)])
def test_windows_are_the_plain_convolutions(dtype):
    with jax.enable_x64(dtype == jnp.float64):
        tolerance = 1e-5 if dtype == jnp.float32 else 1e-12
        x, w = normal(2, 12, 8, 2, dtype=dtype), normal(4, 4, 2, 3, dtype=dtype)
        same_function(as_first(False), plain_first, x, w, tolerance)
        x, w = normal(2, 6, 8, 3, dtype=dtype), normal(4, 4, 3, 1, dtype=dtype)
        same_function(as_last(False), plain_last, x, w, tolerance)


@compiled
@pytest.mark.parametrize(("images", "side", "channels"), SHAPES)
def test_compiled_forms_are_the_plain_convolutions(images, side, channels):
    first, last = normal(4, 4, 1, channels), normal(4, 4, channels, 1)
    assert (
        "jaxunshear_Gather"
        in jax.jit(as_first(True)).lower(normal(images, side, side, 1), first).as_text()
    )
    same_function(as_first(True), plain_first, normal(images, side, side, 1), first, 1e-5)
    x = normal(images, side // 2, side // 2, channels)
    assert "jaxunshear_Scatter" in jax.jit(as_last(True)).lower(x, last).as_text()
    same_function(as_last(True), plain_last, x, last, 1e-5)


@compiled
def test_what_lies_outside_is_zero_and_is_not_read():
    x, k = normal(2, 12, 12, 1), normal(16, 16)
    blocks = image_layers.gather(x, k)
    outside = np.repeat(norm.make_inside_mask(4, 4), 16, -1) == 0
    assert np.all(np.asarray(blocks)[:, outside] == 0)
    garbage = jnp.where(outside, 7.0, blocks)
    np.testing.assert_array_equal(image_layers.scatter(garbage, k), image_layers.scatter(blocks, k))
    np.testing.assert_array_equal(image_layers.outer(x, garbage), image_layers.outer(x, blocks))


@compiled
def test_each_is_a_slope_of_the_others():
    """Of both orders, and the form for other devices is the same."""
    x, k = normal(2, 16, 16, 1), normal(16, 16)
    y = norm.convert_layout(normal(2, 8, 8, 16), "plain", "blocks")
    pairs = [
        (image_layers.gather, image_layers._gather, x, k),
        (image_layers.scatter, image_layers._scatter, y, k),
        (image_layers.outer, image_layers._outer, x, y),
    ]
    for ours, reference, a, b in pairs:
        same_function(ours, reference, a, b, 1e-5)
        twice = [
            jax.jit(
                jax.grad(
                    lambda a, f=f, b=b: jnp.sum(
                        jnp.sin(jax.grad(lambda b: jnp.sum(f(a, b) ** 2))(b) / 50)
                    )
                )
            )(a)
            for f in (ours, reference)
        ]
        np.testing.assert_allclose(*twice, atol=1e-4 * float(jnp.abs(twice[1]).max()), rtol=0)


@compiled
def test_twice_gives_the_same_bits():
    x, w = normal(5, 32, 32, 1), normal(4, 4, 1, 32)
    run = jax.jit(jax.grad(lambda w: jnp.sum(jnp.sin(image_layers.apply_first(x, w, True)))))
    first = run(w)
    for _ in range(5):
        np.testing.assert_array_equal(run(w), first)


@compiled
@pytest.mark.parametrize("image", [(1, 8, 12, 1), (1, 8, 8, 3), (1, 10, 10, 1)])
def test_other_images_are_left_to_xla(image):
    assert not compiled_kernels.can_compute_image(
        jnp.zeros(image), jnp.zeros((4, 4, image[-1], 16))
    )
    assert not compiled_kernels.can_compute_image(jnp.zeros((1, 8, 8, 1)), jnp.zeros((4, 4, 1, 12)))
    assert not compiled_kernels.can_compute_image(
        jnp.zeros((1, 8, 8, 1), jnp.bfloat16), jnp.zeros((4, 4, 1, 16), jnp.bfloat16)
    )
    assert compiled_kernels.can_compute_image(jnp.zeros((1, 8, 8, 1)), jnp.zeros((4, 4, 1, 16)))
    with compiled_kernels.use_form("xla"):
        assert not compiled_kernels.can_compute_image(
            jnp.zeros((1, 8, 8, 1)), jnp.zeros((4, 4, 1, 16))
        )


def test_blocks_of_windows_keep_their_place():
    x = normal(1, 8, 8, 1)
    seen = image_layers.extract_windows(x)
    assert seen.shape == (1, 3, 3, 36)
    np.testing.assert_array_equal(seen[0, 1, 1].reshape(6, 6), x[0, 1:7, 1:7, 0])
    np.testing.assert_array_equal(
        image_layers.from_windows(jnp.ones((1, 3, 3, 36)))[0, :4, 0, 0], [1, 2, 2, 1]
    )
