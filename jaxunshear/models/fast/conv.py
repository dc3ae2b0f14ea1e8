"""Convolutions whose gradients are as fast as their forward pass.

XLA's CPU backend runs forward convolutions at the machine's peak, but the gradients that `jax.grad`
derives from them at a few per cent of it (strided and transposed ones above all). Two exact
rewritings avoid that on every backend:

1. `conv_valid` has its own gradients. That of its input is again a forward convolution. That of its
   kernel, on a CPU, is compiled for the processor (compiled_kernels.py); without a compiler it is
   matrix products over a few images at a time.
2. A 4x4 convolution of stride 2 is a 2x2 convolution between *blocks*: `to_blocks` moves each 2x2
   block of pixels into the channels. The transposed convolution writes blocks instead of reading
   them. Convolutions next to the image have a module of their own (image_layers.py).

>>> # (B, H, W, C), w (4, 4, C, N) -> (B, H/2, W/2, N)
>>> y = conv_valid(to_blocks(pad(x, 1)), down_kernel(w))
>>> # (B, H, W, C), w (4, 4, C, N) -> bordered blocks (B, H+1, W+1, 4N)
>>> z = conv_valid(pad(x, 1), up_kernel(w))

*Bordered blocks* are the blocks of an image that was padded by one pixel: the outermost half of the
outermost blocks lies outside the image and must be zero (`norm.make_inside_mask`).
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxunshear.models.fast import compiled_kernels

# pixels of one step of a kernel's gradient (CPU): one MB at the widths of these networks
SLICE = 1100
_NHWC = ("NHWC", "HWIO", "NHWC")


def pad(x: Array, pixels: int) -> Array:
    """Pad (B, H, W, C) with `pixels` zeros on all four sides."""
    return jnp.pad(x, ((0, 0), (pixels, pixels), (pixels, pixels), (0, 0)))


def to_blocks(x: Array) -> Array:
    """Move space to depth: (B, 2 H, 2 W, C) -> (B, H, W, 4 C).

    Channels are ordered (row in block, column in block, channel).
    """
    b, h, w, c = x.shape
    x = x.reshape(b, h // 2, 2, w // 2, 2, c).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(b, h // 2, w // 2, 4 * c)


def from_blocks(x: Array) -> Array:
    """Move depth to space, the inverse of `to_blocks`."""
    b, h, w, c = x.shape
    x = x.reshape(b, h, w, 2, 2, c // 4).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(b, 2 * h, 2 * w, c // 4)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def conv_valid(x: Array, w: Array, border: int = 0) -> Array:
    """Convolve x (B, H, W, C) with w (k, k, C, N) without padding, to (B, H-k+1, W-k+1, N).

    As in all networks, this is a correlation. The outermost `border` < k pixels of x must be zeros
    that depend on nothing (padding): their gradient is not computed but zero.
    """
    return lax.conv_general_dilated(x, w, (1, 1), "VALID", dimension_numbers=_NHWC)


def _backward(border: int, saved: tuple[Array, Array], dy: Array) -> tuple[Array, Array]:
    x, w = saved
    return _input_gradient(dy, w, border), _kernel_gradient(x, dy, w.shape[0], border)


conv_valid.defvjp(lambda x, w, border: (conv_valid(x, w, border), (x, w)), _backward)


def _input_gradient(dy: Array, w: Array, border: int) -> Array:
    flipped = jnp.flip(w, (0, 1)).swapaxes(2, 3)
    return pad(conv_valid(pad(dy, w.shape[0] - 1 - border), flipped), border)


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _kernel_gradient(x: Array, dy: Array, k: int, border: int) -> Array:
    """Compute a kernel's gradient dw (k, k, C, N).

    dw[i, j] is the sum over images and places of x[place + (i, j)] dy[place].
    """
    if compiled_kernels.get_form() == "counted":
        return _convolve_gradient(x, dy)
    compute = _multiply_gradient
    if compiled_kernels.can_compute_gradient(x, dy):
        compute = compiled_kernels.kernel_gradient
    on_cpu = partial(compute, k=k, border=border)
    return lax.platform_dependent(x, dy, cpu=on_cpu, default=_convolve_gradient)


def _kernel_gradient_backward(
    k: int, border: int, saved: tuple[Array, Array], change: Array
) -> tuple[Array, Array]:
    """Compute both gradients as convolutions.

    The sum of change * dw is that of conv_valid(x, change) * dy.
    """
    x, dy = saved
    return _input_gradient(dy, change, border), conv_valid(x, change, border)


_kernel_gradient.defvjp(
    lambda x, dy, k, border: (_kernel_gradient(x, dy, k, border), (x, dy)),
    _kernel_gradient_backward,
)


def _convolve_gradient(x: Array, dy: Array) -> Array:
    """Compute a kernel's gradient with the images as channels and dy as the kernel."""
    return lax.conv_general_dilated(
        x, dy, (1, 1), "VALID", dimension_numbers=("CHWN", "IHWO", "HWNC")
    )


def _multiply_gradient(x: Array, dy: Array, k: int, border: int) -> Array:
    """Compute a kernel's gradient by matrix products, one for each shift (i, j).

    The products go over a few images at a time, so all shifts read them from the cache. The smaller
    array stays, the larger one is shifted: x, or dy if x without its border is the smaller. The one
    with more channels is the right factor, whose rows are contiguous.
    """
    c, n = x.shape[-1], dy.shape[-1]
    images, h, w = dy.shape[:3]
    shifts = [(i, j) for i in range(k) for j in range(k)]
    inner = k > 1 and border == k - 1
    if inner:
        h, w = h - border, w - border
    step = max(
        s for s in range(1, images + 1) if images % s == 0 and (s == 1 or s * h * w <= SLICE)
    )
    wide = np.promote_types(x.dtype, np.float32)
    product = partial(jnp.matmul, preferred_element_type=wide)

    def at(array: Array, turn: Array, i: int, j: int) -> Array:
        part = lax.dynamic_slice(array, (turn * step, i, j, 0), (step, h, w, array.shape[-1]))
        return part.reshape(-1, array.shape[-1])

    def add(turn: Array, sums: list[Array]) -> list[Array]:
        if inner:
            still = at(x, turn, border, border)
            pairs = [(still, at(dy, turn, i, j)) for i, j in shifts[::-1]]
        else:
            still = at(dy, turn, 0, 0)
            pairs = [(at(x, turn, i, j), still) for i, j in shifts]
        return [
            s + (product(a.T, b) if c <= n else product(b.T, a))
            for s, (a, b) in zip(sums, pairs, strict=True)
        ]

    zero = jnp.zeros((c, n) if c <= n else (n, c), wide)
    sums = jnp.stack(lax.fori_loop(0, images // step, add, [zero] * len(shifts))).astype(x.dtype)
    return (sums if c <= n else sums.swapaxes(1, 2)).reshape(k, k, c, n)


def down_kernel(w: Array) -> Array:
    """Rearrange the kernel (4, 4, C, N) of a stride-2 convolution to (2, 2, 4C, N).

    The new kernel leads from the blocks of the padded input to the output.
    """
    c, n = w.shape[2:]
    return w.reshape(2, 2, 2, 2, c, n).transpose(0, 2, 1, 3, 4, 5).reshape(2, 2, 4 * c, n)


def up_kernel(w: Array) -> Array:
    """Rearrange the kernel (4, 4, C, N) of a stride-2 transposed convolution to (2, 2, C, 4N).

    The convolution is Flax's 'SAME'. The new kernel leads from the padded input to the bordered
    blocks of the output.
    """
    c, n = w.shape[2:]
    w = w.reshape(2, 2, 2, 2, c, n)[:, ::-1, :, ::-1]
    return w.transpose(0, 2, 4, 1, 3, 5).reshape(2, 2, c, 4 * n)


def convolve(x: Array, kernel: Array, strides: Sequence[int], padding: str, **more: Any) -> Array:
    """Convolve x (B, H, W, C) with a kernel (k, k, C, N), on a CPU as one product of patches.

    XLA's CPU backend computes that, and its gradients, in less time than a small convolution.

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
