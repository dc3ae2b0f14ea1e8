"""Codes of images that are a few numbers without place, as those of networks over pins are."""

import math
from collections.abc import Callable

import flax.linen as nn
from jax import Array

from jaxunshear.models.layers import EPSILON, INIT, MOMENTUM


class VectorCode(nn.Module):
    """An encoder's array (B, s, s, C) -> (B, 1, 1, width).

    With `normalise`, the numbers of a code have mean 0 and variance 1.
    """

    width: int
    normalise: bool = True

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        z = nn.Dense(self.width, dtype=x.dtype, kernel_init=INIT)(x.reshape(x.shape[0], -1))
        if not self.normalise:
            return z[:, None, None]
        # No loss limits the size of a pose code. Without normalisation it grows until DS, which
        # does not teach it, cannot make out the shear code beside it.
        return nn.LayerNorm(dtype=z.dtype, use_scale=False, use_bias=False)(z)[:, None, None]


class VectorDecoder(nn.Module):
    """Numbers (B, 1, 1, n) -> an array (B, *shape) -> what a decoder makes of it."""

    shape: tuple[int, int, int]
    decoder: Callable[[], nn.Module]

    @nn.compact
    def __call__(self, z: Array, train: bool) -> Array:
        dense = nn.Dense(math.prod(self.shape), use_bias=False, dtype=z.dtype, kernel_init=INIT)
        x = dense(z.reshape(z.shape[0], -1)).reshape(z.shape[0], *self.shape)
        norm = nn.BatchNorm(
            not train, momentum=MOMENTUM, epsilon=EPSILON, dtype=x.dtype, use_fast_variance=False
        )
        decoded: Array = self.decoder()(nn.relu(norm(x)), train)
        return decoded
