"""The layers of `models/layers.py` as a CPU computes them fast.

They have the same names, parameters and precision, and the same values to rounding. Arrays between
them are in the layout that the next one reads ("plain", "padded", "blocks": norm.py).
"""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.models.fast import conv, image_layers
from jaxunshear.models.fast.norm import affine_relu, norm_relu
from jaxunshear.models.layers import INIT, MOMENTUM


class NormRelu(nn.Module):
    """Batch normalisation and ReLU, see `norm_relu`, with variables as in Flax's BatchNorm."""

    source: str = "plain"
    target: str = "plain"

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        c = x.shape[-1] // (4 if self.source == "blocks" else 1)
        scale = self.param("scale", nn.initializers.ones, (c,))
        bias = self.param("bias", nn.initializers.zeros, (c,))
        mean = self.variable("batch_stats", "mean", jnp.zeros, (c,))
        variance = self.variable("batch_stats", "var", jnp.ones, (c,))
        if not train:
            return affine_relu(x, scale, bias, mean.value, variance.value, self.source, self.target)
        y, batch_mean, batch_variance = norm_relu(x, scale, bias, self.source, self.target)
        if not self.is_initializing():
            mean.value = MOMENTUM * mean.value + (1 - MOMENTUM) * batch_mean
            variance.value = MOMENTUM * variance.value + (1 - MOMENTUM) * batch_variance
        return y


class First(nn.Module):
    """4x4 convolution of stride 2 from the image (B, S, S, C).

    The output is blocks (B, S/4+1, S/4+1, 4 width).
    """

    width: int

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        w = self.param("kernel", INIT, (4, 4, x.shape[-1], self.width)).astype(x.dtype)
        blocks = image_layers.apply_first(x, w, compiled=train)
        return NormRelu("blocks", "blocks", name="norm")(blocks, train)


class Down(nn.Module):
    """4x4 convolution of stride 2 from blocks (B, H/2+1, W/2+1, 4 C) of (H, W) to (H/2, W/2).

    The output is in layout `target`.
    """

    width: int
    target: str = "blocks"

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        w = self.param("kernel", INIT, (4, 4, x.shape[-1] // 4, self.width)).astype(x.dtype)
        return NormRelu("plain", self.target, name="norm")(
            conv.conv_valid(x, conv.down_kernel(w)), train
        )


class Same(nn.Module):
    """3x3 convolution of stride 1: (B, H, W, C) -> (B, H, W, width)."""

    width: int

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        w = self.param("kernel", INIT, (3, 3, x.shape[-1], self.width)).astype(x.dtype)
        return NormRelu(name="norm")(conv.conv_valid(conv.pad(x, 1), w, 1), train)


class Up(nn.Module):
    """4x4 transposed convolution of stride 2 from a padded array (B, H+2, W+2, C) to (2H, 2W).

    The output is in layout `target`.
    """

    width: int
    target: str = "padded"

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        w = self.param("kernel", INIT, (4, 4, x.shape[-1], self.width)).astype(x.dtype)
        return NormRelu("blocks", self.target, name="norm")(
            conv.conv_valid(x, conv.up_kernel(w), 1), train
        )


class Last(nn.Module):
    """4x4 transposed convolution of stride 2, with bias, from blocks to the image.

    Blocks are (B, H+1, W+1, 4 C). The image (B, 4H, 4W, 1) is in float32 or wider: the gradient of
    the bias is a sum over all pixels, more than bfloat16 can count.
    """

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        w = self.param("kernel", INIT, (4, 4, x.shape[-1] // 4, 1)).astype(x.dtype)
        bias = self.param("bias", nn.initializers.zeros, (1,))
        image = image_layers.apply_last(x, w, compiled=train)
        return image.astype(np.promote_types(x.dtype, np.float32)) + bias[None, None, None]
