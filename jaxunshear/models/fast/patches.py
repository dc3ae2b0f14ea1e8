"""Small convolutions as one matrix product over the patches of all places.

XLA's CPU backend computes these, and their gradients, in less time.

>>> nn.Conv(24, (3, 3), conv_general_dilated=convolve)(x)  # (B, H, W, C) -> (B, H, W, 24)
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax.numpy as jnp
from jax import Array, lax


def convolve(x: Array, kernel: Array, strides: Sequence[int], padding: str, **more: Any) -> Array:
    """Convolve x (B, H, W, C) with a kernel (k, k, C, N).

    `lax.conv_general_dilated` does it on other devices than a CPU. `more` holds the other arguments
    that Flax passes; there is no dilation, and there are no groups.
    """
    plain = partial(lax.conv_general_dilated, window_strides=strides, padding=padding, **more)
    on_cpu = partial(_multiply_patches, strides=strides, padding=padding)
    return lax.platform_dependent(x, kernel, cpu=on_cpu, default=plain)


def _multiply_patches(x: Array, kernel: Array, strides: Sequence[int], padding: str) -> Array:
    pads = lax.padtype_to_pads(x.shape[1:3], kernel.shape[:2], strides, padding)
    x = jnp.pad(x, ((0, 0), *pads, (0, 0)))
    ends = [side - k + 1 for side, k in zip(x.shape[1:3], kernel.shape[:2], strict=True)]
    patches = [
        x[:, i : i + ends[0] : strides[0], j : j + ends[1] : strides[1]]
        for i in range(kernel.shape[0])
        for j in range(kernel.shape[1])
    ]
    return jnp.concatenate(patches, -1) @ kernel.reshape(-1, kernel.shape[-1])
