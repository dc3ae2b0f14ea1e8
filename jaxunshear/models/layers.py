"""The layers of all networks over images: convolution, batch normalisation, ReLU (appendix A).

The precision is that of their inputs. Codes without places are a few numbers, as those of networks
over pins are.
"""

import math
from collections.abc import Callable

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

INIT = nn.initializers.normal(0.02)  # paper, appendix B
MOMENTUM = 0.9  # of the running statistics
EPSILON = 1e-5


class Down(nn.Module):
    """4x4 convolution of stride 2: (B, H, W, C) -> (B, H/2, W/2, width)."""

    width: int

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        conv = nn.Conv(
            self.width, (4, 4), 2, padding=1, use_bias=False, dtype=x.dtype, kernel_init=INIT
        )
        return norm_relu(self, conv, x, train)


class Same(nn.Module):
    """3x3 convolution of stride 1: (B, H, W, C) -> (B, H, W, width)."""

    width: int

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        conv = nn.Conv(
            self.width, (3, 3), padding=1, use_bias=False, dtype=x.dtype, kernel_init=INIT
        )
        return norm_relu(self, conv, x, train)


class ConvTranspose(nn.Conv):
    """Flax's 4x4 `ConvTranspose` of stride 2: (B, H, W, C) -> (B, 2H, 2W, features).

    It is written as the convolution of an image with zeros between its pixels. For Flax's own layer
    XLA computes the kernel's gradient by a convolution with a kernel as large as the image, which
    took four fifths of a step on a GPU (https://github.com/jax-ml/jax/issues/31662).
    """

    kernel_size: tuple[int, int] = (4, 4)
    padding: str = "VALID"

    def __call__(self, x: Array) -> Array:
        between = (2, 2, 1)
        zero = jnp.zeros((), x.dtype)
        return super().__call__(lax.pad(x, zero, ((0, 0, 0), between, between, (0, 0, 0))))


class Up(nn.Module):
    """4x4 transposed convolution of stride 2: (B, H, W, C) -> (B, 2H, 2W, width)."""

    width: int

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        conv = ConvTranspose(self.width, use_bias=False, dtype=x.dtype, kernel_init=INIT)
        return norm_relu(self, conv, x, train)


class Last(nn.Module):
    """4x4 transposed convolution of stride 2, with bias: (B, H, W, C) -> (B, 2H, 2W, 1)."""

    @nn.compact
    def __call__(self, x: Array, train: bool) -> Array:
        conv = ConvTranspose(1, use_bias=False, dtype=x.dtype, kernel_init=INIT)
        nn.share_scope(self, conv)
        bias = self.param("bias", nn.initializers.zeros, (1,))
        image: Array = conv(x)
        return image.astype(np.promote_types(x.dtype, np.float32)) + bias[None, None, None]


def norm_relu(
    layer: nn.Module, conv: nn.Conv, x: Float[Array, "B H W C"], train: bool
) -> Float[Array, "B _ _ N"]:
    """Apply convolution, batch normalisation and ReLU; the kernel is a parameter of `layer`."""
    nn.share_scope(layer, conv)
    norm = nn.BatchNorm(
        not train,
        momentum=MOMENTUM,
        epsilon=EPSILON,
        dtype=x.dtype,
        use_fast_variance=False,
        name="norm",
    )
    return nn.relu(norm(conv(x)))


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

    shape: tuple[int, ...]
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
