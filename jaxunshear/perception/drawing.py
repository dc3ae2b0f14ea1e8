"""Draw pins as dots where only their positions are known, compare images, and encode PNG files.

>>> images = draw_dots(pins, radius_px=1.4, size=128)  # (B, P, 2) px -> (B, 128, 128, 1) in {0, 1}
"""

import io

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Float32, UInt8
from PIL import Image

MISSING = (255, 122, 26)  # orange: only the tap is bright
SURPLUS = (64, 150, 255)  # blue: only the image is bright


def draw_dots(
    pins: Float[Array, "B P 2"], radius_px: float, size: int
) -> Float32[Array, "B {size} {size} 1"]:
    """Draw binary images of pins px as (column, row); a pin that is NaN is not drawn.

    A Gaussian is separable, so all dots of an image are one product of matrices. Its level at the
    radius is the threshold.
    """
    pixel = jnp.arange(size, dtype=pins.dtype)
    visible = jnp.isfinite(pins).all(-1, keepdims=True)
    position = jnp.where(visible, pins, -1e3)

    def draw_along(axis: int) -> Array:
        offset = pixel[None, :, None] - position[:, None, :, axis]
        return jnp.exp2(-jnp.square(offset / radius_px))

    column, row = draw_along(0), draw_along(1)
    level = jnp.matmul(row, column.swapaxes(-1, -2))
    return (level >= 0.5).astype(jnp.float32)[..., None]


def encode_png(pixels: UInt8[np.ndarray, "H W *C"], level: int = 6) -> bytes:
    """Encode a PNG, grey or (H, W, 3); `level` of zlib: 1 is fast, 9 small."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "png", compress_level=level)
    return buffer.getvalue()


def to_uint8(image: Float[np.ndarray, "*S"]) -> UInt8[np.ndarray, "*S"]:
    """Convert numbers in [0, 1] to bytes; numbers outside are clipped."""
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)


def compare_images(image: np.ndarray, tap: np.ndarray) -> np.ndarray:
    """Colour the differences of two images (H, W) uint8; returns (H, W, 3) uint8.

    What both share is grey, and the rest has the colours `MISSING` and `SURPLUS`.
    """
    a, b = image.astype(np.float32)[..., None] / 255, tap.astype(np.float32)[..., None] / 255
    shared = np.minimum(a, b) * 90
    missing = np.clip(b - a, 0, 1) * np.array(MISSING, np.float32)
    surplus = np.clip(a - b, 0, 1) * np.array(SURPLUS, np.float32)
    return np.clip(np.rint(shared + missing + surplus), 0, 255).astype(np.uint8)
