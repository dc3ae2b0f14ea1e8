"""Similarity of two images: MS-SSIM, SSIM and mean squared error, one number per image.

MS-SSIM is that of Wang, Simoncelli and Bovik (2003), with the constants of TensorFlow and
pytorch-msssim: an 11x11 Gaussian window of 1.5 pixels, applied only where it fits, K = (.01, .03),
and 2x2 means between scales.

Windows and means are separable, so each is a product with a small band matrix from the left and one
from the right. On a CPU two matrix products are faster than a convolution with one channel, and
their gradient is two more of them.

>>> ms_ssim(unsheared, tap, scales=count_scales(128))   # (B, 128, 128, 1) in [0, 1] -> (B,)
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

WINDOW = 11  # pixels
SIGMA = 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2  # of a dynamic range of 1
WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # of the scales, finest first
OVERSHOOT = 0.5  # of floats beyond [0, 1], above which they have another range
_NEAR_ZERO = 1e-9  # a mean contrast-structure below this is the rounding of a spatial mean


def count_scales(size: int) -> int:
    """Count the scales of MS-SSIM whose window fits images of `size` pixels: 0 to 5."""
    scales = 0
    while scales < len(WEIGHTS) and size >= WINDOW:
        scales, size = scales + 1, -(-size // 2)
    return scales


def format_ms_ssim_name(scales: int) -> str:
    """Format the name of a figure: `ms_ssim` with all five scales, else `ms_ssim@4` and so on."""
    return "ms_ssim" if scales == len(WEIGHTS) else f"ms_ssim@{scales}"


def ms_ssim(a: ArrayLike, b: ArrayLike, scales: int = 5) -> Float[Array, "B"]:
    """Compute the multi-scale structural similarity of (B, H, W, 1) images in [0, 1].

    It is 1 for equal images: the product of contrast-structure at all scales but the coarsest, and
    of SSIM there, each averaged over its image, clamped at 0 and raised to its weight. With fewer
    than five scales the first weights are scaled to sum to 1. That is another quantity, with
    another name (`format_ms_ssim_name`). Images of odd size repeat their last row or column before
    a 2x2 mean. Values and gradients of finite images are finite; if a clamped factor makes the
    value 0, the gradient is 0, too. An image with a NaN scores NaN.

    Raises `ValueError` for shapes that differ, integers, floats that are clearly not in [0, 1] (of
    arrays, not while JAX traces), or an image too small for `scales`.
    """
    a, b = _check_images(a, b)
    if not 1 <= scales <= len(WEIGHTS):
        raise ValueError(f"scales = {scales}: must be 1 to {len(WEIGHTS)}")
    size = min(a.shape[1:3])
    if scales > (fit := count_scales(size)):
        height, width = a.shape[1:3]
        raise ValueError(
            f"a {height}x{width} image is too small for {scales} scales of MS-SSIM: {fit} fit"
        )
    return _ms_ssim(a, b, scales)


def ssim(a: ArrayLike, b: ArrayLike) -> Float[Array, "B"]:
    """Compute the mean structural similarity (Wang 2004) of (B, H, W, 1) images in [0, 1].

    It lies in [-1, 1]. Raises `ValueError` as `ms_ssim` does.
    """
    a, b = _check_images(a, b)
    if min(a.shape[1:3]) < WINDOW:
        raise ValueError(
            f"a {a.shape[1]}x{a.shape[2]} image is smaller than SSIM's window of {WINDOW} pixels"
        )
    return _ssim(a, b)


def mse(a: ArrayLike, b: ArrayLike) -> Float[Array, "B"]:
    """Compute the mean squared error of (B, H, W, 1) images in [0, 1].

    Raises `ValueError` as `ms_ssim` does.
    """
    a, b = _check_images(a, b)
    return jnp.mean(jnp.square(a - b), axis=(1, 2, 3))


def _check_images(a: ArrayLike, b: ArrayLike) -> tuple[Array, Array]:
    """Return both as floating point of at least 32 bits."""
    a, b = jnp.asarray(a), jnp.asarray(b)
    if a.shape != b.shape or a.ndim != 4 or a.shape[-1] != 1:
        raise ValueError(
            f"two batches of one shape (B, H, W, 1) are needed, not {a.shape} and {b.shape}"
        )
    for x in (a, b):
        if not jnp.issubdtype(x.dtype, jnp.floating):
            raise ValueError(
                f"images in [0, 1] are needed, not {x.dtype}: divide 8-bit images by 255 first"
            )
    dtype = np.result_type(*(np.promote_types(x.dtype, np.float32) for x in (a, b)))
    a, b = a.astype(dtype), b.astype(dtype)
    _check_range(a)
    _check_range(b)
    return a, b


def _check_range(x: Array) -> None:
    if isinstance(x, jax.core.Tracer) or not x.size:
        return
    values = np.asarray(x)
    low = float(np.fmin.reduce(values, axis=None))  # without NaN
    high = float(np.fmax.reduce(values, axis=None))
    if low < -OVERSHOOT or high > 1 + OVERSHOOT:
        raise ValueError(
            f"images in [0, 1] are needed, not of {low:g} to {high:g}: divide by the largest level"
        )


@partial(jax.jit, static_argnames="scales")
def _ms_ssim(a: Array, b: Array, scales: int) -> Array:
    weights = np.array(WEIGHTS[:scales]) / sum(WEIGHTS[:scales])
    if scales == len(WEIGHTS):
        weights = np.array(WEIGHTS)  # these sum to 1.0001, and every library leaves them so
    a, b = a[..., 0], b[..., 0]
    value = jnp.ones(a.shape[0], a.dtype)
    *finer, coarsest = weights.tolist()
    for weight in finer:
        _, contrast = _compute_local_scores(a, b)
        value = value * _power(contrast, weight)
        a, b = _multiply_sides(_make_halving, a), _multiply_sides(_make_halving, b)
    similarity, _ = _compute_local_scores(a, b)
    return value * _power(similarity, coarsest)


@jax.jit
def _ssim(a: Array, b: Array) -> Array:
    similarity, _ = _compute_local_scores(a[..., 0], b[..., 0])
    return similarity


def _compute_local_scores(a: Array, b: Array) -> tuple[Array, Array]:
    """Compute SSIM and contrast-structure (B,) of (B, H, W) pairs, averaged over each image."""
    # as what is lacking to 1, not as (2 cov + C2) / (var + C2): that cancels in bright flat images,
    # and goes beyond 1
    terms = jnp.stack([a, b, a * a + b * b, jnp.square(a - b)])
    mean_a, mean_b, squares, difference = _multiply_sides(_make_blur, terms)
    brightness = mean_a * mean_a + mean_b * mean_b
    mean_difference = jnp.square(mean_a - mean_b)
    contrast = 1 - jnp.maximum(difference - mean_difference, 0) / (
        jnp.maximum(squares - brightness, 0) + C2
    )
    luminance = 1 - mean_difference / (brightness + C1)
    return jnp.mean(luminance * contrast, axis=(1, 2)), jnp.mean(contrast, axis=(1, 2))


def _power(x: Array, weight: float) -> Array:
    """Compute max(x, 0) ** weight with a gradient of 0, not infinite or NaN, at and below 0.

    A NaN stays one.
    """
    is_zero = x <= _NEAR_ZERO
    return jnp.where(is_zero, 0, jnp.where(is_zero, 1, x) ** weight)


def _multiply_sides(make_matrix: Callable[[int], np.ndarray], images: Array) -> Array:
    """Compute matrix(H) @ image @ matrix(W).T over all leading axes, in full float32.

    A device could otherwise use fewer bits.
    """
    rows = jnp.asarray(make_matrix(images.shape[-2]), images.dtype)
    columns = jnp.asarray(make_matrix(images.shape[-1]), images.dtype)
    right = jnp.matmul(images, columns.T, precision="highest")
    return jnp.matmul(rows, right, precision="highest")


def _make_blur(size: int) -> np.ndarray:
    """Make the (size - 10, size) band matrix with the Gaussian window at every place it fits."""
    kernel = np.exp(-0.5 * ((np.arange(WINDOW) - WINDOW // 2) / SIGMA) ** 2)
    kernel /= kernel.sum()
    matrix = np.zeros((size - WINDOW + 1, size))
    for row in range(len(matrix)):
        matrix[row, row : row + WINDOW] = kernel
    return matrix


def _make_halving(size: int) -> np.ndarray:
    """Make the (ceil(size / 2), size) matrix of means of neighbours; a last one stays alone."""
    matrix = np.zeros((-(-size // 2), size))
    for column in range(size):
        matrix[column // 2, column] = 0.5
    if size % 2:
        matrix[-1, -1] = 1
    return matrix
