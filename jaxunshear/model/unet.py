"""A U-Net in the place of UnshearNet: sheared image -> canonical one, behind the same kind of pure functions.

>>> variables = init(net, jax.random.key(0))
>>> canonical = unshear(net, variables, sheared)                  # (B, S, S, 1) in [0, 1] -> the same

It is the rival that image-to-image work would try first (Ronneberger et al. 2015): every decoder layer also sees the encoder's
array of its own size, so there is no code that could hold a pose, nor one that could be swapped.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from jaxunshear.model import conv, unshearnet
from jaxunshear.model.layers import Down, First, Last, Up
from jaxunshear.settings import networks

Variables = dict[str, Any]


class Network(nn.Module):
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
            x = jnp.concatenate([Up(width)(x, train), conv.from_blocks(arrays.pop(), 2)], -1)
        x, skipped = Up(first, "blocks")(x, train), arrays.pop()
        return Last()(_joined_blocks(x, skipped), train)


def _joined_blocks(a: Array, b: Array) -> Array:
    """Bordered blocks (B, H, W, 4 C) and (B, H, W, 4 D) -> (B, H, W, 4 (C + D)): joined pixel by pixel."""
    parts = [x.reshape(*x.shape[:3], 4, -1) for x in (a, b)]
    return jnp.concatenate(parts, -1).reshape(*a.shape[:3], -1)


def init(net: networks.UNet, key: Array) -> Variables:
    """Fresh variables. Raises ValueError where `size` and `widths` do not fit each other."""
    check(net)
    side = 2 ** len(net.widths)
    return dict(Network(net).init(key, jnp.zeros((1, side, side, 1)), True))


def check(net: networks.UNet) -> None:
    """Raises ValueError that names the field where a network of these settings cannot be built."""
    unshearnet.check(networks.UnshearNet(net.size, net.widths))


def unshear(net: networks.UNet, variables: Variables, images: Array) -> Array:
    """Sheared images (B, S, S, 1) in [0, 1] -> canonical ones."""
    logits: Array = Network(net).apply(variables, images, False)  # type: ignore[assignment]
    return jax.nn.sigmoid(logits)


def reconstruct(net: networks.UNet, variables: Variables, images: Array) -> tuple[Array, None, None, Variables]:
    """The training pass: logits of the canonical image, nothing in the places of the sheared one and of a code, new running
    statistics."""
    canonical, updates = Network(net).apply(variables, images, True, mutable=["batch_stats"])
    return canonical, None, None, updates["batch_stats"]
