"""A small convolution as one matrix product over what each place sees: XLA's CPU backend computes it, and its gradients, in less time.

>>> nn.Conv(24, (3, 3), conv_general_dilated=convolution)(x)  # (B, H, W, C) -> (B, H, W, 24)
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax.numpy as jnp
from jax import Array, lax


def convolution(
    x: Array, kernel: Array, strides: Sequence[int], padding: str, **more: Any
) -> Array:
    """As `lax.conv_general_dilated` of x (B, H, W, C) and a kernel (k, k, C, N), which computes it where there is no CPU. `more` is
    what Flax names beside: nothing of it is dilated or in groups."""
    plain = partial(lax.conv_general_dilated, window_strides=strides, padding=padding, **more)
    return lax.platform_dependent(
        x, kernel, cpu=partial(_product, strides=strides, padding=padding), default=plain
    )


def _product(x: Array, kernel: Array, strides: Sequence[int], padding: str) -> Array:
    around = lax.padtype_to_pads(x.shape[1:3], kernel.shape[:2], strides, padding)
    x = jnp.pad(x, ((0, 0), *around, (0, 0)))
    ends = [side - k + 1 for side, k in zip(x.shape[1:3], kernel.shape[:2], strict=True)]
    seen = [
        x[:, i : i + ends[0] : strides[0], j : j + ends[1] : strides[1]]
        for i in range(kernel.shape[0])
        for j in range(kernel.shape[1])
    ]
    return jnp.concatenate(seen, -1) @ kernel.reshape(-1, kernel.shape[-1])
