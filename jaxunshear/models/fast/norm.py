"""Batch normalisation and ReLU in one, from one layout of an image to another.

>>> y, mean, variance = norm_relu(x, scale, bias, "plain", "blocks")    # (B, H, W, C) -> (B, H/2+1, W/2+1, 4 C)

*plain* is (B, H, W, C); *padded* has a pixel of zeros on all four sides; *blocks* are the padded image's bordered blocks (conv.py).
It is written out, with its own gradient: the variance as the mean squared deviation (never negative), in float32 or wider. Its four
passes over pixels, `moments`, `affine_relu`, `slopes` and `gradient`, are compiled for the processor where `native.py` can,
which spares the passes that only rearrange; elsewhere they are XLA's.
"""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxunshear.models.fast import compiled_kernels, conv
from jaxunshear.models.layers import EPSILON

GROUP = 8  # images summed at once
_Saved = tuple[Array, Array, Array, Array, Array]


def convert_layout(x: Array, source: str, target: str) -> Array:
    """An image in another layout."""
    if source == target:
        return x
    padded = (
        conv.pad(x, 1) if source == "plain" else conv.from_blocks(x) if source == "blocks" else x
    )
    if target == "plain":
        return padded[:, 1:-1, 1:-1]
    return conv.to_blocks(padded) if target == "blocks" else padded


def make_inside_mask(height: int, width: int) -> np.ndarray:
    """(height, width, 4) 0/1: which of the 2x2 pixels of each bordered block lie inside the image."""
    rows, columns = (np.ones((n, 2)) for n in (height, width))
    for lines in (rows, columns):
        lines[0, 0] = lines[-1, 1] = 0
    return (rows[:, None, :, None] * columns[None, :, None, :]).reshape(height, width, 4)


@partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def norm_relu(
    x: Array, scale: Array, bias: Array, source: str, target: str
) -> tuple[Array, Array, Array]:
    """ReLU(batch norm(x)) in layout `target`, and the batch's mean and variance (C,) that it used.

    x is in layout `source`, "plain" or "blocks": only pixels inside count, what lies outside comes out as zero. The gradient runs
    through the first output; mean and variance are for the running statistics.
    """
    return _forward(x, scale, bias, source, target)[0]


def _forward(
    x: Array, scale: Array, bias: Array, source: str, target: str
) -> tuple[tuple[Array, Array, Array], _Saved]:
    mean, variance = _moments(x, source=source)
    factor, shift = _line(scale, bias, mean, variance)
    y = _affine_relu(x, factor, shift, source=source, target=target)
    return (y, mean, variance), (x, scale, bias, mean, variance)


def _backward(
    source: str, target: str, saved: _Saved, cotangents: tuple[Array, Array, Array]
) -> tuple[Array, Array, Array]:
    x, scale, bias, mean, variance = saved
    dy, count = cotangents[0], _count(x, source)
    inverse = lax.rsqrt(variance + EPSILON)
    factor, shift = _line(scale, bias, mean, variance)
    d_bias, d_scale = _slopes(x, dy, factor, shift, mean, source=source, target=target)
    d_scale = d_scale * inverse
    constant, tilt = factor * d_bias / count, factor * inverse * d_scale / count
    dx = _gradient(x, dy, factor, shift, mean, constant, tilt, source=source, target=target)
    return dx, d_scale, d_bias


norm_relu.defvjp(_forward, _backward)


def affine_relu(
    x: Array, scale: Array, bias: Array, mean: Array, variance: Array, source: str, target: str
) -> Array:
    """ReLU(batch norm) with given statistics (C,), zero outside the image, in layout `target`."""
    return _affine_relu_by_xla(x, *_line(scale, bias, mean, variance), source=source, target=target)


def _line(scale: Array, bias: Array, mean: Array, variance: Array) -> tuple[Array, Array]:
    """Batch norm(x) = factor x + shift."""
    factor = scale * lax.rsqrt(variance + EPSILON)
    return factor, bias - mean * factor


# Below, large arrays are (images, pixels, channels). What keeps each pass near the speed of a copy in XLA's CPU backend: sums go
# over the images first, a long contiguous loop; what lies outside is zeroed by a mask as large as one image; vectors are
# widened to blocks by a matrix product, whose result stands in memory where a tiled one would be an index calculation for every number.
# ReLU's mask is computed again from x instead of being kept.


def _moments_by_xla(x: Array, *, source: str) -> tuple[Array, Array]:
    """Mean and mean squared deviation of the pixels inside, (C,) each."""
    images, count = _images(x), _count(x, source)
    mean = _sums(images, x, source) / count
    return mean, _sums((images - _wide(mean, source)) ** 2, x, source) / count


def _affine_relu_by_xla(
    x: Array, factor: Array, shift: Array, *, source: str, target: str
) -> Array:
    """max(factor x + shift, 0)."""
    y = jax.nn.relu(_images(x) * _wide(factor, source) + _wide(shift, source))
    return convert_layout(_inside(y, x, source).reshape(x.shape).astype(x.dtype), source, target)


def _mask_gradient(
    x: Array, dy: Array, factor: Array, shift: Array, source: str, target: str
) -> Array:
    """The gradient dy that ReLU lets through, as `_images`."""
    active = _images(x) * _wide(factor, source) + _wide(shift, source) > 0
    return jnp.where(active, _images(convert_layout(dy, target, source)), 0)


def _slopes_by_xla(
    x: Array, dy: Array, factor: Array, shift: Array, mean: Array, *, source: str, target: str
) -> tuple[Array, Array]:
    """Sums of the gradient that passes, and of its product with x - mean, (C,) each."""
    passed = _mask_gradient(x, dy, factor, shift, source, target)
    both = _both_over_images(passed, passed * (_images(x) - _wide(mean, source)))
    d_bias, d_scale = (_over_pixels(numbers, x, source) for numbers in both)
    return d_bias, d_scale


def _gradient_by_xla(
    x: Array,
    dy: Array,
    factor: Array,
    shift: Array,
    mean: Array,
    constant: Array,
    tilt: Array,
    *,
    source: str,
    target: str,
) -> Array:
    """factor * (the gradient that passes) - constant - (x - mean) * tilt, in layout `source`."""
    wide = partial(_wide, source=source)
    line = wide(constant) + (_images(x) - wide(mean)) * wide(tilt)
    dx = _inside(
        _mask_gradient(x, dy, factor, shift, source, target) * wide(factor) - line, x, source
    )
    return dx.reshape(x.shape).astype(x.dtype)


Answer = TypeVar("Answer")


def _choose_compiled(
    by_xla: Callable[..., Answer], run: Callable[..., Answer]
) -> Callable[..., Answer]:
    """`run` where `native.py` can, `by_xla` elsewhere; the derivatives are those of `by_xla` in any case."""

    def choose(x: Array, *more: Array, **layouts: str) -> Answer:
        here = partial(by_xla, **layouts)
        if not compiled_kernels.can_normalise(x, *more, source=layouts["source"]):
            return here(x, *more)
        both = jax.custom_vjp(
            lambda *given: lax.platform_dependent(*given, cpu=partial(run, **layouts), default=here)
        )
        both.defvjp(
            lambda *given: (both(*given), given),
            lambda given, change: jax.vjp(here, *given)[1](change),
        )
        return both(x, *more)

    return choose


_moments = _choose_compiled(_moments_by_xla, compiled_kernels.moments)
_affine_relu = _choose_compiled(_affine_relu_by_xla, compiled_kernels.affine_relu)
_slopes = _choose_compiled(_slopes_by_xla, compiled_kernels.slopes)
_gradient = _choose_compiled(_gradient_by_xla, compiled_kernels.gradient)


def _images(x: Array) -> Array:
    b, h, w, c = x.shape
    return x.reshape(b, h * w, c).astype(np.promote_types(x.dtype, np.float32))


def _count(x: Array, source: str) -> int:
    """Pixels of all images, without those outside."""
    b, h, w, _ = x.shape
    return b * 4 * (h - 1) * (w - 1) if source == "blocks" else b * h * w


def _inside(numbers: Array, x: Array, source: str) -> Array:
    """Numbers (..., H W, 4 C) of bordered blocks x (B, H, W, 4 C) with zeros outside the image; others as they are."""
    if source != "blocks":
        return numbers
    _, h, w, c = x.shape
    mask = np.repeat(make_inside_mask(h, w).reshape(-1, 4), c // 4, axis=1)
    return numbers * jnp.asarray(mask[None] if numbers.ndim == 3 else mask, numbers.dtype)


def _wide(channels: Array, source: str) -> Array:
    """(1, 1, C), or (1, 1, 4 C) for blocks."""
    return (_exact(channels, _four_times(channels)) if source == "blocks" else channels)[None, None]


def _sums(images: Array, x: Array, source: str) -> Array:
    """Sums over images and pixels inside, (C,): of `images` (B, H W, C) or (B, H W, 4 C), which has the layout of x."""
    return _over_pixels(jnp.sum(images, 0), x, source)


def _both_over_images(a: Array, b: Array) -> tuple[Array, Array]:
    """Sums over the first axis of both, in one pass: two sums would write ReLU's masked gradient out and read it twice. In groups of
    at most GROUP images: longer strides through memory are slow."""
    group = max(size for size in range(1, GROUP + 1) if len(a) % size == 0)
    a, b = (numbers.reshape(-1, group, *numbers.shape[1:]) for numbers in (a, b))
    zero = jnp.zeros((), a.dtype)
    sums = lax.reduce((a, b), (zero, zero), lambda x, y: (x[0] + y[0], x[1] + y[1]), (1,))
    return sums[0].sum(0), sums[1].sum(0)


def _over_pixels(numbers: Array, x: Array, source: str) -> Array:
    """Sums over pixels inside, (C,): of (H W, C) or (H W, 4 C), which has the layout of an image of x."""
    numbers = _inside(numbers, x, source)
    # two rows of ones: a product with a vector would be fused with all that comes before, into one slow loop
    columns = _exact(jnp.ones((2, len(numbers)), numbers.dtype), numbers)[0]
    return columns.reshape(4, -1).sum(0) if source == "blocks" else columns


def _four_times(channels: Array) -> Array:
    return jnp.asarray(np.tile(np.eye(len(channels)), 4), channels.dtype)


def _exact(a: Array, b: Array) -> Array:
    """Matrix product in full precision, also where products are rounded by default (GPU)."""
    return jnp.matmul(a, b, precision="highest")
