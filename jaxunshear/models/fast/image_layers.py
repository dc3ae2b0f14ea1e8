"""The 4x4 convolutions of stride 2 next to an image of one channel: the first layer's, and the transposed one of the last layer.

>>> y = apply_first(image, w)    # (B, 4H, 4W, C), w (4, 4, C, N) -> bordered blocks (B, H+1, W+1, 4N)
>>> z = apply_last(x, w)         # bordered blocks (B, H+1, W+1, 4C), w (4, 4, C, 1) -> image (B, 4H, 4W, 1)

One channel would leave most of a vector unused. In XLA they are products of 6x6 *windows* of the image with blocks, which takes
2.25 times the multiplications. Where `native.py` can, training takes compiled ones without that: `gather`, `scatter` and `outer` are
the three slopes of one sum, sum image[2i-1+k, 2j-1+l] kernel[k, l, c] blocks[i, j, c], so each is a gradient of the others.
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
    """What lies outside the image is not to be read. `compiled` asks for that form where there is one."""
    if compiled and compiled_kernels.can_compute_image(x, w):
        return gather(x, w.reshape(16, -1))
    return conv_valid(extract_windows(x), _first_kernel(w))


def apply_last(x: Array, w: Array, compiled: bool = False) -> Array:
    """What lies outside the blocks' image must be zero. `compiled` as in `apply_first`."""
    image = jax.ShapeDtypeStruct(
        (len(x), 4 * (x.shape[1] - 1), 4 * (x.shape[2] - 1), w.shape[3]), x.dtype
    )
    if compiled and compiled_kernels.can_compute_image(image, w):
        # Flax's kernels are turned
        return scatter(x, jnp.flip(w, (0, 1)).reshape(16, -1))
    return from_windows(conv_valid(x, _last_kernel(w)))


@jax.custom_vjp
def gather(image: Array, kernel: Array) -> Array:
    """(B, S, S, 1), (16, C) -> bordered blocks (B, S/4+1, S/4+1, 4C), zero outside."""
    return _on_cpu(compiled_kernels.gather, _gather, image, kernel)


@jax.custom_vjp
def scatter(blocks: Array, kernel: Array) -> Array:
    """Bordered blocks (B, S/4+1, S/4+1, 4C), (16, C) -> (B, S, S, 1)."""
    return _on_cpu(compiled_kernels.scatter, _scatter, blocks, kernel)


@jax.custom_vjp
def outer(image: Array, blocks: Array) -> Array:
    """(B, S, S, 1), bordered blocks (B, S/4+1, S/4+1, 4C) -> (16, C)."""
    return _on_cpu(compiled_kernels.outer, _outer, image, blocks)


gather.defvjp(
    lambda x, k: (gather(x, k), (x, k)),
    lambda given, dy: (scatter(dy, given[1]), outer(given[0], dy)),
)
scatter.defvjp(
    lambda y, k: (scatter(y, k), (y, k)),
    lambda given, dx: (gather(dx, given[1]), outer(dx, given[0])),
)
outer.defvjp(
    lambda x, y: (outer(x, y), (x, y)),
    lambda given, dk: (scatter(given[1], dk), gather(given[0], dk)),
)


def _on_cpu(run: Callable[..., Array], plain: Callable[..., Array], *given: Array) -> Array:
    return lax.platform_dependent(
        *given, cpu=run if compiled_kernels.is_available() else plain, default=plain
    )


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
    """The 6x6 pixels of the image that the bordered blocks of half its size are read from: (B, 4H, 4W, C) -> (B, H+1, W+1,
    36 C), channels ordered (row, column, channel), with zeros outside."""
    b, h, w, c = x.shape
    x = jnp.pad(x, ((0, 0), (3, 5), (3, 5), (0, 0))).reshape(b, h // 4 + 2, 4, w // 4 + 2, 4, c)
    x = jnp.concatenate([x[:, :-1], x[:, 1:, :2]], 2)
    x = jnp.concatenate([x[:, :, :, :-1], x[:, :, :, 1:, :2]], 4)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(b, h // 4 + 1, w // 4 + 1, 36 * c)


def from_windows(x: Array) -> Array:
    """The transpose of `extract_windows`: (B, H+1, W+1, 36 C) -> (B, 4H, 4W, C), sums where windows overlap."""
    b, h, w, c = x.shape
    image = jax.ShapeDtypeStruct((b, 4 * (h - 1), 4 * (w - 1), c // 36), x.dtype)
    return jax.linear_transpose(extract_windows, image)(x)[0]


def _first_kernel(w: Array) -> Array:
    """(4, 4, C, N) of a stride-2 convolution -> (1, 1, 36 C, 4N) from `extract_windows` of the image to the bordered blocks of the
    output: what the next `down_kernel` reads, so the widest array of the network is never rearranged."""
    # of the window's rows t, the output's row a of a block reads 2a + k
    place = _placement(lambda t, a: t - 2 * a, w.dtype)
    big = jnp.einsum("tak,sbl,klcn->tscabn", place, place, w, precision="highest")
    return big.reshape(1, 1, 36 * w.shape[2], 4 * w.shape[3])


def _last_kernel(w: Array) -> Array:
    """(4, 4, C, N) of a stride-2 transposed convolution -> (1, 1, 4C, 36N) from the bordered blocks of its input to
    `extract_windows` of its output."""
    # the input's row a of a block reaches the window's rows t through k = 3 - (t - 2a): Flax's kernels are turned
    place = _placement(lambda t, a: 3 - t + 2 * a, w.dtype)
    big = jnp.einsum("tak,sbl,klcn->abctsn", place, place, w, precision="highest")
    return big.reshape(1, 1, 4 * w.shape[2], 36 * w.shape[3])


def _placement(tap: Callable[[np.ndarray, np.ndarray], np.ndarray], dtype: np.dtype) -> Array:
    """1 where tap `tap(row of the window, row of the block)` of a kernel is k, else 0: (6, 2, 4)."""
    row, column = np.indices((6, 2))
    return jnp.asarray(tap(row, column)[..., None] == np.arange(4), dtype)
