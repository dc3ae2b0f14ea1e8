"""The networks over images with fast layers.

They have the same parameters as those in `unshearnet.py`, `unet.py` and `posenet.py`.
"""

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from jaxunshear.config import networks
from jaxunshear.models.fast import conv
from jaxunshear.models.fast.layers import Down, First, Last, Same, Up
from jaxunshear.models.layers import INIT


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
