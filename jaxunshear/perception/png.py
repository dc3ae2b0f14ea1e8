"""Encode images as PNG files."""

import io

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image


def encode_png(pixels: UInt8[np.ndarray, "H W"], level: int = 6) -> bytes:
    """Encode a grey PNG; `level` of zlib: 1 is fast, 9 small."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "png", compress_level=level)
    return buffer.getvalue()


def to_uint8(image: Float[np.ndarray, "*S"]) -> UInt8[np.ndarray, "*S"]:
    """Convert numbers in [0, 1] to bytes; numbers outside are clipped."""
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)
