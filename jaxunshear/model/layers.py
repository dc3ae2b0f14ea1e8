"""The layers of both networks: convolution + batch normalisation + ReLU, over plain or blocked arrays (see conv.py).

Batch normalisation is written out, with its own gradient: the variance as the mean squared deviation (never negative), in
float32 or wider, and scale, shift, ReLU and mask in one pass.

The precision is that of the images given: kernels are rounded to it, so bfloat16 images give bfloat16 products, logits and
gradients of kernels, which are kept in float32 from there on, as are parameters and statistics.
"""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.model import conv

INIT = nn.initializers.normal(0.02)  # paper, appendix B
EPSILON = 1e-5
MOMENTUM = 0.9  # of the running statistics
GROUP = 8  # images summed at once


def in_precision(images: Array, precision: str) -> Array:
    """Images as a network of this precision ("float32", "bfloat16") is to be given them; wider ones stay as they are in float32."""
    return images.astype(jnp.bfloat16) if precision == "bfloat16" else images


def inside(height: int, width: int) -> np.ndarray:
    """(height, width, 4) 0/1: which of the 2x2 pixels of each bordered block lie inside the image."""
    rows, columns = (np.ones((n, 2)) for n in (height, width))
    for lines in (rows, columns):
        lines[0, 0] = lines[-1, 1] = 0
    return (rows[:, None, :, None] * columns[None, :, None, :]).reshape(height, width, 4)


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def norm_relu(x: Array, scale: Array, bias: Array, bordered: bool) -> tuple[Array, Array, Array]:
    """ReLU(batch norm(x)) and the batch's mean and variance (C,) that it used.

    x (B, H, W, C), or bordered blocks (B, H, W, 4 C): only pixels inside count, the others come out as zero. The gradient
    runs through the first output; mean and variance are for the running statistics.
    """
    return _norm_relu(x, scale, bias, bordered)[0]


# Below, large arrays are (images, pixels, channels). What keeps each pass near the speed of a copy in XLA's CPU backend: sums go
# over the images first, a long contiguous loop; what lies outside is zeroed by a mask as large as one image; vectors are
# widened to blocks by a matrix product, whose result stands in memory where a tiled one would be an index calculation for every number.
# ReLU's mask is computed again from x instead of being kept.


def _norm_relu(x, scale, bias, bordered):
    images, count = _images(x), _count(x, bordered)
    mean = _sums(images, x, bordered) / count
    variance = _sums((images - _wide(mean, bordered)) ** 2, x, bordered) / count
    y = affine_relu(x, scale, bias, mean, variance, bordered)
    return (y, mean, variance), (x, scale, bias, mean, variance)


def _norm_relu_backward(bordered, saved, cotangents):
    x, scale, bias, mean, variance = saved
    images, count = _images(x), _count(x, bordered)
    inverse = jax.lax.rsqrt(variance + EPSILON)
    factor = scale * inverse
    wide_factor, centred = _wide(factor, bordered), images - _wide(mean, bordered)
    active = images * wide_factor + _wide(bias - mean * factor, bordered) > 0
    dy = jnp.where(active, _images(cotangents[0]), 0)
    over_images = _both_over_images(dy, dy * centred)
    d_bias, d_scale = (_over_pixels(numbers, x, bordered) for numbers in over_images)
    d_scale = d_scale * inverse
    constant = _wide(factor * d_bias / count, bordered)
    slope = _wide(factor * inverse * d_scale / count, bordered)
    dx = _inside(dy * wide_factor - (constant + centred * slope), x, bordered)
    return dx.reshape(x.shape).astype(x.dtype), d_scale, d_bias


norm_relu.defvjp(_norm_relu, _norm_relu_backward)


def affine_relu(x: Array, scale: Array, bias: Array, mean: Array, variance: Array, bordered: bool) -> Array:
    """ReLU(batch norm) with given statistics (C,), zero outside the image."""
    factor = scale * jax.lax.rsqrt(variance + EPSILON)
    y = jax.nn.relu(_images(x) * _wide(factor, bordered) + _wide(bias - mean * factor, bordered))
    return _inside(y, x, bordered).reshape(x.shape).astype(x.dtype)


def _images(x: Array) -> Array:
    b, h, w, c = x.shape
    return x.reshape(b, h * w, c).astype(jnp.promote_types(x.dtype, jnp.float32))


def _count(x: Array, bordered: bool) -> int:
    """Pixels of all images, without those outside."""
    b, h, w, _ = x.shape
    return b * 4 * (h - 1) * (w - 1) if bordered else b * h * w


def _inside(numbers: Array, x: Array, bordered: bool) -> Array:
    """Numbers (..., H W, 4 C) of bordered blocks x (B, H, W, 4 C) with zeros outside the image; others as they are."""
    if not bordered:
        return numbers
    _, h, w, c = x.shape
    return numbers * jnp.asarray(np.repeat(inside(h, w).reshape(-1, 4), c // 4, axis=1), numbers.dtype)


def _wide(channels: Array, bordered: bool) -> Array:
    """(C,), or (4 C,) for blocks."""
    return _exact(channels, _four_times(channels)) if bordered else channels


def _sums(images: Array, x: Array, bordered: bool) -> Array:
    """Sums over images and pixels inside, (C,): of `images` (B, H W, C) or (B, H W, 4 C), which has the layout of x."""
    return _over_pixels(jnp.sum(images, 0), x, bordered)


def _both_over_images(a: Array, b: Array) -> tuple[Array, Array]:
    """Sums over the first axis of both, in one pass: two sums would write ReLU's masked gradient out and read it twice. In groups of
    at most GROUP images: longer strides through memory are slow."""
    group = max(size for size in range(1, GROUP + 1) if len(a) % size == 0)
    a, b = (numbers.reshape(-1, group, *numbers.shape[1:]) for numbers in (a, b))
    zero = jnp.zeros((), a.dtype)
    sums = jax.lax.reduce((a, b), (zero, zero), lambda x, y: (x[0] + y[0], x[1] + y[1]), (1,))
    return sums[0].sum(0), sums[1].sum(0)


def _over_pixels(numbers: Array, x: Array, bordered: bool) -> Array:
    """Sums over pixels inside, (C,): of (H W, C) or (H W, 4 C), which has the layout of an image of x."""
    numbers = _inside(numbers, x, bordered)
    # two rows of ones: a product with a vector would be fused with all that comes before, into one slow loop
    columns = _exact(jnp.ones((2, len(numbers)), numbers.dtype), numbers)[0]
    return columns.reshape(4, -1).sum(0) if bordered else columns


def _four_times(channels: Array) -> Array:
    return jnp.asarray(np.tile(np.eye(len(channels)), 4), channels.dtype)


def _exact(a: Array, b: Array) -> Array:
    """Matrix product in full precision, also where products are rounded by default (GPU)."""
    return jnp.matmul(a, b, precision="highest")


class NormRelu(nn.Module):
    """Batch normalisation and ReLU; see `norm_relu`. Its variables are named as Flax's BatchNorm names them."""

    bordered: bool = False

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        c = x.shape[-1] // (4 if self.bordered else 1)
        scale = self.param("scale", nn.initializers.ones, (c,))
        bias = self.param("bias", nn.initializers.zeros, (c,))
        mean = self.variable("batch_stats", "mean", jnp.zeros, (c,))
        variance = self.variable("batch_stats", "var", jnp.ones, (c,))
        if not train:
            return affine_relu(x, scale, bias, mean.value, variance.value, self.bordered)
        y, batch_mean, batch_variance = norm_relu(x, scale, bias, self.bordered)
        if not self.is_initializing():
            mean.value = MOMENTUM * mean.value + (1 - MOMENTUM) * batch_mean
            variance.value = MOMENTUM * variance.value + (1 - MOMENTUM) * batch_variance
        return y


class First(nn.Module):
    """4x4 convolution of stride 2 from the image (B, S, S, C) to the bordered blocks (B, S/4+1, S/4+1, 4 width)."""

    width: int

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        w = self.param("kernel", INIT, (4, 4, x.shape[-1], self.width)).astype(x.dtype)
        return NormRelu(bordered=True, name="norm")(conv.conv_valid(conv.windows(x), conv.first_kernel(w)), train)


class Down(nn.Module):
    """4x4 convolution of stride 2 to (B, H/2, W/2, width), from (B, H, W, C) or from bordered blocks of it."""

    width: int
    from_blocks: bool = False

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        blocks = x if self.from_blocks else conv.to_blocks(conv.pad(x, 1), 2)
        w = self.param("kernel", INIT, (4, 4, blocks.shape[-1] // 4, self.width)).astype(x.dtype)
        return NormRelu(name="norm")(conv.conv_valid(blocks, conv.down_kernel(w)), train)


class Same(nn.Module):
    """3x3 convolution of stride 1: (B, H, W, C) -> (B, H, W, width)."""

    width: int

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        w = self.param("kernel", INIT, (3, 3, x.shape[-1], self.width)).astype(x.dtype)
        return NormRelu(name="norm")(conv.conv_valid(conv.pad(x, 1), w, 1), train)


class Up(nn.Module):
    """4x4 transposed convolution of stride 2 from a bordered array (B, H+2, W+2, C) to bordered blocks (B, H+1, W+1, 4
    width) of (2H, 2W); `conv.from_blocks` makes the next bordered array of them."""

    width: int

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        w = self.param("kernel", INIT, (4, 4, x.shape[-1], self.width)).astype(x.dtype)
        return NormRelu(bordered=True, name="norm")(conv.conv_valid(x, conv.up_kernel(w), 1), train)


class Last(nn.Module):
    """4x4 transposed convolution of stride 2, with bias, from bordered blocks (B, H+1, W+1, 4 C) to the image (B, 4H,
    4W, 1), which is in float32 or wider: the bias' gradient is a sum over all pixels, more than bfloat16 can count."""

    @nn.compact
    def __call__(self, x: Array) -> Array:
        w = self.param("kernel", INIT, (4, 4, x.shape[-1] // 4, 1)).astype(x.dtype)
        bias = self.param("bias", nn.initializers.zeros, (1,))
        image = conv.from_windows(conv.conv_valid(x, conv.last_kernel(w)))
        return image.astype(jnp.promote_types(x.dtype, jnp.float32)) + bias[None, None, None]
