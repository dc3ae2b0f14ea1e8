"""The 4x4 convolutions of stride 2 next to an image of one channel.

They are the convolution of the first layer, and the transposed one of the last layer.

>>> # (B, 4H, 4W, C), w (4, 4, C, N) -> bordered blocks (B, H+1, W+1, 4N)
>>> y = apply_first(image, w)
>>> # bordered blocks (B, H+1, W+1, 4C), w (4, 4, C, 1) -> image (B, 4H, 4W, 1)
>>> z = apply_last(x, w)

One channel would leave most of a vector unused. In XLA they are products of 6x6 *windows* of the
image with blocks, which takes 2.25 times the multiplications. Compiled forms (compiled_kernels.py),
which training takes if there are any, do without that. `gather`, `scatter` and `outer` are the
three derivatives of one sum, sum image[2i-1+k, 2j-1+l] kernel[k, l, c] blocks[i, j, c], so each is
a gradient of the others.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxunshear.models.fast import compiled_kernels
from jaxunshear.models.fast.conv import conv_valid
from jaxunshear.models.fast.norm import convert_layout


def apply_first(x: Array, w: Array, compiled: bool = False) -> Array:
    """Apply the first convolution; blocks outside the image are undefined.

    `compiled` asks for the compiled form if there is one.
    """
    if compiled and compiled_kernels.can_compute_image(x, w):
        return gather(x, w.reshape(16, -1))
    return conv_valid(extract_windows(x), _first_kernel(w))


def apply_last(x: Array, w: Array, compiled: bool = False) -> Array:
    """Apply the last convolution; blocks must be zero outside the image.

    `compiled` asks for the compiled form if there is one.
    """
    image = jax.ShapeDtypeStruct(
        (len(x), 4 * (x.shape[1] - 1), 4 * (x.shape[2] - 1), w.shape[3]), x.dtype
    )
    if compiled and compiled_kernels.can_compute_image(image, w):
        # Flax's kernels are rotated by 180 deg
        return scatter(x, jnp.flip(w, (0, 1)).reshape(16, -1))
    return from_windows(conv_valid(x, _last_kernel(w)))


@jax.custom_vjp
def gather(image: Array, kernel: Array) -> Array:
    """Convolve (B, S, S, 1) with (16, C) to bordered blocks (B, S/4+1, S/4+1, 4C), zero outside."""
    return _run(compiled_kernels.gather, _gather, image, kernel)


@jax.custom_vjp
def scatter(blocks: Array, kernel: Array) -> Array:
    """Transpose-convolve bordered blocks (B, S/4+1, S/4+1, 4C) with (16, C) to (B, S, S, 1)."""
    return _run(compiled_kernels.scatter, _scatter, blocks, kernel)


@jax.custom_vjp
def outer(image: Array, blocks: Array) -> Array:
    """Compute a kernel's gradient (16, C) from (B, S, S, 1) and bordered blocks."""
    return _run(compiled_kernels.outer, _outer, image, blocks)


gather.defvjp(
    lambda x, k: (gather(x, k), (x, k)),
    lambda saved, dy: (scatter(dy, saved[1]), outer(saved[0], dy)),
)
scatter.defvjp(
    lambda y, k: (scatter(y, k), (y, k)),
    lambda saved, dx: (gather(dx, saved[1]), outer(dx, saved[0])),
)
outer.defvjp(
    lambda x, y: (outer(x, y), (x, y)),
    lambda saved, dk: (scatter(saved[1], dk), gather(saved[0], dk)),
)


def _run(compiled: Callable[..., Array], plain: Callable[..., Array], *arrays: Array) -> Array:
    on_cpu = compiled if compiled_kernels.is_available() else plain
    return lax.platform_dependent(*arrays, cpu=on_cpu, default=plain)


def _gather(image: Array, kernel: Array) -> Array:
    w = kernel.reshape(4, 4, 1, -1)
    y = lax.conv_general_dilated(
        image, w, (2, 2), 2 * [(1, 1)], dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    return convert_layout(y, "plain", "blocks")


def _scatter(blocks: Array, kernel: Array) -> Array:
    image = jax.ShapeDtypeStruct(
        (len(blocks), *(4 * (n - 1) for n in blocks.shape[1:3]), 1), blocks.dtype
    )
    return jax.linear_transpose(partial(_gather, kernel=kernel), image)(blocks)[0]


def _outer(image: Array, blocks: Array) -> Array:
    kernel = jax.ShapeDtypeStruct((16, blocks.shape[-1] // 4), blocks.dtype)
    return jax.linear_transpose(partial(_gather, image), kernel)(blocks)[0]


def extract_windows(x: Array) -> Array:
    """Extract the 6x6 pixels that each bordered block of the next layer is computed from.

    (B, 4H, 4W, C) -> (B, H+1, W+1, 36 C), channels ordered (row, column, channel), zero outside.
    """
    b, h, w, c = x.shape
    x = jnp.pad(x, ((0, 0), (3, 5), (3, 5), (0, 0))).reshape(b, h // 4 + 2, 4, w // 4 + 2, 4, c)
    x = jnp.concatenate([x[:, :-1], x[:, 1:, :2]], 2)
    x = jnp.concatenate([x[:, :, :, :-1], x[:, :, :, 1:, :2]], 4)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(b, h // 4 + 1, w // 4 + 1, 36 * c)


def from_windows(x: Array) -> Array:
    """Transpose `extract_windows`: (B, H+1, W+1, 36 C) -> (B, 4H, 4W, C), with sums at overlaps."""
    b, h, w, c = x.shape
    image = jax.ShapeDtypeStruct((b, 4 * (h - 1), 4 * (w - 1), c // 36), x.dtype)
    return jax.linear_transpose(extract_windows, image)(x)[0]


def _first_kernel(w: Array) -> Array:
    """Rearrange the kernel (4, 4, C, N) of a stride-2 convolution to (1, 1, 36 C, 4N).

    The new kernel leads from windows of the image to bordered blocks of the output. The next
    `down_kernel` reads these, so the widest array of the network is never rearranged.
    """
    # of the window's rows t, the output's row a of a block reads 2a + k
    place = _placement(lambda t, a: t - 2 * a, w.dtype)
    big = jnp.einsum("tak,sbl,klcn->tscabn", place, place, w, precision="highest")
    return big.reshape(1, 1, 36 * w.shape[2], 4 * w.shape[3])


def _last_kernel(w: Array) -> Array:
    """Rearrange the kernel (4, 4, C, N) of a stride-2 transposed convolution to (1, 1, 4C, 36N).

    The new kernel leads from the bordered blocks of the input to windows of the output.
    """
    # row a of a block of the input reaches row t of the window through k = 3 - (t - 2a), since
    # Flax's kernels are rotated by 180 deg
    place = _placement(lambda t, a: 3 - t + 2 * a, w.dtype)
    big = jnp.einsum("tak,sbl,klcn->abctsn", place, place, w, precision="highest")
    return big.reshape(1, 1, 4 * w.shape[2], 36 * w.shape[3])


def _placement(tap: Callable[[np.ndarray, np.ndarray], np.ndarray], dtype: np.dtype) -> Array:
    """Mark the row k = tap(row of the window, row of the block) of a kernel by 1: (6, 2, 4)."""
    row, column = np.indices((6, 2))
    return jnp.asarray(tap(row, column)[..., None] == np.arange(4), dtype)
