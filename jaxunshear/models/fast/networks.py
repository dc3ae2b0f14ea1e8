"""The layers and the networks over images as a CPU computes them fast.

They have the names and parameters of those in `models/layers.py`, `unshearnet.py`, `unet.py` and
`posenet.py`, the same precision, and the same values to rounding. Arrays between layers are in the
layout that the next one reads ("plain", "padded", "blocks": norm.py).
"""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxunshear.config import networks
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


class Encoder(nn.Module):
    """E: an image (B, S, S, 1) -> (B, S / 2**layers, S / 2**layers, widths[-1])."""

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        x = First(self.widths[0])(x, train)
        for width in self.widths[1:-1]:
            x = Down(width)(x, train)
        return Down(self.widths[-1], "plain")(x, train)


class Decoder(nn.Module):
    """DC and DS, the encoder's mirror: a code -> logits of an image (B, S, S, 1)."""

    widths: tuple[int, ...]  # the encoder's

    @nn.compact
    def __call__(self, z: Array, train: bool) -> Array:
        x = conv.pad(z, 1)
        for width in reversed(self.widths[1:-1]):
            x = Up(width)(x, train)
        return Last()(Up(self.widths[0], "blocks")(x, train), train)


class UNet(nn.Module):
    """Images (B, S, S, 1) -> logits (B, S, S, 1)."""

    net: networks.UNet

    @nn.compact
    def __call__(self, images: Array, train: bool) -> Array:
        first, *widths = self.net.widths
        arrays = [First(first)(images, train)]
        for width in widths[:-1]:
            arrays.append(Down(width)(arrays[-1], train))
        x = conv.pad(Down(widths[-1], "plain")(arrays[-1], train), 1)
        for width in reversed(widths[:-1]):
            x = jnp.concatenate([Up(width)(x, train), conv.from_blocks(arrays.pop())], -1)
        x, skipped = Up(first, "blocks")(x, train), arrays.pop()
        return Last()(_join_blocks(x, skipped), train)


class PoseNet(nn.Module):
    """Images (B, S, S, 1) -> outputs (B, outputs)."""

    net: networks.PoseNet
    outputs: int

    @nn.compact
    def __call__(self, images: Array, train: bool) -> Array:
        first, second, *rest = self.net.widths
        x = Down(second, "plain")(First(first)(images, train), train)
        x = _halve(x)
        x = Same(rest[1])(Same(rest[0])(x, train), train)
        x = _halve(x)
        x = Same(rest[2])(x, train)
        x = nn.relu(nn.Dense(self.net.hidden, kernel_init=INIT)(x.reshape(x.shape[0], -1)))
        return nn.sigmoid(nn.Dense(self.outputs, kernel_init=INIT)(x))


def _join_blocks(a: Array, b: Array) -> Array:
    """Join bordered blocks (B, H, W, 4 C) and (B, H, W, 4 D) pixel by pixel."""
    parts = [x.reshape(*x.shape[:3], 4, -1) for x in (a, b)]
    return jnp.concatenate(parts, -1).reshape(*a.shape[:3], -1)


def _halve(x: Array) -> Array:
    """Apply 2x2 max pooling, whose windowed form has a slow gradient in XLA's CPU backend."""
    b, h, w, c = x.shape
    return conv.to_blocks(x).reshape(b, h // 2, w // 2, 4, c).max(3)
