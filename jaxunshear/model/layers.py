"""The layers of both networks: convolution + batch normalisation + ReLU, over plain or blocked arrays (see conv.py).

Batch normalisation is written out, with its own gradient: sums over pixels as matrix products with ones (column
sums are slow in XLA's CPU backend), the variance as the mean squared deviation (never negative), in float32 or
wider, and scale, shift, ReLU and mask in one pass.
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


# Below, all large arrays are (pixels, channels), the shape of the matrix products, and ReLU's mask is computed again from x
# instead of being kept: passes over memory are what this layer costs.


def _norm_relu(x, scale, bias, bordered):
    rows, inner, count = _rows(x, bordered)
    mean = _fold(_column_sums(_where(inner, rows)), bordered) / count
    centred = _where(inner, rows - _wide(mean, bordered))
    variance = _fold(_column_sums(centred * centred), bordered) / count
    y = affine_relu(x, scale, bias, mean, variance, bordered)
    return (y, mean, variance), (x, scale, bias, mean, variance)


def _norm_relu_backward(bordered, saved, cotangents):
    x, scale, bias, mean, variance = saved
    rows, inner, count = _rows(x, bordered)
    inverse = jax.lax.rsqrt(variance + EPSILON)
    normal = (rows - _wide(mean, bordered)) * _wide(inverse, bordered)
    active = rows * _wide(scale * inverse, bordered) + _wide(bias - mean * scale * inverse, bordered) > 0
    dy = jnp.where(active if inner is None else active & inner, cotangents[0].reshape(rows.shape), 0)
    d_bias = _fold(_column_sums(dy), bordered)
    d_scale = _fold(_column_sums(dy * normal), bordered)
    dx = dy - _where(inner, _wide(d_bias / count, bordered) + normal * _wide(d_scale / count, bordered))
    return (dx * _wide(scale * inverse, bordered)).reshape(x.shape), d_scale, d_bias


norm_relu.defvjp(_norm_relu, _norm_relu_backward)


def affine_relu(x: Array, scale: Array, bias: Array, mean: Array, variance: Array, bordered: bool) -> Array:
    """ReLU(batch norm) with given statistics (C,), zero outside the image."""
    rows, inner, _ = _rows(x, bordered)
    factor = scale * jax.lax.rsqrt(variance + EPSILON)
    y = rows * _wide(factor, bordered) + _wide(bias - mean * factor, bordered)
    return _where(inner, jax.nn.relu(y)).reshape(x.shape)


def _rows(x: Array, bordered: bool) -> tuple[Array, Array | None, int]:
    """x as (pixels, channels), which of its numbers lie inside (None: all), and how many pixels do."""
    b, h, w, c = x.shape
    rows = x.reshape(-1, c)
    if not bordered:
        return rows, None, b * h * w
    # one bit for each of a block's four pixels: a mask as wide as x would cost as much as reading x
    bits = np.tile((inside(h, w).reshape(-1, 4) @ (1, 2, 4, 8)).astype(np.int32), b)
    bit = np.repeat(np.array([1, 2, 4, 8], np.int32), c // 4)
    return rows, (jnp.asarray(bits)[:, None] & jnp.asarray(bit)[None]) != 0, b * 4 * (h - 1) * (w - 1)


def _where(inner: Array | None, rows: Array) -> Array:
    return rows if inner is None else jnp.where(inner, rows, 0)


def _wide(channels: Array, bordered: bool) -> Array:
    """(C,) -> (1, C), or (1, 4 C) for blocks."""
    return (jnp.tile(channels, 4) if bordered else channels)[None]


def _fold(columns: Array, bordered: bool) -> Array:
    """Sums of the columns of blocks (4 C,) -> of channels (C,)."""
    return jnp.sum(columns.reshape(4, -1), 0) if bordered else columns


def _column_sums(rows: Array) -> Array:
    """In full precision also where products are rounded by default (GPU)."""
    return jnp.matmul(jnp.ones((1, rows.shape[0]), rows.dtype), rows, precision="highest")[0]


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
        w = self.param("kernel", INIT, (4, 4, x.shape[-1], self.width))
        blocks = conv.to_blocks(conv.pad(x, 4), 4)
        return NormRelu(bordered=True, name="norm")(conv.conv_valid(blocks, conv.first_kernel(w)), train)


class Down(nn.Module):
    """4x4 convolution of stride 2 to (B, H/2, W/2, width), from (B, H, W, C) or from bordered blocks of it."""

    width: int
    from_blocks: bool = False

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        blocks = x if self.from_blocks else conv.to_blocks(conv.pad(x, 1), 2)
        w = self.param("kernel", INIT, (4, 4, blocks.shape[-1] // 4, self.width))
        return NormRelu(name="norm")(conv.conv_valid(blocks, conv.down_kernel(w)), train)


class Same(nn.Module):
    """3x3 convolution of stride 1: (B, H, W, C) -> (B, H, W, width)."""

    width: int

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        w = self.param("kernel", INIT, (3, 3, x.shape[-1], self.width))
        return NormRelu(name="norm")(conv.conv_valid(conv.pad(x, 1), w), train)


class Up(nn.Module):
    """4x4 transposed convolution of stride 2 from a bordered array (B, H+2, W+2, C) to bordered blocks (B, H+1, W+1, 4
    width) of (2H, 2W); `conv.from_blocks` makes the next bordered array of them."""

    width: int

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        w = self.param("kernel", INIT, (4, 4, x.shape[-1], self.width))
        return NormRelu(bordered=True, name="norm")(conv.conv_valid(x, conv.up_kernel(w)), train)


class Last(nn.Module):
    """4x4 transposed convolution of stride 2, with bias, from bordered blocks (B, H+1, W+1, 4 C) to the image (B, 4H,
    4W, 1)."""

    @nn.compact
    def __call__(self, x: Array) -> Array:
        w = self.param("kernel", INIT, (4, 4, x.shape[-1] // 4, 1))
        bias = self.param("bias", nn.initializers.zeros, (1,))
        return conv.from_blocks(conv.conv_valid(x, conv.last_kernel(w)), 4) + bias[None, None, None]
