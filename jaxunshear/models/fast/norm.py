"""Batch normalisation and ReLU in one, from one layout of an image to another.

>>> # x (B, H, W, C) -> y (B, H/2+1, W/2+1, 4 C)
>>> y, mean, variance = norm_relu(x, scale, bias, "plain", "blocks")

*plain* is (B, H, W, C); *padded* has a pixel of zeros on all four sides; *blocks* are the padded
image's bordered blocks (conv.py). The normalisation has its own gradient, and computes the variance
as the mean squared deviation (never negative), in float32 or wider. Its four passes over pixels,
`moments`, `affine_relu`, `slopes` and `gradient`, are compiled for the processor if
`compiled_kernels.py` can do so, which saves the passes that only rearrange; else they are XLA's.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxunshear.models.fast import compiled_kernels, conv
from jaxunshear.models.layers import EPSILON

GROUP = 8  # images summed at once


class Normalised(NamedTuple):
    """What batch normalisation returns: the output, and mean and variance (C,) of the batch."""

    y: Array
    mean: Array
    variance: Array


class Saved(NamedTuple):
    """What the gradient needs: the inputs, and mean and variance (C,) of the batch."""

    x: Array
    scale: Array
    bias: Array
    mean: Array
    variance: Array


def convert_layout(x: Array, source: str, target: str) -> Array:
    """Convert an image to another layout."""
    if source == target:
        return x
    padded = x
    if source == "plain":
        padded = conv.pad(x, 1)
    elif source == "blocks":
        padded = conv.from_blocks(x)
    if target == "plain":
        return padded[:, 1:-1, 1:-1]
    return conv.to_blocks(padded) if target == "blocks" else padded


def make_inside_mask(height: int, width: int) -> np.ndarray:
    """Mark the pixels of each 2x2 bordered block inside the image by 1, (height, width, 4)."""
    rows, columns = np.ones((height, 2)), np.ones((width, 2))
    for lines in (rows, columns):
        lines[0, 0] = lines[-1, 1] = 0
    return (rows[:, None, :, None] * columns[None, :, None, :]).reshape(height, width, 4)


@partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def norm_relu(x: Array, scale: Array, bias: Array, source: str, target: str) -> Normalised:
    """Compute ReLU(batch norm(x)) in layout `target`, with the batch's mean and variance.

    x is in layout `source`, "plain" or "blocks". Only pixels inside count; what lies outside is
    zero in the output. The gradient runs through `y`; mean and variance are for the running
    statistics.
    """
    return _forward(x, scale, bias, source, target)[0]


def _forward(
    x: Array, scale: Array, bias: Array, source: str, target: str
) -> tuple[Normalised, Saved]:
    mean, variance = _moments(x, source=source)
    factor, shift = _compute_line(scale, bias, mean, variance)
    y = _affine_relu(x, factor, shift, source=source, target=target)
    return Normalised(y, mean, variance), Saved(x, scale, bias, mean, variance)


def _backward(source: str, target: str, saved: Saved, cotangents: Normalised) -> tuple[Array, ...]:
    x, scale, bias, mean, variance = saved
    dy, count = cotangents.y, _count_pixels(x, source)
    inverse = lax.rsqrt(variance + EPSILON)
    factor, shift = _compute_line(scale, bias, mean, variance)
    d_bias, d_scale = _slopes(x, dy, factor, shift, mean, source=source, target=target)
    d_scale = d_scale * inverse
    constant, tilt = factor * d_bias / count, factor * inverse * d_scale / count
    dx = _gradient(x, dy, factor, shift, mean, constant, tilt, source=source, target=target)
    return dx, d_scale, d_bias


norm_relu.defvjp(_forward, _backward)


def affine_relu(
    x: Array, scale: Array, bias: Array, mean: Array, variance: Array, source: str, target: str
) -> Array:
    """Compute ReLU(batch norm(x)) with these statistics (C,), zero outside, in layout `target`."""
    factor, shift = _compute_line(scale, bias, mean, variance)
    return _affine_relu_by_xla(x, factor, shift, source=source, target=target)


def _compute_line(scale: Array, bias: Array, mean: Array, variance: Array) -> tuple[Array, Array]:
    """Compute factor and shift, with batch norm(x) = factor x + shift."""
    factor = scale * lax.rsqrt(variance + EPSILON)
    return factor, bias - mean * factor


# Below, large arrays are (images, pixels, channels). Each pass is near the speed of a copy in XLA's
# CPU backend for these reasons: sums go over the images first, a long contiguous loop; what lies
# outside is zeroed by a mask as large as one image; vectors are widened to blocks by a matrix
# product, whose result stays in memory, while a tiled one would be an index calculation for every
# number. ReLU's mask is computed again from x instead of being kept.


def _moments_by_xla(x: Array, *, source: str) -> tuple[Array, Array]:
    """Compute mean and mean squared deviation of the pixels inside, (C,) each."""
    images, count = _flatten_pixels(x), _count_pixels(x, source)
    mean = _sum_pixels(jnp.sum(images, 0), x, source) / count
    squares = (images - _widen(mean, source)) ** 2
    return mean, _sum_pixels(jnp.sum(squares, 0), x, source) / count


def _affine_relu_by_xla(
    x: Array, factor: Array, shift: Array, *, source: str, target: str
) -> Array:
    """Compute max(factor x + shift, 0), zero outside the image."""
    y = jax.nn.relu(_flatten_pixels(x) * _widen(factor, source) + _widen(shift, source))
    y = _zero_outside(y, x, source).reshape(x.shape).astype(x.dtype)
    return convert_layout(y, source, target)


def _mask_gradient(
    x: Array, dy: Array, factor: Array, shift: Array, source: str, target: str
) -> Array:
    """Compute the gradient dy that ReLU lets through, (B, pixels, channels)."""
    is_active = _flatten_pixels(x) * _widen(factor, source) + _widen(shift, source) > 0
    return jnp.where(is_active, _flatten_pixels(convert_layout(dy, target, source)), 0)


def _slopes_by_xla(
    x: Array, dy: Array, factor: Array, shift: Array, mean: Array, *, source: str, target: str
) -> tuple[Array, Array]:
    """Sum the gradient that passes, and its product with x - mean, (C,) each."""
    passed = _mask_gradient(x, dy, factor, shift, source, target)
    product = passed * (_flatten_pixels(x) - _widen(mean, source))
    image_sum, product_sum = _sum_both_over_images(passed, product)
    return _sum_pixels(image_sum, x, source), _sum_pixels(product_sum, x, source)


def _gradient_by_xla(x: Array, dy: Array, *vectors: Array, source: str, target: str) -> Array:
    """Compute factor * (the gradient that passes) - constant - (x - mean) * tilt.

    The vectors (C,) are factor, shift, mean, constant and tilt.
    """
    factor, shift, mean, constant, tilt = vectors
    widen = partial(_widen, source=source)
    line = widen(constant) + (_flatten_pixels(x) - widen(mean)) * widen(tilt)
    passed = _mask_gradient(x, dy, factor, shift, source, target)
    dx = _zero_outside(passed * widen(factor) - line, x, source)
    return dx.reshape(x.shape).astype(x.dtype)


Result = TypeVar("Result")


def _make_pass(
    by_xla: Callable[..., Result], run_compiled: Callable[..., Result]
) -> Callable[..., Result]:
    """Make a pass that runs compiled code if it can, else `by_xla`, whose derivatives it has."""

    def run(x: Array, *more: Array, **layouts: str) -> Result:
        plain = partial(by_xla, **layouts)
        if not compiled_kernels.can_normalise(x, *more, source=layouts["source"]):
            return plain(x, *more)
        on_cpu = partial(run_compiled, **layouts)
        either = jax.custom_vjp(
            lambda *arrays: lax.platform_dependent(*arrays, cpu=on_cpu, default=plain)
        )
        either.defvjp(
            lambda *arrays: (either(*arrays), arrays),
            lambda arrays, cotangent: jax.vjp(plain, *arrays)[1](cotangent),
        )
        return either(x, *more)

    return run


_moments = _make_pass(_moments_by_xla, compiled_kernels.moments)
_affine_relu = _make_pass(_affine_relu_by_xla, compiled_kernels.affine_relu)
_slopes = _make_pass(_slopes_by_xla, compiled_kernels.slopes)
_gradient = _make_pass(_gradient_by_xla, compiled_kernels.gradient)


def _flatten_pixels(x: Array) -> Array:
    b, h, w, c = x.shape
    return x.reshape(b, h * w, c).astype(np.promote_types(x.dtype, np.float32))


def _count_pixels(x: Array, source: str) -> int:
    """Count the pixels of all images, without those outside."""
    b, h, w, _ = x.shape
    return b * 4 * (h - 1) * (w - 1) if source == "blocks" else b * h * w


def _zero_outside(numbers: Array, x: Array, source: str) -> Array:
    """Zero numbers (..., H W, 4 C) of bordered blocks x (B, H, W, 4 C) outside the image.

    Numbers in other layouts are returned unchanged.
    """
    if source != "blocks":
        return numbers
    _, h, w, c = x.shape
    mask = np.repeat(make_inside_mask(h, w).reshape(-1, 4), c // 4, axis=1)
    return numbers * jnp.asarray(mask[None] if numbers.ndim == 3 else mask, numbers.dtype)


def _widen(channels: Array, source: str) -> Array:
    """Widen numbers (C,) to (1, 1, C), or to (1, 1, 4 C) for blocks."""
    if source == "blocks":
        four_times = jnp.asarray(np.tile(np.eye(len(channels)), 4), channels.dtype)
        channels = _multiply_exactly(channels, four_times)
    return channels[None, None]


def _sum_both_over_images(a: Array, b: Array) -> tuple[Array, Array]:
    """Sum both arrays over their first axis in one pass.

    Two sums would write ReLU's masked gradient out and read it twice. Images are summed in groups
    of at most GROUP: longer strides through memory are slow.
    """
    group = max(size for size in range(1, GROUP + 1) if len(a) % size == 0)
    a = a.reshape(-1, group, *a.shape[1:])
    b = b.reshape(-1, group, *b.shape[1:])
    zero = jnp.zeros((), a.dtype)
    sums = lax.reduce((a, b), (zero, zero), lambda x, y: (x[0] + y[0], x[1] + y[1]), (1,))
    return sums[0].sum(0), sums[1].sum(0)


def _sum_pixels(numbers: Array, x: Array, source: str) -> Array:
    """Sum numbers (pixels, channels), in the layout of an image of x, over pixels inside: (C,)."""
    numbers = _zero_outside(numbers, x, source)
    # two rows of ones: XLA would fuse a product with a vector with all before it, in one slow loop
    columns = _multiply_exactly(jnp.ones((2, len(numbers)), numbers.dtype), numbers)[0]
    return columns.reshape(4, -1).sum(0) if source == "blocks" else columns


def _multiply_exactly(a: Array, b: Array) -> Array:
    """Multiply matrices in full precision, also on GPUs, which round products by default."""
    return jnp.matmul(a, b, precision="highest")
